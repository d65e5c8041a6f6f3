"""Segmentation: image -> boundaries -> tree -> cuts -> hypotheses (paper IV-B)."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
