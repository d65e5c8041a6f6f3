"""Contracts that every component keeps, ours or yours.

With pytest, five lines test your own component:

>>> from mstfilter.testing import ResamplerContract
>>> from mine import MyResampler
>>> class TestMyResampler(ResamplerContract):
...     def make(self):
...         return MyResampler()

Without pytest, ``mstfilter check ./mine.py:MyResampler`` runs the same properties and says in words which one does
not hold; `verify` does so from Python.
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
