from mstfilter.segmentation.agglomerate import Agglomeration as Agglomeration
from mstfilter.segmentation.boundary import ColourDepthBoundary as ColourDepthBoundary
from mstfilter.segmentation.gibbs import ExactCuts as ExactCuts
from mstfilter.segmentation.interfaces import (
    BoundaryModel as BoundaryModel,
    CutSampler as CutSampler,
    CutValue as CutValue,
    TreeBuilder as TreeBuilder,
)
from mstfilter.segmentation.joins import FEATURES as FEATURES, features as features
from mstfilter.segmentation.learned_tree import LearnedTree as LearnedTree
from mstfilter.segmentation.mh import MetropolisHastingsCuts as MetropolisHastingsCuts
from mstfilter.segmentation.optimal import OptimalCut as OptimalCut, optimal_cut as optimal_cut
from mstfilter.segmentation.proposal import TreeCutProposal as TreeCutProposal, hypothesis_of as hypothesis_of
from mstfilter.segmentation.regions import REGION as REGION, Regions as Regions
from mstfilter.segmentation.segments import ObjectRule as ObjectRule, Segments as Segments
from mstfilter.segmentation.tree import Tree as Tree
from mstfilter.segmentation.ucm import UcmTree as UcmTree
from mstfilter.segmentation.value import MergeLogOdds as MergeLogOdds, SceneCutObjectness as SceneCutObjectness
