"""Trackers of masks for the motion rules, by the packages of their authors: SAM 2, EdgeTAM and Cutie.

>>> overrides = "transition.tracker=sam2", "transition.tracker.checkpoint=sam2.1_hiera_tiny.pt"
>>> filter = mstfilter.preset("mst", *overrides)

A tracker follows the masks of all distinct segments to the last frame of a clip. The motion rules then search for the
object in these masks instead of the end points of the optical flow (paper, section IV-C).

SAM 2: Ravi et al., 2024, https://github.com/facebookresearch/sam2 (Apache-2.0, weights too). EdgeTAM has a package
with the same name and interface. Cutie: Cheng et al., CVPR 2024, https://github.com/hkchengrex/Cutie (MIT). The user
supplies the package and the checkpoint. The adapters were tested only with substitutes for the packages.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from mstfilter.errors import InputError, MissingLibraryError, describe_error
from mstfilter.fields import PositiveInt
from mstfilter.files import weights_file
from mstfilter.scene import Clip, Frame, Recording, UsesFiles
from mstfilter.tracking import MaskTracker

_SAM2, _CUTIE = "https://github.com/facebookresearch/sam2", "https://github.com/hkchengrex/Cutie"


def thinned(clip: Clip, step: int) -> list[Frame]:
    """Every `step`-th frame of a clip, and the last frame."""
    return [*list(clip.frames)[: len(clip.frames) - 1 : step], clip.after]


@dataclass(frozen=True)
class PackageTracker(MaskTracker, UsesFiles):
    """A tracker of another package.

    Parameters
    ----------
    checkpoint : str
        Path of a checkpoint.
    device : str
        Device of torch.
    step : int
        Every `step`-th frame and the last frame are used.
    sha256 : str
        Expected hash of the file; if empty, it is not compared.
    """

    checkpoint: str = ""
    device: str = "cpu"
    step: PositiveInt = 1
    sha256: str = ""

    def check_files(self, recording: Recording) -> None:
        """Load the checkpoint."""
        self.loaded()

    @abstractmethod
    def loaded(self) -> Any:
        """The object that the package loads from the checkpoint."""


@dataclass(frozen=True)
class Sam2Tracker(PackageTracker):
    """The video predictor of the package ``sam2`` (SAM 2, or EdgeTAM, whose package has the same name).

    All masks are tracked together, with one pass of the image encoder for each frame. `config` is the name of the
    checkpoint's configuration in the package. Further parameters: `PackageTracker`.
    """

    config: str = "configs/sam2.1/sam2.1_hiera_t.yaml"

    def loaded(self) -> Any:
        file = weights_file(self.checkpoint, "SAM 2", _SAM2, self.sha256)
        with loading("sam2", file[0]):
            return _load_sam2(self.config, *file, self.device)

    def track(self, clip: Clip, masks: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Masks (H, W) bool of the last frame. Raises InputError if the package or the checkpoint is missing."""
        predictor, frames = self.loaded(), thinned(clip, self.step)
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
    """The video predictor. The last predictor is cached."""
    build = imported("sam2.build_sam", _SAM2).build_sam2_video_predictor
    return build(config, checkpoint, device=device)


def _write_jpeg(path: Path, rgb: np.ndarray) -> None:
    import cv2

    if not cv2.imwrite(str(path), rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100]):
        raise InputError(f"image cannot be written: {path}")


@dataclass(frozen=True)
class CutieTracker(PackageTracker):
    """The tracker of the package ``cutie``.

    Masks that do not overlap are tracked together, and every frame is encoded once.

    Parameters: `PackageTracker`.
    """

    def loaded(self) -> tuple[Any, Any]:
        file = weights_file(self.checkpoint, "Cutie", _CUTIE, self.sha256)
        with loading("cutie", file[0]):
            return _load_cutie(*file, self.device)

    def track(self, clip: Clip, masks: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Masks (H, W) bool of the last frame. Raises InputError if the package or the checkpoint is missing."""
        (network, config), frames = self.loaded(), thinned(clip, self.step)
        if len(frames) == 1:
            return [mask.astype(bool) for mask in masks]
        import torch

        core = import_module("cutie.inference.inference_core").InferenceCore
        store = import_module("cutie.inference.image_feature_store").ImageFeatureStore(network)
        images = [
            torch.from_numpy(frame.rgb.transpose(2, 0, 1).copy()).float().to(self.device) / 255 for frame in frames
        ]
        found = [np.zeros(mask.shape, dtype=bool) for mask in masks]
        groups = disjoint_groups(masks)
        with torch.inference_mode():
            for number, group in enumerate(groups):
                last = {"delete_buffer": number == len(groups) - 1}  # else the features serve the next group
                tracker = core(network, cfg=config, image_feature_store=store)
                labels = np.zeros(clip.before.depth.shape, np.int64)
                for label, k in enumerate(group, start=1):
                    labels[masks[k]] = label
                objects = list(range(1, len(group) + 1))
                chance = tracker.step(images[0], torch.from_numpy(labels).to(self.device), objects=objects, **last)
                for image in images[1:]:
                    chance = tracker.step(image, **last)
                best = chance.argmax(dim=0).cpu().numpy()  # 0 is the background
                for label, k in enumerate(group, start=1):
                    found[k] = best == label
        return found


@lru_cache(maxsize=1)
def _load_cutie(checkpoint: str, digest: str, device: str) -> tuple[Any, Any]:
    """Network and configuration with the package's defaults, without its download. The last network is cached."""
    module = imported("cutie.model.cutie", _CUTIE)
    hydra, omegaconf = imported("hydra", _CUTIE), imported("omegaconf", _CUTIE)
    import torch

    folder = Path(module.__file__).resolve().parents[1] / "config"
    with hydra.initialize_config_dir(version_base="1.3.2", config_dir=str(folder)):
        config = hydra.compose(config_name="eval_config")
    with omegaconf.open_dict(config):
        config["weights"] = checkpoint
    imported("cutie.inference.utils.args_utils", _CUTIE).get_dataset_cfg(config)
    network = module.CUTIE(config).to(device).eval()
    network.load_weights(torch.load(checkpoint, map_location=device, weights_only=True))
    return network, config


def disjoint_groups(masks: Sequence[np.ndarray]) -> list[list[int]]:
    """Numbers of the non-empty masks, in groups without common pixels. Each mask joins the first suitable group."""
    groups: list[list[int]] = []
    unions: list[np.ndarray] = []
    for k, mask in enumerate(masks):
        if not mask.any():
            continue
        fits = next((g for g, union in enumerate(unions) if not (union & mask).any()), None)
        if fits is None:
            groups.append([k])
            unions.append(mask.astype(bool))
        else:
            groups[fits].append(k)
            unions[fits] = unions[fits] | mask
    return groups


@contextmanager
def loading(package: str, checkpoint: str) -> Iterator[None]:
    """Raise InputError if a package fails to load a checkpoint in the block."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # of the package: any
        cause = f"{describe_error(error)}\n".splitlines()[0]
        raise InputError(
            f"the package {package} cannot load {checkpoint}: {cause}", "is it a checkpoint of this network and size?"
        ) from error


def imported(module: str, where: str) -> Any:
    """A module of another package; raises MissingLibraryError if it cannot be imported."""
    try:
        return import_module(module)
    except ImportError as error:
        raise MissingLibraryError(f"{module} cannot be imported: {error}", f"install it as {where} says") from error
