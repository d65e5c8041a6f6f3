"""Trained networks on disk: a folder with weights (safetensors), a description (TOML) and a model card.

>>> model = open_model("completion")              # of the package; or the path of a folder
>>> model.description["network"], model.tensors["head.bias"].shape
>>> write_model(folder, {"architecture": "completion-unet", "network": {...}}, tensors)

`model.toml` names the architecture and has a SHA-256 hash of `weights.safetensors`. A folder is refused if the hash
does not match. Weights are stored in half precision. No file is unpickled.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar, cast

import numpy as np

from mstfilter.base.errors import InputError, check_integer, reason
from mstfilter.base.files import atomic_path, write_text
from mstfilter.base.reading import MAX_WEIGHTS, read_bytes, read_toml
from mstfilter.base.resources import models_folder

WEIGHTS, DESCRIPTION = "weights.safetensors", "model.toml"
_MOST_FEATURES = 2**16  # of a layer
_HINT = "train it with: mstfilter train completion, border or seams --out FOLDER; others are written by write_model"


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Use one thread of torch in the block, because sums of convolutions depend on the number of threads."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A network's weights and their description."""

    folder: Path
    description: Mapping[str, Any]  #: contents of ``model.toml``
    tensors: Mapping[str, np.ndarray]  #: name -> float32
    key: str  #: hash of description and weights

    def split(self, prefix: str) -> tuple[Self, Self]:
        """The model without the tensors whose names begin with `prefix`, and the model with only these tensors."""
        parts: tuple[dict[str, np.ndarray], dict[str, np.ndarray]] = ({}, {})
        for name, tensor in self.tensors.items():
            parts[name.startswith(prefix)][name] = tensor
        return replace(self, tensors=parts[0]), replace(self, tensors=parts[1])

    def check_tensors(self, expected: Mapping[str, tuple[int, ...]]) -> None:
        """Raise InputError unless the tensors have the names and shapes of the architecture."""
        found = {name: tuple(t.shape) for name, t in self.tensors.items()}
        wrong = sorted(set(found) ^ set(expected)) or sorted(n for n in found if found[n] != tuple(expected[n]))
        if wrong:
            name = wrong[0]
            raise InputError(
                f"{self.folder / WEIGHTS}: tensor {name!r} is {found.get(name, 'missing')}, "
                f"the architecture has {expected.get(name, 'none')}",
                f"{DESCRIPTION} and {WEIGHTS} must come from the same training",
            )


def _folder(name: str) -> Path:
    given, packaged = Path(name), models_folder() / name
    return packaged if (given.name == name and packaged.is_dir()) or not given.is_dir() else given


_Load = TypeVar("_Load", bound=Callable[..., Any])


def load_once(load: _Load) -> _Load:
    """Cache `load(name, ...)` until a file of the model changes. `name` is a model, its folder, or one file."""

    @functools.lru_cache(maxsize=4)
    def of_version(_version: tuple[tuple[str, int, int], ...], *arguments: Any) -> Any:
        return load(*arguments)

    @functools.wraps(load)
    def found(name: str, *others: Any) -> Any:
        files = [Path(name)] if Path(name).is_file() else sorted(_folder(name).glob("*"))
        stats = [(str(file), file.stat()) for file in files if file.is_file()]  # a link to itself is no file
        return of_version(tuple((file, stat.st_mtime_ns, stat.st_size) for file, stat in stats), name, *others)

    found.cache_clear = of_version.cache_clear  # type: ignore[attr-defined]
    return cast(_Load, found)


def open_model(name: str, architecture: str | None = None) -> TrainedModel:
    """The model in the package that has this name, or else the model in the folder with this path.

    Raises InputError if the model is missing, damaged, or of another architecture.
    """
    given, folder = Path(name), _folder(name)
    for file in (DESCRIPTION, WEIGHTS):
        if not (folder / file).is_file():
            where = f"in the folder {given}" if folder == given else f"in the package, and no folder {name!r}"
            raise InputError(f"trained model {name!r}: there is no {file} {where}", _HINT)
    text = read_bytes(folder / DESCRIPTION, "a trained model", _HINT)
    description = read_toml(folder / DESCRIPTION, "a trained model", _HINT)
    if architecture is not None and description.get("architecture") != architecture:
        raise InputError(
            f"{folder / DESCRIPTION}: architecture is {description.get('architecture')!r}, expected {architecture!r}",
            "name a model that was trained for this component",
        )
    data = read_bytes(folder / WEIGHTS, "a trained model", _HINT, limit=MAX_WEIGHTS)
    found = hashlib.sha256(data).hexdigest()
    if found != description.get("sha256"):
        raise InputError(
            f"{folder / WEIGHTS}: SHA-256 is {found[:16]}..., not as in {DESCRIPTION}",
            "the file is damaged or belongs to another description; copy both files again",
        )
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        tensors = {key: value.astype(np.float32) for key, value in load(data).items()}
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder / WEIGHTS} is not a safetensors file: {error}", _HINT) from None
    for key, value in tensors.items():
        if not np.isfinite(value).all():
            raise InputError(f"{folder / WEIGHTS}: tensor {key!r} has a value that is not finite", _HINT)
    return TrainedModel(folder, description, tensors, hashlib.sha256(text + data).hexdigest()[:16])


def weights_file(given: str, name: str, where: str) -> tuple[str, str]:
    """Absolute path and SHA-256 of a file of weights that the user supplies for a network `name`.

    Raises InputError if the file is not given or does not exist. The hint refers to the address `where`. The hash of
    an unchanged file is computed once.
    """
    path = Path(given)
    if not given or not path.is_file():
        problem = f"do not exist: {path}" if given else "are not given"
        raise InputError(f"the weights of {name} {problem}", f"set the field to the path of a file, see {where}")
    status = path.stat()
    return str(path.resolve()), _sha256(str(path.resolve()), status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=8)
def _sha256(path: str, modified: int, size: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def layer_size(network: Mapping[str, Any], name: str, at_least: int = 1) -> int:
    """A size in the table ``network`` of a description. Raises InputError unless it is a possible integer."""
    check_integer(f"network.{name}", network[name], at_least=at_least, at_most=_MOST_FEATURES)
    return int(network[name])


def calibrated_network(
    model: TrainedModel, channels: Sequence[str], build: Callable[[Mapping[str, Any]], Any]
) -> tuple[Any, float, float]:
    """The torch network of a model with its weights, and the scale and shift of the network's logits.

    ``build(values)`` makes the network from the table ``network`` of the description. Raises InputError if the
    description is incomplete, was made for other input channels, or does not match the weights.
    """
    import torch

    network = model.description.get("network", {})
    where = f"{model.folder / DESCRIPTION}"
    try:
        if list(network["channels"]) != list(channels):
            raise InputError(f"{where}: channels {network['channels']}, this version has {list(channels)}")
        with torch.device("meta"):  # sizes without memory
            planned = build(network)
        calibration = model.description["calibration"]
        scale, shift = float(calibration["scale"]), float(calibration["shift"])
    except InputError as error:
        raise InputError(f"{where}: {error.message.removeprefix(f'{where}: ')}", "train the model again") from None
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        fact = f"{where} describes no network: {reason(error).splitlines()[0]}"
        raise InputError(fact, "train the model again") from None
    model.check_tensors({name: tuple(t.shape) for name, t in planned.state_dict().items()})
    net = build(network)
    net.load_state_dict({name: torch.from_numpy(t) for name, t in model.tensors.items()})
    return net.eval(), scale, shift


def write_model(folder: str | Path, description: Mapping[str, Any], tensors: Mapping[str, np.ndarray]) -> None:
    """Write weights in half precision, and the description with the hash of the weights."""
    from safetensors.numpy import save

    data = save({name: np.ascontiguousarray(value, dtype=np.float16) for name, value in tensors.items()})
    target = Path(folder)
    with atomic_path(target / WEIGHTS) as partial:
        partial.write_bytes(data)
    write_text(target / DESCRIPTION, _toml({**description, "sha256": hashlib.sha256(data).hexdigest()}))


def _toml(values: Mapping[str, Any]) -> str:
    """The text of a TOML file: plain values first, then one table for each mapping."""
    lines = [f"{key} = {_value(value)}" for key, value in values.items() if not isinstance(value, Mapping)]
    for key, table in values.items():
        if isinstance(table, Mapping):
            lines += ["", f"[{key}]", *(f"{name} = {_value(value)}" for name, value in table.items())]
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    """The text of a value in TOML. Strings, numbers, booleans and lists have the same syntax in TOML and JSON."""
    return json.dumps(value, ensure_ascii=False, default=lambda number: number.item())
