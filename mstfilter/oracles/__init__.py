"""What is known to be right: worlds with an exact answer, and stages replaced by the truth of a recording."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
