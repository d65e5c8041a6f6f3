"""Prediction: clip and hypotheses in, moved hypotheses out (paper IV-C).

>>> from mstfilter.tracking.transition import TrackingTransition
>>> TrackingTransition().predict(rng, population, clip)      # doctest: +SKIP

==================  ====================================================================
`transition`        the motion model: `TrackingTransition`, and the baseline that stays
`flow`              dense flow through the clip: points, and masks of the last frame
`features`          SIFT matches of first and last frame
`segments`          what is tracked, once for all hypotheses that agree on it
`track`             the evidence about one segment
`static`            what did not change is not moved
`rules`             the published rules; `mst_rule` the default one
`registration`      small_gicp;  `jlinkage`, `rigid` motions from point pairs
`residual`          what makes a motion good;  `refine` polishes one
`photometry`        takes out changes of exposure
`warp`              voxels follow a motion
==================  ====================================================================
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"rule": "MotionRule"}
__components__ = {
    "transition": {"tracking": "TrackingTransition", "identity": "IdentityTransition"},
    "rule": {"authors": "AuthorsRule", "mst": "MstRule", "paper": "PaperRule"},
}
