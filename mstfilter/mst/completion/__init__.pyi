from mstfilter.mst.completion.completer import (
    ClipCompleter as ClipCompleter,
    Completer as Completer,
    Completion as Completion,
    arbitrate as arbitrate,
    occupancy_of as occupancy_of,
)
from mstfilter.mst.completion.crops import CHANNELS as CHANNELS, Architecture as Architecture
from mstfilter.mst.completion.extrude import Extrude as Extrude, Hull as Hull, SurfaceOnly as SurfaceOnly
from mstfilter.mst.completion.kinds import (
    BoxKind as BoxKind,
    ConeKind as ConeKind,
    CylinderKind as CylinderKind,
    EllipsoidKind as EllipsoidKind,
    ShapeKind as ShapeKind,
    SuperquadricKind as SuperquadricKind,
    TrayKind as TrayKind,
    TurnedKind as TurnedKind,
    VesselKind as VesselKind,
)
from mstfilter.mst.completion.network import NetworkCompleter as NetworkCompleter
from mstfilter.mst.completion.observed import (
    ObservedBox as ObservedBox,
    SurfaceRule as SurfaceRule,
    observed_box as observed_box,
)
from mstfilter.mst.completion.pooled import Pooled as Pooled
from mstfilter.mst.completion.posterior import DrawnShape as DrawnShape, Posterior as Posterior
