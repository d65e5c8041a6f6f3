"""Studies, which compare filters on many scenes.

>>> from mstfilter.runs.study import load_study, run_study
>>> study = load_study("experiments/main/study.toml", smoke=True)
>>> result = run_study(study, Path("studies/main"), workers=2)
>>> result.folder.summary().compared()[0].words

`run_study` plans the runs: every arm (configuration of the filter) on every scene with every seed. Worker processes
make the missing runs, all of one recording in one worker. Then `run_study` writes the tables of the study folder.
Each run is a `mstfilter.runs.RunFolder`.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
