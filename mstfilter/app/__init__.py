"""What people start: the command line (`mstfilter.app.cli`) and reports (`mstfilter.app.report`).

>>> from mstfilter.app.report import write_report
>>> write_report("runs/mine")                         # runs/mine/report.html  # doctest: +SKIP

Only this room parses arguments, prints, and draws. Everything that it shows can be had from the rooms below as
arrays and tables.
"""
