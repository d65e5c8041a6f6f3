from mstfilter.completion.completer import (
    ClipCompleter as ClipCompleter,
    Completer as Completer,
    Completion as Completion,
    ObservedBox as ObservedBox,
    arbitrate as arbitrate,
    observed_box as observed_box,
)
from mstfilter.completion.crops import CHANNELS as CHANNELS, Architecture as Architecture
from mstfilter.completion.extrude import Extrude as Extrude, SurfaceOnly as SurfaceOnly
from mstfilter.completion.geometric import HilbertMap as HilbertMap, Hull as Hull
from mstfilter.completion.network import NetworkCompleter as NetworkCompleter
