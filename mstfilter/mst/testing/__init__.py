"""Contracts of components that process scenes, and a function that checks any component (``mstfilter check``).

>>> for result in run_contract(MyRule()):
...     print(result.statement, "-", result.failure or result.skipped or "holds")

`mstfilter.smc.testing` has the contracts of components that process numbers, and describes how to use a contract as a
test. `scene_example` returns hypotheses and a clip as an example input. ``mstfilter new resampler mine.py`` writes a
starting file for a component (`write_starter`).
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
