from mstfilter.mst.segmentation.border_network import PairNetwork as PairNetwork
from mstfilter.mst.segmentation.boundary import (
    BoundaryModel as BoundaryModel,
    ClipBoundary as ClipBoundary,
    ColourDepthBoundary as ColourDepthBoundary,
)
from mstfilter.mst.segmentation.cuts import (
    CutSample as CutSample,
    CutSampler as CutSampler,
    CutValue as CutValue,
    ExactCuts as ExactCuts,
    MergeLogOdds as MergeLogOdds,
    OptimalCut as OptimalCut,
    SceneCutObjectness as SceneCutObjectness,
    optimal_cut as optimal_cut,
)
from mstfilter.mst.segmentation.learned_tree import (
    Agglomeration as Agglomeration,
    BorderTree as BorderTree,
    LearnedTree as LearnedTree,
    MergedTree as MergedTree,
    pair_log_odds as pair_log_odds,
)
from mstfilter.mst.segmentation.mh import MetropolisHastingsCuts as MetropolisHastingsCuts
from mstfilter.mst.segmentation.pair_measures import (
    EVIDENCE_FEATURES as EVIDENCE_FEATURES,
    FEATURES as FEATURES,
    PAIR_FEATURES as PAIR_FEATURES,
    pair_features as pair_features,
)
from mstfilter.mst.segmentation.proposal import (
    ObjectRule as ObjectRule,
    Segments as Segments,
    TreeCutProposal as TreeCutProposal,
    complete_segments as complete_segments,
    hypothesis_of as hypothesis_of,
)
from mstfilter.mst.segmentation.regions import (
    REGION as REGION,
    Regions as Regions,
    SeenBorders as SeenBorders,
    connected_pixels as connected_pixels,
)
from mstfilter.mst.segmentation.seams import SeamTree as SeamTree
from mstfilter.mst.segmentation.tree import Tree as Tree, TreeBuilder as TreeBuilder, UcmTree as UcmTree
