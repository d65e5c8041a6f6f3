from mstfilter.runs.study.config import (
    SceneEntry as SceneEntry,
    StudyConfig as StudyConfig,
    check_arm_names as check_arm_names,
    load_study as load_study,
    study_of as study_of,
)
from mstfilter.runs.study.plan import make_plan as make_plan
from mstfilter.runs.study.results import (
    FORECASTS as FORECASTS,
    RESULT as RESULT,
    JobOutcome as JobOutcome,
    StudyFolder as StudyFolder,
    cost_columns as cost_columns,
)
from mstfilter.runs.study.study import (
    StudyProgress as StudyProgress,
    StudyResult as StudyResult,
    run_study as run_study,
)
from mstfilter.runs.study.summary import (
    ENDPOINTS as ENDPOINTS,
    SLOPES as SLOPES,
    Compared as Compared,
    Summary as Summary,
    interval_text as interval_text,
    number_text as number_text,
    summarise as summarise,
    title_of as title_of,
)
from mstfilter.runs.study.worker import (
    open_scene as open_scene,
    peak_megabytes as peak_megabytes,
    reset_peak as reset_peak,
    write_measures as write_measures,
)
