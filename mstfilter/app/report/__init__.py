"""Reports of runs and studies; pictures, pages and meshes of hypotheses.

>>> from mstfilter.app.report import write_report, write_study_report
>>> write_report("runs/demo")                                        # doctest: +SKIP
>>> write_study_report("studies/first")                              # doctest: +SKIP

A report is made from the folder of a run or a study alone. It loads no user code, so a folder that you received from
somebody else can be looked at safely. `overlay` and `voxel_picture` draw one hypothesis. The hypotheses of a run
number their objects independently, so `assign_identities` says which are the same and gives them the same colour.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
