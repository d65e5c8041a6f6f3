"""Runs and their folders."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
