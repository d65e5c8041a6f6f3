"""Studies: several filters on many scenes, compared scene by scene.

>>> from mstfilter.runs.study import load_study, run_study
>>> study = load_study("experiments/main/study.toml", smoke=True)
>>> result = run_study(study, Path("studies/main"), workers=2)
>>> result.folder.summary().compared()[0].words

`run_study` plans the runs, which are every arm (configuration of the filter) on every scene with every seed. Worker
processes make those that are missing: one worker makes all runs of a recording, and every run has a folder of its own
(`mstfilter.runs.RunFolder`). Then the tables of the study folder are written from the runs.

=========  =======================================================================================
`config`   a study as written in its file: scenes, arms, seeds, metrics
`plan`     the runs that it asks for, and what makes a run the same as an earlier one
`study`    the loop over recordings; `worker` makes the runs of one recording in a process
`results`  the study's folder: what its runs measured, row by row
`summary`  arms paired scene by scene (`summarise`), differences and what may be claimed
=========  =======================================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
