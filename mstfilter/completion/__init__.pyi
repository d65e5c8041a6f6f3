from mstfilter.completion.completer import (
    ClipCompleter as ClipCompleter,
    Completer as Completer,
    Completion as Completion,
    arbitrate as arbitrate,
    occupancy_of as occupancy_of,
)
from mstfilter.completion.crops import CHANNELS as CHANNELS, Architecture as Architecture
from mstfilter.completion.extrude import Extrude as Extrude, Hull as Hull, SurfaceOnly as SurfaceOnly
from mstfilter.completion.network import NetworkCompleter as NetworkCompleter
from mstfilter.completion.observed import ObservedBox as ObservedBox, observed_box as observed_box
