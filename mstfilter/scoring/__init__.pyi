from mstfilter.scoring.quality import (
    FORMS as FORMS,
    MIN_PIXELS as MIN_PIXELS,
    STATUSES as STATUSES,
    Form as Form,
    Overlap as Overlap,
    Status as Status,
    connected_components as connected_components,
    object_status as object_status,
    one_blob as one_blob,
    overlap as overlap,
    quality_of as quality_of,
    weighted_coverage as weighted_coverage,
)
