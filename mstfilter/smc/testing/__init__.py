"""Contracts: test classes of the properties that every component of a filter must have.

Inherit the contract of an interface and define `make`, and ``pytest`` tests your component:

>>> from mstfilter.smc.testing import WeightResamplerContract
>>> from mine import MyResampler
>>> class TestMyResampler(WeightResamplerContract):
...     def make(self):
...         return MyResampler()

`check_properties` runs the same test class without pytest and states which property is violated:

>>> for result in check_properties(MyResampler(), WeightResamplerContract):
...     print(result.statement, "-", result.failure or result.skipped or "holds")

`mstfilter.mst.testing` has contracts for components of scenes, and a check that finds the contract of a component.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
