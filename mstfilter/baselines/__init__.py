"""What MST is compared with: filters of the same parts that leave out what MST adds, and floors."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
