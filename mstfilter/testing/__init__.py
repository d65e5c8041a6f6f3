"""Contracts of components of scenes, and the check of any component, which ``mstfilter check`` uses.

>>> for result in run_contract(MyRule()):
...     print(result.statement, "-", result.failure or result.skipped or "holds")

`mstfilter.smc.testing` has the contracts of components of numbers, and describes how to use a contract as a test.
`scene_example` returns hypotheses and a clip for either kind. ``mstfilter new resampler mine.py`` writes a starting
file for a component, and its test (`write_starter`).
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
