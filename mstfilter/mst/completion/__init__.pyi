from mstfilter.mst.completion.completer import (
    ClipCompleter as ClipCompleter,
    Completer as Completer,
    Completion as Completion,
    arbitrate as arbitrate,
    occupancy_of as occupancy_of,
)
from mstfilter.mst.completion.crops import CHANNELS as CHANNELS, Architecture as Architecture
from mstfilter.mst.completion.extrude import Extrude as Extrude, Hull as Hull, SurfaceOnly as SurfaceOnly
from mstfilter.mst.completion.network import NetworkCompleter as NetworkCompleter
from mstfilter.mst.completion.observed import (
    ObservedBox as ObservedBox,
    SurfaceRule as SurfaceRule,
    observed_box as observed_box,
)
