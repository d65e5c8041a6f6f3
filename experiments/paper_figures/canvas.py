"""Shared parts of the figures: pages of panels, voxel pictures, tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mstfilter.app.report import Colour, close_up, voxel_picture
from mstfilter.base.files import write_csv
from mstfilter.scene import Camera, VoxelGrid

PAPER, INK, MUTED, LINE = "#fcfcfa", "#1d2126", "#646b74", "#e1e2e0"


def page(rows: int, columns: int, width: float, height: float, **layout: Any) -> tuple[Figure, np.ndarray]:
    """A figure of `width` x `height` inches, and its axes (rows, columns)."""
    figure = Figure((width, height), layout="constrained", facecolor=PAPER)
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, gridspec_kw=layout or None)
    for a in axes.ravel():
        a.set_facecolor(PAPER)
    return figure, axes


def show(axes: Axes, image: np.ndarray, title: str = "") -> None:
    """Show a picture without axes."""
    axes.imshow(image, interpolation="antialiased")
    axes.set_axis_off()
    axes.set_title(title)


def voxels(labels: np.ndarray, grid: VoxelGrid, view: Camera, colours: Mapping[int, Colour]) -> np.ndarray:
    """Picture (h, w, 3) uint8 of voxels seen by the camera `view`, on the colour of the page."""
    picture = voxel_picture(np.asarray(labels).astype(np.uint16), grid, view, colours)
    alpha = picture[..., 3:] / 255
    paper = np.array([int(PAPER[k : k + 2], 16) for k in (1, 3, 5)])
    return np.rint(picture[..., :3] * alpha + paper * (1 - alpha)).astype(np.uint8)


def save(figure: Figure, path: Path, dpi: int = 100) -> Path:
    """Write the figure. Equal figures give files with equal bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi, metadata={"Software": None})
    return path


def write_rows(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> Path:
    """Write a CSV file; floats with three digits after the point."""
    texts = ([f"{v:.3f}" if isinstance(v, float) else v for v in row] for row in rows)
    write_csv(path, [dict(zip(columns, row, strict=True)) for row in texts], columns)
    return path


def crop(labels: np.ndarray, grid: VoxelGrid, camera: Camera) -> tuple[slice, slice]:
    """Rows and columns of the part of the image that shows all objects, with the proportions of the image."""
    x, y, width, height = close_up([(labels, grid)], camera)
    return slice(round(y), round(y + height)), slice(round(x), round(x + width))
