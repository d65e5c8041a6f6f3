"""Reports of runs and studies, pictures of hypotheses, and export to other programs.

>>> from mstfilter.report import export_run, write_report, write_study_report
>>> write_report("runs/demo")                                        # doctest: +SKIP
>>> export_run("runs/demo", "out")                                   # doctest: +SKIP
>>> write_study_report("studies/first")                              # doctest: +SKIP

`overlay` and `voxel_picture` draw a hypothesis. `assign_identities` gives an object the same colour in all pictures
of a run. Reports are made from folders alone and load no user code.
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
