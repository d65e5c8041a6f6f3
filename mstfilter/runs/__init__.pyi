from mstfilter.runs.run import (
    WITHOUT_RESULTS as WITHOUT_RESULTS,
    check_run_folder as check_run_folder,
    code_version as code_version,
    compared_configs as compared_configs,
    component_files as component_files,
    describe_run as describe_run,
    filter_recording as filter_recording,
    first_pause as first_pause,
    library_versions as library_versions,
)
from mstfilter.runs.run_folder import (
    RUN_FILES as RUN_FILES,
    HypothesisCodec as HypothesisCodec,
    RunFolder as RunFolder,
    as_json as as_json,
    write_json as write_json,
)
from mstfilter.runs.run_tables import (
    TABLE_COLUMNS as TABLE_COLUMNS,
    chosen_pauses as chosen_pauses,
    object_rows as object_rows,
    pause_documents as pause_documents,
)
