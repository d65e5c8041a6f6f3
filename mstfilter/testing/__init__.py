"""Contracts: properties that every component of a kind has, as pytest classes, for your components and ours.

Inherit the contract of the interface and define `make`:

>>> from mstfilter.testing import WeightResamplerContract
>>> from mine import MyResampler
>>> class TestMyResampler(WeightResamplerContract):
...     def make(self):
...         return MyResampler()

``pytest`` then tests the component. ``mstfilter check ./mine.py:MyResampler`` runs the same class and states in words
which property is violated; `run_contract` does so from Python. ``mstfilter new resampler mine.py`` writes a
component to start from, and its test (`write_starter`).

Contracts need pytest: ``pip install 'mstfilter[check]'``.
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
