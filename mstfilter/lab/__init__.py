"""Worlds whose truth is known, and methods to compare with.

`simulation` makes tables of objects, pushes them with a simulated robot and renders the images. `oracles` replace one
stage of the filter by the truth, so a study can say what the others lose. `baselines` are simpler methods that use
the same images.
"""
