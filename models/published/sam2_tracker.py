"""A tracker of masks for the motion rules, through the package of its authors: SAM 2, or EdgeTAM.

>>> overrides = "transition.tracker=sam2", "transition.tracker.checkpoint=sam2.1_hiera_tiny.pt"
>>> filter = mstfilter.preset("mst", *overrides)

A tracker follows the masks of all distinct segments to the last frame of a clip. The motion rules then search for the
object in these masks instead of the end points of the optical flow (paper, section IV-C).

SAM 2: Ravi et al., 2024, https://github.com/facebookresearch/sam2 (Apache-2.0, weights too). EdgeTAM has a package of
the same name and interface. The user supplies package and checkpoint. The adapter was checked with a stand-in of the
package, not with the package. For another tracker, inherit `mstfilter.mst.tracking.MaskTracker`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, MissingLibraryError, describe_error
from mstfilter.base.fields import PositiveInt
from mstfilter.base.trained import weights_file
from mstfilter.mst.tracking import MaskTracker
from mstfilter.scene import Clip, Recording, UsesFiles

_SAM2 = "https://github.com/facebookresearch/sam2"


@dataclass(frozen=True)
class Sam2Tracker(MaskTracker, UsesFiles):
    """The video predictor of the package ``sam2`` (SAM 2, or EdgeTAM, whose package has the same name).

    All masks are tracked together, with one pass of the image encoder for each frame.

    Parameters
    ----------
    checkpoint : str
        Path of a checkpoint.
    device : str
        Device of torch.
    step : int
        Every `step`-th frame is used, and the last one.
    config : str
        Name of the configuration of the checkpoint in the package.
    """

    checkpoint: str = ""
    device: str = "cpu"
    step: PositiveInt = 1
    config: str = "configs/sam2.1/sam2.1_hiera_t.yaml"

    def check_files(self, recording: Recording) -> None:
        """Load the checkpoint."""
        self.loaded()

    def loaded(self) -> Any:
        """The video predictor. Raises InputError if the package or the checkpoint cannot be used."""
        return _load_sam2(self.config, *weights_file(self.checkpoint, "SAM 2", _SAM2), self.device)

    def track(self, clip: Clip, masks: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Masks (H, W) bool of the last frame. Raises InputError if the package or the checkpoint is missing."""
        predictor = self.loaded()
        frames = [*list(clip.frames)[: len(clip.frames) - 1 : self.step], clip.after]
        if len(frames) == 1:
            return [mask.astype(bool) for mask in masks]
        found = [np.zeros(mask.shape, dtype=bool) for mask in masks]
        with TemporaryDirectory() as folder:
            for k, frame in enumerate(frames):  # the predictor reads numbered JPEG files
                _write_jpeg(Path(folder) / f"{k:05d}.jpg", frame.rgb)
            state = predictor.init_state(video_path=folder)
            numbers = [k for k, mask in enumerate(masks) if mask.any()]
            for k in numbers:
                predictor.add_new_mask(inference_state=state, frame_idx=0, obj_id=k, mask=masks[k].astype(bool))
            for index, objects, logits in predictor.propagate_in_video(state) if numbers else ():
                if index == len(frames) - 1:
                    for k, logit in zip(objects, logits, strict=True):
                        found[k] = (logit[0] > 0).cpu().numpy()
        return found


@lru_cache(maxsize=1)
def _load_sam2(config: str, checkpoint: str, digest: str, device: str) -> Any:
    """The video predictor; the last one is kept."""
    try:
        build = import_module("sam2.build_sam").build_sam2_video_predictor
    except ImportError as error:
        raise MissingLibraryError(f"sam2 cannot be imported: {error}", f"install it as {_SAM2} says") from error
    try:
        return build(config, checkpoint, device=device)
    except Exception as error:  # of the package: any
        cause = f"{describe_error(error)}\n".splitlines()[0]
        raise InputError(
            f"the package sam2 cannot load {checkpoint}: {cause}", "is it a checkpoint of this network and size?"
        ) from error


def _write_jpeg(path: Path, rgb: np.ndarray) -> None:
    import cv2

    if not cv2.imwrite(str(path), rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100]):
        raise InputError(f"image cannot be written: {path}")
