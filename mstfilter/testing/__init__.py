"""Contracts of components of scenes, and the check of any component: what ``mstfilter check`` does.

>>> for result in run_contract(MyRule()):
...     print(result.statement, "-", result.failure or result.skipped or "holds")

Contracts of components of numbers, and how to use a contract as a test, are in `mstfilter.smc.testing`.
`scene_example` gives hypotheses and a clip for either. ``mstfilter new resampler mine.py`` writes a component to
start from, and its test (`write_starter`).
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
