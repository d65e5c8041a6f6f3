"""What people start: the command line (`mstfilter.app.cli`) and reports (`mstfilter.app.report`).

>>> from mstfilter.app.report import write_report
>>> write_report("runs/mine")                         # runs/mine/report.html  # doctest: +SKIP

This room alone parses arguments, prints and draws. What it shows comes from the rooms below, where you can have it as
arrays and tables.
"""
