"""Predicted x proposed -> fused hypotheses: the measurement update of MST (paper, section IV-D)."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
