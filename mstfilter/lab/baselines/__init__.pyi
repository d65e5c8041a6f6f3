from mstfilter.lab.baselines.methods import (
    FirstPause as FirstPause,
    ImageComponents as ImageComponents,
    OccupiedComponents as OccupiedComponents,
    OneBlob as OneBlob,
    SamplesOnly as SamplesOnly,
    TrackingOnly as TrackingOnly,
    Union as Union,
)
