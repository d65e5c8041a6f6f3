"""Drawing of flat texture images (charts): printed cartons and labels, wood, cloth, speckle, glaze, peel.

Each function takes a random generator and the size of the chart in metres. The function returns an RGB uint8 image
with 0.4 mm per pixel. The module `textures` scales the image to the resolution of the camera. Colours have low
saturation, as in images of real packaging under office light.

>>> import numpy as np
>>> from mstfilter.lab.simulation.printing import wood
>>> wood(np.random.default_rng(0), 0.1, 0.05).shape
(125, 250, 3)
"""

from __future__ import annotations

import colorsys

import numpy as np

from mstfilter.lab.simulation.shapes import ANY, Pool

DOT = 0.0004  #: Size of a drawn pixel in metres

_Rgb = tuple[int, int, int]
_Box = tuple[int, int, int, int]  # x, y, width, height in pixels

# fmt: off
_WORDS = (
    "Alpina", "Brio", "Cresta", "Delta", "Elmo", "Fiora", "Granat", "Halma",
    "Ivor", "Jura", "Kalo", "Lumen", "Marin", "Nessa", "Orto", "Polka",
    "Quarz", "Rivo", "Solis", "Tamar", "Ulma", "Vesta", "Wiko", "Xanto",
    "Yarra", "Zephyr", "Amaro", "Bolero", "Corvo", "Dorado", "Enzian", "Falko",
)
_KINDS = (
    "oats", "crackers", "rice", "sugar", "tea", "cocoa", "beans", "soup",
    "pasta", "muesli", "honey", "figs", "corn", "lentils", "salt", "rusks",
)
# fmt: on


def shade(
    rng: np.random.Generator, light: tuple[float, float] = (0.45, 0.9), rich: float = 0.5, pool: Pool = ANY
) -> _Rgb:
    """A colour of random hue. With probability 0.33, the colour is nearly white or grey."""
    hue = pool.hue(rng)
    r, g, b = colorsys.hsv_to_rgb(
        hue, float(rng.uniform(0.2, rich)) * (0.25 if rng.uniform() < 0.33 else 1.0), float(rng.uniform(*light))
    )
    return int(255 * r), int(255 * g), int(255 * b)


def noise(
    rng: np.random.Generator, shape: tuple[int, int], cell: tuple[float, float], octaves: int = 4
) -> np.ndarray:
    """Smooth noise (H, W) float32, a sum of octaves, with mean about 0 and standard deviation about 1.

    `cell` is the size (rows, columns) in pixels of the coarsest octave.
    """
    import cv2

    total = np.zeros(shape, np.float32)
    for k in range(octaves):
        rows, cols = (min(max(2, int(np.ceil(n * 2**k / c)) + 1), n) for n, c in zip(shape, cell, strict=True))
        values = rng.standard_normal((rows, cols), dtype=np.float32)
        total += cv2.resize(values, shape[::-1], interpolation=cv2.INTER_CUBIC) * 0.6**k
    return total


def _canvas(width: float, height: float, colour: _Rgb, dot: float = DOT) -> np.ndarray:
    shape = (max(8, round(height / dot)), max(8, round(width / dot)), 3)
    return np.ascontiguousarray(np.broadcast_to(np.array(colour, np.uint8), shape))


def _tint(image: np.ndarray, amount: np.ndarray) -> np.ndarray:
    return np.clip(image.astype(np.float32) * (1.0 + amount[..., None]), 0, 255).astype(np.uint8)


def _ink(colour: _Rgb) -> _Rgb:
    """Black or white: the ink with the larger contrast to the background colour."""
    return (28, 26, 30) if 0.3 * colour[0] + 0.6 * colour[1] + 0.1 * colour[2] > 125 else (240, 238, 232)


def _write(image: np.ndarray, text: str, box: _Box, ink: _Rgb, bold: bool = True) -> None:
    """Write centred text that fills a box of the image."""
    import cv2

    x, y, width, height = box
    if width < 6 or height < 5:
        return
    font = cv2.FONT_HERSHEY_DUPLEX if bold else cv2.FONT_HERSHEY_SIMPLEX
    (w, h), _ = cv2.getTextSize(text, font, 1.0, 2)
    size = min(width / max(w, 1), 0.8 * height / max(h, 1))
    thick = max(1, round(size * (3.0 if bold else 1.5)))
    (w, h), _ = cv2.getTextSize(text, font, size, thick)
    cv2.putText(image, text, (x + (width - w) // 2, y + (height + h) // 2), font, size, ink, thick, cv2.LINE_AA)


def _lines(rng: np.random.Generator, image: np.ndarray, box: _Box, ink: _Rgb) -> None:
    """Draw small print: rows of short strokes."""
    import cv2

    x, y, width, height = box
    for row in range(y, y + height - 4, 9):
        at = x
        stop = x + width * (1.0 if rng.uniform() < 0.8 else 0.5)
        while at < stop - 8:
            word = int(rng.integers(6, 26))
            cv2.line(image, (at, row), (min(at + word, int(stop)), row), ink, 3, cv2.LINE_AA)
            at += word + 6


def _barcode(rng: np.random.Generator, image: np.ndarray, box: _Box) -> None:
    x, y, width, height = box
    image[y : y + height, x : x + width] = 238
    bars = np.repeat(rng.uniform(size=width // 3 + 1) < 0.5, 3)[:width]
    image[y + 4 : y + height - 4, x : x + width][:, bars] = 30


def _picture(rng: np.random.Generator, image: np.ndarray, centre: tuple[int, int], radius: int, pool: Pool) -> None:
    """Draw a plate of food: a heap of shaded ellipses."""
    import cv2

    ground = shade(rng, (0.7, 0.95), 0.35, pool)
    cv2.ellipse(image, centre, (radius, int(0.72 * radius)), 0, 0, 360, ground, -1, cv2.LINE_AA)
    r, g, b = colorsys.hsv_to_rgb(
        float(rng.uniform(0.0, 0.2)), float(rng.uniform(0.35, 0.8)), float(rng.uniform(0.45, 0.9))
    )
    base = 255.0 * np.array([r, g, b], np.float32)
    for _ in range(int(rng.integers(14, 34))):
        a, r = rng.uniform(0, 2 * np.pi), 0.75 * radius * np.sqrt(rng.uniform())
        at = (int(centre[0] + r * np.cos(a)), int(centre[1] + 0.65 * r * np.sin(a)))
        colour = np.clip(base * rng.uniform(0.55, 1.3) + rng.normal(0, 12, 3), 0, 255)
        axes = (max(2, int(radius * rng.uniform(0.08, 0.26))), max(2, int(radius * rng.uniform(0.06, 0.18))))
        turn = float(rng.uniform(0, 180))
        dark = tuple(int(0.6 * c) for c in colour)
        light = tuple(int(c) for c in colour)
        cv2.ellipse(image, (at[0] + 2, at[1] + 2), axes, turn, 0, 360, dark, -1, cv2.LINE_AA)
        cv2.ellipse(image, at, axes, turn, 0, 360, light, -1, cv2.LINE_AA)


def brand(rng: np.random.Generator, pool: Pool = ANY) -> tuple[str, str]:
    """A brand name and a product name."""
    return pool.name(rng, _WORDS), pool.name(rng, _KINDS)


def carton_face(
    rng: np.random.Generator,
    width: float,
    height: float,
    colours: tuple[_Rgb, _Rgb],
    words: tuple[str, str],
    role: str,
    pool: Pool = ANY,
) -> np.ndarray:
    """One face of a printed carton. `role` is "front", "back", "side" or "end"."""
    import cv2

    ground, second = colours
    image = _canvas(width, height, ground)
    h, w = image.shape[:2]
    ink = _ink(ground)
    if role in ("front", "back"):
        band = int(h * rng.uniform(0.16, 0.26))
        top = int(h * (0.06 if rng.uniform() < 0.6 else 0.62))
        slope = int(rng.integers(-h // 12, h // 12 + 1))
        corners = np.array([[0, top], [w, top + slope], [w, top + band + slope], [0, top + band]], np.int32)
        cv2.fillPoly(image, [corners], second, cv2.LINE_AA)
        if role == "front":
            middle = h * (0.64 if top < h / 2 else 0.32)
            _picture(rng, image, (int(w * rng.uniform(0.4, 0.6)), int(middle)), int(0.46 * min(w, 0.8 * h)), pool)
        else:
            first = top + band + abs(slope) + 8 if top < h / 2 else int(0.06 * h)
            _lines(rng, image, (int(0.08 * w), first, int(0.5 * w), int(0.45 * h)), ink)
            _picture(rng, image, (int(0.78 * w), first + h // 4), int(0.17 * w), pool)
        _write(image, words[0], (int(0.06 * w), top + slope // 2, int(0.88 * w), band), _ink(second))
        _write(image, words[1], (w // 4, int(0.90 * h) - 4, w // 2, int(0.09 * h)), ink, bold=False)
    elif role == "side":
        cv2.rectangle(image, (0, 0), (w, int(0.2 * h)), second, -1)
        _write(image, words[0], (3, 2, w - 6, int(0.18 * h)), _ink(second))
        panel = (int(0.12 * w), int(0.28 * h), int(0.76 * w), int(0.4 * h))
        cv2.rectangle(image, panel[:2], (panel[0] + panel[2], panel[1] + panel[3]), (232, 230, 224), -1)
        _lines(rng, image, (panel[0] + 5, panel[1] + 8, panel[2] - 10, panel[3] - 8), (60, 60, 66))
        _barcode(rng, image, (int(0.2 * w), int(0.76 * h), max(6, int(0.6 * w)), max(10, int(0.16 * h))))
    else:
        cv2.rectangle(image, (0, int(0.3 * h)), (w, int(0.7 * h)), second, -1)
        _write(image, words[0], (int(0.08 * w), int(0.32 * h), int(0.84 * w), int(0.36 * h)), _ink(second))
    return image


def label_side(
    rng: np.random.Generator,
    width: float,
    height: float,
    colours: tuple[_Rgb, _Rgb],
    words: tuple[str, str],
    pool: Pool = ANY,
) -> np.ndarray:
    """The unrolled label of a can or bottle: metal rims, bands, the name twice, a picture, and small print."""
    import cv2

    ground, second = colours
    image = _canvas(width, height, ground)
    h, w = image.shape[:2]
    ink = _ink(ground)
    low, high = sorted(rng.uniform(0.12, 0.88, 2))
    if high - low < 0.25:
        low, high = 0.3, 0.62
    cv2.rectangle(image, (0, int(low * h)), (w, int(high * h)), second, -1)
    for edge in (low, high):
        cv2.line(image, (0, int(edge * h)), (w, int(edge * h)), ink, max(2, h // 80))
    for k in range(2):
        x = int((0.06 + 0.5 * k) * w)
        _write(image, words[0], (x, int(low * h), int(0.36 * w), int((high - low) * h)), _ink(second))
        _write(image, words[1], (x, int(0.02 * h), int(0.3 * w), int(low * h * 0.8)), ink, bold=False)
        if k == 0:
            room = max(0.10, 1 - high) * h
            _picture(rng, image, (x + int(0.2 * w), int((high + (1 - high) / 2) * h)), int(0.9 * room), pool)
        else:
            _lines(rng, image, (x, int(high * h) + 8, int(0.3 * w), int((0.94 - high) * h)), ink)
    rim = max(2, round(0.003 / DOT))
    image[:rim] = image[-rim:] = (176, 176, 180)
    return image


def lid(rng: np.random.Generator, size: float, colour: _Rgb, ridges: bool, pool: Pool = ANY) -> np.ndarray:
    """The round end of a can: concentric ridges, or a plain printed lid."""
    import cv2

    image = _canvas(size, size, colour)
    n = image.shape[0]
    if ridges:
        y, x = np.mgrid[0:n, 0:n].astype(np.float32) - n / 2
        r = np.hypot(x, y) / (n / 2)
        image = _tint(image, 0.10 * np.sin(40 * r) * (r < 0.85) - 0.25 * ((r > 0.88) & (r < 0.93)))
    else:
        cv2.circle(image, (n // 2, n // 2), int(0.3 * n), shade(rng, pool=pool), -1, cv2.LINE_AA)
        cv2.circle(image, (n // 2, n // 2), int(0.44 * n), _ink(colour), max(2, n // 90), cv2.LINE_AA)
    return image


def wood(
    rng: np.random.Generator, width: float, height: float, colour: _Rgb | None = None, dot: float = DOT
) -> np.ndarray:
    """Texture of wood with the grain along the width. A pixel is `dot` metres wide."""
    if colour is None:
        r = rng.uniform(0.75, 1.0)
        colour = (int(215 * r), int(178 * r * rng.uniform(0.9, 1.03)), int(132 * r * rng.uniform(0.8, 1.1)))
    image = _canvas(width, height, colour, dot)
    h, w = image.shape[:2]
    bend = noise(rng, (h, w), (0.05 / dot, 0.20 / dot), 2)
    rows = np.arange(h, dtype=np.float32)[:, None] * dot
    rings = np.sin(2 * np.pi * (rows / 0.011 + 0.55 * bend))
    fibre = noise(rng, (h, w), (0.0018 / dot, 0.09 / dot), 2)
    return _tint(image, 0.035 * rings + 0.03 * fibre + 0.02 * bend)


def cloth(rng: np.random.Generator, width: float, height: float, pool: Pool = ANY) -> np.ndarray:
    """Cloth with a checked weave."""
    ground, second = shade(rng, (0.5, 0.9), 0.5, pool), shade(rng, (0.3, 0.8), 0.6, pool)
    image = _canvas(width, height, ground)
    h, w = image.shape[:2]
    step = rng.uniform(0.010, 0.022) / DOT
    y, x = np.mgrid[0:h, 0:w].astype(np.float32)
    share = (((x / step) % 1 < 0.35).astype(np.float32) + ((y / step) % 1 < 0.35)) / 2
    mixed = image * (1 - share[..., None]) + np.array(second, np.float32) * share[..., None]
    thread = 0.06 * np.sin(2 * np.pi * x / 5.0) * np.sin(2 * np.pi * y / 5.0)
    return _tint(np.clip(mixed, 0, 255).astype(np.uint8), thread + 0.03 * noise(rng, (h, w), (30, 30), 3))


def speckle(
    rng: np.random.Generator, width: float, height: float, colours: tuple[_Rgb, _Rgb], dot: float = DOT
) -> np.ndarray:
    """Stone or foam: two colours mixed by noise of several scales."""
    image = _canvas(width, height, colours[0], dot)
    h, w = image.shape[:2]
    share = 1.0 / (1.0 + np.exp(-3.0 * noise(rng, (h, w), (0.016 / dot, 0.016 / dot), 4)))
    mixed = image * (1 - share[..., None]) + np.array(colours[1], np.float32) * share[..., None]
    return np.clip(mixed, 0, 255).astype(np.uint8)


def glaze(
    rng: np.random.Generator, width: float, height: float, colours: tuple[_Rgb, _Rgb], motif: int
) -> np.ndarray:
    """Glazed ceramic: plain (motif 0), with stripes (1) or with dots (2)."""
    import cv2

    image = _canvas(width, height, colours[0])
    h, w = image.shape[:2]
    if motif == 1:
        for band in (0.16, 0.26, 0.8):
            cv2.rectangle(image, (0, int(band * h)), (w, int((band + 0.06) * h)), colours[1], -1)
    elif motif == 2:
        columns = max(3, round(width / 0.03))
        for i in range(columns):
            for j in range(max(1, round(height / 0.026))):
                at = (int((i + 0.5 + 0.5 * (j % 2)) * w / columns) % w, int((j + 0.5) * 0.026 / DOT))
                cv2.circle(image, at, int(0.006 / DOT), colours[1], -1, cv2.LINE_AA)
    return _tint(image, 0.015 * noise(rng, (h, w), (60, 60), 3))


def plastic(rng: np.random.Generator, width: float, height: float, colour: _Rgb) -> np.ndarray:
    """Painted or moulded plastic: one colour with faint scratches."""
    image = _canvas(width, height, colour)
    h, w = image.shape[:2]
    return _tint(image, 0.012 * noise(rng, (h, w), (50, 50), 3) + 0.01 * noise(rng, (h, w), (3, 60), 1))


def metal(rng: np.random.Generator, width: float, height: float, grey: int) -> np.ndarray:
    """Brushed metal."""
    image = _canvas(width, height, (grey, grey, min(255, grey + 3)))
    h, w = image.shape[:2]
    return _tint(image, 0.05 * noise(rng, (h, w), (2, 120), 2) + 0.05 * noise(rng, (h, w), (80, 80), 2))


def peel(rng: np.random.Generator, width: float, height: float, colour: _Rgb) -> np.ndarray:
    """Fruit peel: one colour with brown freckles."""
    image = _canvas(width, height, colour)
    h, w = image.shape[:2]
    freckle = np.clip(noise(rng, (h, w), (0.01 / DOT, 0.02 / DOT), 4) - 1.3, 0, 1)
    return _tint(image, -0.5 * freckle + 0.03 * noise(rng, (h, w), (80, 80), 2))
