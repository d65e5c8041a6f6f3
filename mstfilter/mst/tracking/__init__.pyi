from mstfilter.mst.tracking.features import Matches as Matches, SiftMatching as SiftMatching
from mstfilter.mst.tracking.flow import ClipTracks as ClipTracks, DenseFlow as DenseFlow, FlowTracker as FlowTracker
from mstfilter.mst.tracking.registration import (
    Registration as Registration,
    RegistrationResult as RegistrationResult,
    SmallGicp as SmallGicp,
    Surface as Surface,
)
from mstfilter.mst.tracking.residual import MotionResidual as MotionResidual, refine_motion as refine_motion
from mstfilter.mst.tracking.rigid import move_points as move_points, rigid_transform as rigid_transform
from mstfilter.mst.tracking.rules import (
    IDENTITY as IDENTITY,
    AuthorsRule as AuthorsRule,
    Candidate as Candidate,
    MotionRule as MotionRule,
    MstRule as MstRule,
    PaperRule as PaperRule,
)
from mstfilter.mst.tracking.segments import (
    MaskTracker as MaskTracker,
    Segment as Segment,
    StaticTest as StaticTest,
    Track as Track,
    segments_of as segments_of,
)
from mstfilter.mst.tracking.transition import (
    IdentityTransition as IdentityTransition,
    TrackingTransition as TrackingTransition,
    Warp as Warp,
)
