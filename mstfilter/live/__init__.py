"""Live use: frames of a camera in, hypotheses out at every pause.

>>> with mstfilter.Stream(K, on_pause=lambda pause: print(pause.hypotheses[0])) as stream:
...     for rgb, depth in camera:
...         stream.push(rgb, depth)

Modules: `stream` has the `Stream`, and `folder` a folder that a recorder fills.
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
