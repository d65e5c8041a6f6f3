"""Front ends of others: segmentations and networks that users supply by path.

>>> import mstfilter
>>> mst = mstfilter.preset("mst_rules", "proposal=mask_folder", "proposal.folder=masks")        # doctest: +SKIP

==================  ===================================================================
`mask_files`        folders of instance masks with alternatives: layout, reader, writer
`mask_trees`        nested masks as a tree whose cuts are levels
`mask_proposal`     the proposal, the boundary model, and the recipe for SAM
`completions`       meshes, point clouds and voxels of others as completions
`cob`               COB: boundary maps and trees; `cob_network`: its network in torch
`caffe`             a reader of Caffe's files of weights
`mask_trackers`     SiamMask as a tracker of masks; `siammask_network`: its network in torch
`package_trackers`  SAM 2, EdgeTAM and Cutie through their packages
==================  ===================================================================

No weights are part of the package, and none are downloaded.
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__components__ = {
    "proposal": {"mask_folder": "MaskProposal"},
    "boundary": {"mask_folder": "MaskBoundary", "cob": "CobBoundary"},
    "tree": {"cob": "CobTree"},
    "completer": {"external": "ExternalCompletion"},
    "tracker": {"siammask": "SiamMaskTracker", "sam2": "Sam2Tracker", "cutie": "CutieTracker"},
}
