"""What a run looks like: pictures, figures, one self-contained HTML page, and exports. Stands on the run folder."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
