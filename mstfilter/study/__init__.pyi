from mstfilter.study.cluster import Cluster as Cluster
from mstfilter.study.config import load_study as load_study, study_of as study_of
from mstfilter.study.executors import Executor as Executor
from mstfilter.study.grid import check_names as check_names
from mstfilter.study.local import Local as Local
from mstfilter.study.memory import peak_megabytes as peak_megabytes, reset_peak as reset_peak
from mstfilter.study.plan import make_plan as make_plan
from mstfilter.study.results import (
    RESULT as RESULT,
    StudyFolder as StudyFolder,
    cost_columns as cost_columns,
    write_table as write_table,
)
from mstfilter.study.statistics import (
    CLAIM as CLAIM,
    Difference as Difference,
    adjusted as adjusted,
    compare as compare,
    interval as interval,
    said as said,
)
from mstfilter.study.study import run_study as run_study
from mstfilter.study.summary import (
    ENDPOINT as ENDPOINT,
    SLOPE as SLOPE,
    Compared as Compared,
    Summary as Summary,
    summarise as summarise,
)
