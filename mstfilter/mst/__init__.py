"""Multihypothesis Segmentation Tracking: the method of Price, Huang and Berenson (2021), a folder for each section.

>>> mst = mstfilter.preset("mst")                            # assembles the parts below
>>> state, infos = mst.run(recording.clips(), seed=0)

A particle is a `mstfilter.scene.Hypothesis`, a 3-D segmentation of the whole scene. From one pause of the robot to
the next,

1. `tracking` moves the objects of each hypothesis as the video shows (section IV-C; the `Transition`);
2. `segmentation` samples segmentations of the latest image, as cuts of a segmentation tree (IV-B; the `Proposal`);
3. `partition` weighs the ways in which moved and sampled hypotheses can be combined (IV-D; the `Update`). The
   published update, which crosses pairs of hypotheses, is `crossover`;
4. a resampler of `mstfilter.smc` keeps a few of these;
5. `completion` turns segments into voxels (IV-B; the field `completer` of the proposal and of the update).

Who completes, and when, depends on the update. With `partition`, the completer of the update makes the objects after
resampling, each from all its views; the shapes from the completer of the proposal then only say which depth readings
belong to a segment. `crossover` has no completer, so there the proposal completes its samples in step 2, and these
shapes become the objects.

`belief` answers questions from the weighted hypotheses. `frontends` puts masks, shapes and trackers of other programs
in the place of ours. `testing` has the contracts that a component of your own must keep.

These folders stand on `mstfilter.scene` and `mstfilter.smc`, and know little of one another: a proposal or an update
asks a `Completer`, `frontends` uses the trees and cuts of `segmentation`, and `testing` knows all interfaces.
"""
