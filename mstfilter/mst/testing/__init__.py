"""Contracts of components that work on scenes, and what ``mstfilter check`` runs to test any component.

>>> for result in run_contract(MyRule()):
...     print(result.statement, "-", result.failure or result.skipped or "holds")

`mstfilter.smc.testing` has the contracts of components that work on numbers, and shows how to use one as a test.
`scene_example` returns hypotheses and a clip to try a component on. `write_starter` writes the file with which
``mstfilter new resampler mine.py`` starts.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
