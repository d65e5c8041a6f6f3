from mstfilter.completion.arbitration import arbitrate as arbitrate
from mstfilter.completion.completer import (
    Completer as Completer,
    Completion as Completion,
    Evidence as Evidence,
    evidence as evidence,
)
from mstfilter.completion.extrude import Extrude as Extrude, SurfaceOnly as SurfaceOnly
