"""Contracts: properties that every component of a filter has, as test classes for your components and ours.

Inherit the contract of the interface and define `make`. ``pytest`` then tests the component:

>>> from mstfilter.smc.testing import WeightResamplerContract
>>> from mine import MyResampler
>>> class TestMyResampler(WeightResamplerContract):
...     def make(self):
...         return MyResampler()

`check_properties` runs the same class without pytest and states which property is violated:

>>> for result in check_properties(MyResampler(), WeightResamplerContract):
...     print(result.statement, "-", result.failure or result.skipped or "holds")

Contracts of components of scenes, and a check that finds the contract of a component, are in `mstfilter.testing`.
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
