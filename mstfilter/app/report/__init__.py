"""Reports of runs and studies, pictures and meshes of hypotheses.

>>> from mstfilter.app.report import write_report, write_study_report
>>> write_report("runs/demo")                                        # doctest: +SKIP
>>> write_study_report("studies/first")                              # doctest: +SKIP

`overlay` and `voxel_picture` draw a hypothesis. `assign_identities` gives an object the same colour in all pictures
of a run. A report reads only the folder of a run or a study, and loads no user code.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
