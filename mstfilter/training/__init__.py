"""Training of the learned parts: data generators, the training loops, and the models that they write.

`mstfilter train completion` makes samples, trains the completion network and writes a folder that
`completer.weights=FOLDER` uses. Samples come from the package's own simulation; each follows from the seed.
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
