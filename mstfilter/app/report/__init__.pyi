from mstfilter.app.report.export import export_mesh as export_mesh
from mstfilter.app.report.figures import (
    SERIES as SERIES,
    draw_forest as draw_forest,
    figure_groups as figure_groups,
    time_figure as time_figure,
)
from mstfilter.app.report.identities import (
    TRUTH as TRUTH,
    Identities as Identities,
    assign_identities as assign_identities,
    match_objects as match_objects,
    order_by_weight as order_by_weight,
)
from mstfilter.app.report.pictures import (
    UNASSIGNED_COLOUR as UNASSIGNED_COLOUR,
    Colour as Colour,
    close_up as close_up,
    colour as colour,
    hexadecimal as hexadecimal,
    overlay as overlay,
    viewpoint as viewpoint,
    voxel_picture as voxel_picture,
)
from mstfilter.app.report.run_numbers import RunNumbers as RunNumbers, read_numbers as read_numbers
from mstfilter.app.report.run_report import write_report as write_report
from mstfilter.app.report.study_report import write_study_report as write_study_report
from mstfilter.app.report.viewer import recording_page as recording_page, run_page as run_page
