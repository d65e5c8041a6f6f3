"""Simulated recordings: physics, objects, pushes, rendered colour and depth, volumetric truth.

>>> from mstfilter.simulation.families import scene_family
>>> from mstfilter.simulation.recorder import simulate_recording
>>> recording = simulate_recording(scene_family("demo"), seed=7, path="recordings/demo-7")  # doctest: +SKIP

`cache.cached_recording` keeps what was simulated; the families of the studies are `s1`, `s2` and `s3`.

What is missing, so that nobody is misled: camera motion, glossy and transparent surfaces, light that bounces
between objects, articulated and soft objects, a hand. Depth noise, the projector's shadow and losses at edges are
calibrated to real frames; within surfaces noise is not correlated from pixel to pixel.
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
