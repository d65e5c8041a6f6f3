from mstfilter.mst.frontends.completions import ExternalCompletion as ExternalCompletion, read_shapes as read_shapes
from mstfilter.mst.frontends.mask_files import (
    PauseMasks as PauseMasks,
    read_masks as read_masks,
    write_masks as write_masks,
)
from mstfilter.mst.frontends.mask_proposal import (
    MaskProposal as MaskProposal,
    Segmenter as Segmenter,
    write_automatic_masks as write_automatic_masks,
)
from mstfilter.mst.frontends.mask_trees import (
    mask_tree as mask_tree,
    nested_masks as nested_masks,
    node_values as node_values,
)
