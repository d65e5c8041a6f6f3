"""Multihypothesis Segmentation Tracking: the method of Price, Huang and Berenson (2021), a folder for each section.

>>> mst = mstfilter.preset("mst")                            # assembles the parts below
>>> state, infos = mst.run(recording.clips(), seed=0)

A particle is a `mstfilter.scene.Hypothesis`, a 3-D segmentation of the whole scene. From one pause of the robot to
the next,

1. `tracking` moves the objects of each hypothesis as the video shows (section IV-C; the `Transition`);
2. `segmentation` samples segmentations of the latest image, as cuts of a segmentation tree (IV-B; the `Proposal`);
3. `partition` weighs the ways in which moved and sampled hypotheses can be combined (IV-D; the `Update`). The
   published update, which crosses pairs of hypotheses, is `crossover`.

Both the proposal and the update have a field `completer`, from `completion`, which turns segments into voxels. `mst`
completes in its update, once per object and from all its views; the published filter completes each sample.

A resampler of `mstfilter.smc` then keeps a few. `belief` answers questions from the weighted hypotheses. `frontends`
puts masks, shapes and trackers of other programs in the place of ours. `testing` has the contracts that a component
of your own must keep.

These folders stand on `mstfilter.scene` and `mstfilter.smc`. They do not know one another, except that a proposal or
an update asks a `Completer`.
"""
