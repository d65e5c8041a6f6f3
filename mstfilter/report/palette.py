"""Colours for objects: far apart also for eyes that do not tell red from green.

>>> colour(0), colour(1)
((51, 111, 185), (238, 145, 56))

Six calm colours were set by hand; the rest follow by taking, again and again, the colour that is farthest from
all chosen ones, where distance is the smallest Oklab distance in three views: as it is, and as seen with
protanopia and with deuteranopia (Machado, Oliveira, Fernandes 2009, severity 1). The first six differ most.
"""

from __future__ import annotations

__all__ = ["GREY", "PALETTE", "colour", "hexadecimal"]

Colour = tuple[int, int, int]

_HEX = (
    "336fb9 ee9138 2ca281 93285c a3d3eb e8d34f d381d8 4f4100 502684 70f6b5 "
    "a95317 876888 eba9b2 968727 52a9fe e66d71 577251 075c70 9dbe7c 6892ac"
)

#: Twenty colours, 8-bit sRGB.
PALETTE: tuple[Colour, ...] = tuple((int(h[:2], 16), int(h[2:4], 16), int(h[4:], 16)) for h in _HEX.split())

#: For what has no identity.
GREY: Colour = (140, 143, 148)


def colour(identity: int) -> Colour:
    """Colour of an identity 0, 1, 2, ...; they repeat after twenty. Grey for negative ones."""
    return GREY if identity < 0 else PALETTE[identity % len(PALETTE)]


def hexadecimal(rgb: Colour) -> str:
    """``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*rgb)
