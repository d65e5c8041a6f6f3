from mstfilter.scoring.log_loss import (
    LOG_LOSS as LOG_LOSS,
    NO_COUNTS as NO_COUNTS,
    BeliefScore as BeliefScore,
    FittedForecasts as FittedForecasts,
    forecast_table as forecast_table,
    leave_one_out as leave_one_out,
    score_belief as score_belief,
)
from mstfilter.scoring.metrics import (
    diversity as diversity,
    least_loss as least_loss,
    pairwise_quality as pairwise_quality,
    pause_metrics as pause_metrics,
)
from mstfilter.scoring.own import Metric as Metric, measure_own as measure_own
from mstfilter.scoring.pauses import (
    PauseEstimate as PauseEstimate,
    PauseScore as PauseScore,
    PauseTruth as PauseTruth,
    measure_pause as measure_pause,
    read_truth as read_truth,
    score_pauses as score_pauses,
)
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
    shown_objects as shown_objects,
    status_of as status_of,
    weighted_coverage as weighted_coverage,
)
from mstfilter.scoring.questions import (
    NOISE_RATES as NOISE_RATES,
    Questions as Questions,
    ask as ask,
    draw_questions as draw_questions,
    in_question as in_question,
)
from mstfilter.scoring.statistics import (
    Difference as Difference,
    Differences as Differences,
    compare_arms as compare_arms,
    compare_runs as compare_runs,
    conclusion as conclusion,
    plot_differences as plot_differences,
)
