from mstfilter.report.cards import close_up as close_up
from mstfilter.report.export import export_run as export_run
from mstfilter.report.html import write_report as write_report
from mstfilter.report.identities import (
    TRUTH as TRUTH,
    Identities as Identities,
    by_weight as by_weight,
    identity_colours as identity_colours,
)
from mstfilter.report.palette import GREY as GREY, Colour as Colour, colour as colour, hexadecimal as hexadecimal
from mstfilter.report.pictures import overlay as overlay, viewpoint as viewpoint, voxel_picture as voxel_picture
from mstfilter.report.study import write_study_report as write_study_report
from mstfilter.report.svg import SERIES as SERIES
