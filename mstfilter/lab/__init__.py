"""Worlds whose truth is known, and methods to compare with.

>>> from mstfilter.lab.simulation import cached_recording
>>> recording = mstfilter.open_recording(cached_recording("demo", seed=3))
>>> recording.truth(0)                                # true labels (X, Y, Z) at the first pause

`simulation` sets objects on a table, pushes them with a simulated robot and renders the images. `oracles` replace one
stage of a filter by the truth, so that a study can say how much this stage costs. `baselines` are simpler methods
that get the same images.
"""
