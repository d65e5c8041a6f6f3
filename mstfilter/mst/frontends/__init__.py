"""Front ends that use other programs: their segmentations and shapes, which lie in folders, and their networks.

>>> import mstfilter
>>> mst = mstfilter.preset("mst_rules", "proposal=mask_folder", "proposal.folder=masks")        # doctest: +SKIP

==================  ===================================================================
`mask_files`        folders of instance masks with alternatives: layout, reader, writer
`mask_trees`        nested masks as a tree whose cuts are segmentations
`mask_proposal`     the proposal, the base class of segmenters, and the recipe for SAM
`completions`       meshes, point clouds and voxels of other programs as completions
==================  ===================================================================

The networks of the published system, COB and SiamMask, and the tracker SAM 2 are files in ``models/published``, which
the registry loads as it loads a component file of yours. Their weights are not part of the package.
"""

from mstfilter.base.lazy import attach
from mstfilter.base.resources import models_folder

__getattr__, __dir__, __all__ = attach(__name__, __file__)

_COB, _SIAMMASK, _SAM2 = (f"{models_folder()}/published/{name}.py" for name in ("cob", "siammask", "sam2_tracker"))
__components__ = {
    "proposal": {"mask_folder": "MaskProposal"},
    "boundary": {"cob": f"{_COB}:CobBoundary"},
    "tree": {"cob": f"{_COB}:CobTree"},
    "completer": {"external": "ExternalCompletion"},
    "tracker": {"siammask": f"{_SIAMMASK}:SiamMaskTracker", "sam2": f"{_SAM2}:Sam2Tracker"},
}
