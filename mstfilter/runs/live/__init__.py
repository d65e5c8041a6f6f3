"""Live use: a stream takes the frames of a camera and gives hypotheses at every pause.

>>> with mstfilter.Stream(K, on_pause=lambda pause: print(pause.hypotheses[0])) as stream:
...     for rgb, depth in camera:
...         stream.push(rgb, depth)

`Stream` is in `stream`; `folder` filters a folder to which another program adds images.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
