"""Prediction: the objects of every hypothesis move as the video of the clip shows (paper, section IV-C).

>>> from mstfilter.mst.tracking import MstRule, TrackingTransition
>>> transition = TrackingTransition(MstRule(select="sample"))
>>> transition.predict(rng, population, clip)                        # doctest: +SKIP

Each object gets one rigid motion. Flow, features and registration suggest several, a rule chooses by what a motion
leaves unexplained in the last frame, and all voxels of the object move along, hidden ones too.

=====================  ====================================================================
`transition`           the motion model `TrackingTransition`; `Warp` moves the voxels
`rules`                the rigid motion of an object: `PaperRule`, `AuthorsRule`, `MstRule`
`segments`             tracked segments and their data; the test for rest
`flow`                 dense flow through the clip
`features`             SIFT matches, exposure matching
`registration`         ICP by small_gicp
`residual`             comparison of a motion with the last frame, refinement
`rigid`                rigid motions from point pairs, J-Linkage
=====================  ====================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"rule": "MotionRule", "registration": "Registration", "tracker": "MaskTracker"}
__components__ = {
    "transition": {"tracking": "TrackingTransition", "identity": "IdentityTransition"},
    "rule": {"authors": "AuthorsRule", "mst": "MstRule", "paper": "PaperRule"},
    "registration": {"small_gicp": "SmallGicp"},
}
