"""Multi-hypothesis Segmentation Tracking: the method of Price, Huang and Berenson (2021), one folder per section.

A particle is a `mstfilter.scene.Hypothesis`, a 3-D segmentation of the whole scene. At every pause of the robot

1. `tracking` moves the objects of each hypothesis as the video shows (section IV-C; the `Transition`);
2. `segmentation` samples segmentations of the latest image, as cuts of a segmentation tree, and asks `completion` for
   the voxels of every segment (IV-B; the `Proposal`);
3. `partition`, or `crossover` as published, fuses moved and sampled hypotheses (IV-D; the `Update`).

`frontends` uses masks, contours and trackers of other programs instead of ours. `belief` answers questions from the
weighted hypotheses. `testing` has the contracts that a component of your own must keep.

These folders stand on `mstfilter.scene` and `mstfilter.smc`. They do not know one another, except that a proposal or
an update asks a `Completer`. `mstfilter.preset("mst")` assembles them.
"""
