"""Border models and judges of seams that were fitted without some of the real frames."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

from safetensors.numpy import load_file
from sequences import FOLDS

from mstfilter.base.trained import open_model, write_model

HERE = Path(__file__).resolve().parent

#: Tensors of the corrections of the border model by fold (../segmentation_fit/correction.py)
CORRECTIONS = load_file(HERE / "folds.safetensors")
#: Folders with the judges of seams that were trained without the images of a source
JUDGES = {source: str(HERE.parent / "seams" / "folds" / source) for source in ("hots", "osd")}
_SCRATCH = tempfile.TemporaryDirectory()


def border_model(sequence: str, by_sequence: bool = False) -> str:
    """A folder with the border model whose correction was fitted without the camera set-up of a sequence.

    With `by_sequence`, the correction for a sequence of HOTS was fitted with the other sequences of the same camera.
    The packaged model is returned for a sequence that no correction was fitted to. The folder exists until the
    process ends.
    """
    folds = [fold for fold, left_out in FOLDS.items() if sequence in left_out]
    return _written(folds[-1 if by_sequence else 0]) if folds else "border"


@cache
def _written(fold: str) -> str:
    model, folder = open_model("border"), Path(_SCRATCH.name) / fold.replace(", ", "-")
    own = {name.removeprefix(f"{fold}/"): t for name, t in CORRECTIONS.items() if name.startswith(f"{fold}/")}
    write_model(folder, model.description, {**model.tensors, **own})
    return str(folder)
