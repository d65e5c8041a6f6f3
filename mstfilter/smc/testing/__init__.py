"""Contracts: test classes of the properties that every component of a filter must have.

Whether a resampler is unbiased, or a guided move has the weights f / q, cannot be seen in the results of one run. A
contract tests such properties on many small cases, and every statistical test fails for a correct component with a
probability of at most 1e-6. `check_properties` runs a contract and states which property is violated:

>>> from dataclasses import dataclass
>>> import numpy as np
>>> from mstfilter.smc import WeightResampler
>>> from mstfilter.smc.testing import WeightResamplerContract, check_properties
>>> @dataclass(frozen=True)
... class Heaviest(WeightResampler):
...     def select(self, rng, log_weights, n):
...         return np.resize(np.argsort(-log_weights), n), None
>>> for result in check_properties(Heaviest(), WeightResamplerContract):
...     if result.failure:
...         print(result.statement)
A particle of weight zero is never selected.
A particle gets n W_i copies on average, or copies of total weight W_i if output weights differ.
...

In a test suite, inherit the contract of an interface and define `make`; ``pytest`` runs the rest:

>>> class TestHeaviest(WeightResamplerContract):
...     def make(self):
...         return Heaviest()

`mstfilter.mst.testing` has contracts for components of scenes, and a check that finds the contract of a component.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
