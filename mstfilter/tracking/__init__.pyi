from mstfilter.tracking.features import Matches as Matches
from mstfilter.tracking.flow import ClipTracks as ClipTracks, DenseFlow as DenseFlow
from mstfilter.tracking.mst_rule import MstRule as MstRule
from mstfilter.tracking.refinement import refine as refine
from mstfilter.tracking.rigid import Array as Array, apply as apply
from mstfilter.tracking.rigid_motions import MotionSegmentation as MotionSegmentation
from mstfilter.tracking.rules import AuthorsRule as AuthorsRule, MotionRule as MotionRule, PaperRule as PaperRule
from mstfilter.tracking.segments import Segment as Segment, segments_of as segments_of
from mstfilter.tracking.static import StaticTest as StaticTest
from mstfilter.tracking.track import Track as Track
from mstfilter.tracking.transition import (
    IdentityTransition as IdentityTransition,
    TrackingTransition as TrackingTransition,
)
from mstfilter.tracking.warp import Warp as Warp
