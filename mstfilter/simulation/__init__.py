"""Simulated recordings: physics, objects, pushes, rendered colour and depth, volumetric truth.

>>> from mstfilter.simulation.families import scene_family
>>> from mstfilter.simulation.recorder import simulate
>>> recording = simulate(scene_family("demo"), seed=7, path="recordings/demo-7")  # doctest: +SKIP

What is missing, so that nobody is misled: camera motion, glossy and transparent surfaces, light that bounces
between objects, articulated and soft objects, a hand. Depth noise is calibrated to real frames; spatially
correlated noise is not modelled.
"""
