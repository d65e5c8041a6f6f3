from mstfilter.baselines.proposals import (
    FirstPause as FirstPause,
    ImageComponents as ImageComponents,
    OccupiedComponents as OccupiedComponents,
    OneBlob as OneBlob,
)
from mstfilter.baselines.updates import SamplesOnly as SamplesOnly, TrackingOnly as TrackingOnly, Union as Union
