from mstfilter.scoring.floors import components as components, one_blob as one_blob
from mstfilter.scoring.quality import (
    FORMS as FORMS,
    Form as Form,
    Overlap as Overlap,
    overlap as overlap,
    quality_of as quality_of,
    weighted_coverage as weighted_coverage,
)
from mstfilter.scoring.status import MIN_PIXELS as MIN_PIXELS, STATUSES as STATUSES, object_status as object_status
