"""Hostile inputs of every kind that the package reads: valid examples, and ways to spoil them.

>>> kind = KINDS["recording"]
>>> kind.write(path)                  # a valid one
>>> spoil(rng, path)                  # one change that a damaged disk or a stranger makes
>>> kind.read(path)                   # succeeds or raises InputError

`tests/test_strangers.py` does this a few times for each kind, `experiments/reliability/fuzz_inputs.py` often.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.app.report import run_page, write_report, write_study_report
from mstfilter.base.errors import InputError
from mstfilter.base.reading import read_bytes
from mstfilter.base.trained import open_model, write_model
from mstfilter.formats import RecordingWriter, open_recording, write_image
from mstfilter.mst.completion import NetworkCompleter
from mstfilter.mst.frontends import read_masks, write_masks
from mstfilter.mst.frontends.completions import place_shape, read_shapes
from mstfilter.runs import RunFolder
from mstfilter.runs.presets import build_filter, load_config
from mstfilter.runs.study import StudyFolder, check_arm_names, load_study
from mstfilter.scoring import NO_COUNTS
from mstfilter.smc import Key, Population, State, load_state, save_state
from tests.app.report.runs import make_run
from tests.app.report.test_study_report import make_study
from tests.formats import bags, layouts
from tests.scene.scenes import CAMERA, GRID, table_scene


@dataclass(frozen=True)
class Kind:
    """A kind of input: how a valid one is written, and what reads it completely."""

    write: Callable[[Path], Any]
    read: Callable[[Path], Any]


def _write_recording(path: Path) -> None:
    rng = np.random.default_rng(0)
    with RecordingWriter(path, CAMERA, GRID, name="boxes") as writer:
        for index, shift in enumerate((0, 1, 2)):
            rgb, depth, labels = table_scene(shift, rng)
            more = {"instance": np.zeros(depth.shape, np.uint8), "robot_mask": depth > 9, "poses": {1: np.eye(4)}}
            writer.add_frame(rgb, depth, index / 5, "action" if index == 1 else "static", **more)
            if index != 1:
                writer.add_voxels(labels)


def _reader(name: str, *options: str) -> Callable[[Path], None]:
    def read(path: Path) -> None:
        recording = open_recording(path, name, options)
        recording.check()
        _ = recording.truth_key

    return read


def _layout(name: str) -> Callable[[Path], Any]:
    return partial(getattr(layouts, f"write_{name}"), shifts=(0, 0, 3, 3))


def _bag(kind: str) -> Callable[[Path], Any]:
    return lambda path: bags.write(path / "it", kind, bags.scene_messages(kind == "bag", shifts=(0, 0, 3, 3)))


def _read_bag(path: Path) -> None:
    found = sorted(path.glob("it*"))
    _reader("bag", "pauses=every")(found[0] if found else path / "it.bag")


def _read_bop(path: Path) -> None:
    recording = open_recording(path, "layout", ["layout=bop", "pauses=every"])
    recording.check()
    recording.instance(1)


def _write_run(path: Path) -> None:
    make_run(path, 2)


def _read_run(path: Path) -> None:
    RunFolder.open(path).estimates()


def _draw_run(path: Path) -> None:
    write_report(path, path.parent / "report.html")
    run_page(path).save(path.parent / "page.html")


def _write_preset(path: Path) -> None:
    path.mkdir()
    text = 'base = "mst"\nn = 5\nresampler = "systematic"\n[update]\ncomponent = "partition"\n'
    (path / "mine.toml").write_text(text, encoding="utf-8")


def _read_preset(path: Path) -> None:
    build_filter(load_config(str(path / "mine.toml"), allow_files=False))


def _write_study(path: Path) -> None:
    path.mkdir()
    text = '[[arms]]\npreset = "mst"\nset = ["n=3,5"]\n[[scenes]]\nfamily = "s1"\nseeds = [0, 1]\n'
    (path / "mine.toml").write_text(text, encoding="utf-8")


def _read_study(path: Path) -> None:
    check_arm_names(load_study(path / "mine.toml"))


def _write_study_folder(path: Path) -> None:
    make_study(path, n_scenes=2, arms=("a", "b"), groups=("s",), fail=False)
    for folder in (path / "runs").iterdir():
        np.savez_compressed(folder / "forecasts.npz", counts=np.zeros((3, 1, *NO_COUNTS.shape), np.int64))


def _read_study_folder(path: Path) -> None:
    StudyFolder.open(path).summary()
    write_study_report(path, path.parent / "study.html")


@cache
def _tensors() -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    model = open_model("completion")
    return dict(model.description), dict(model.tensors)


def _write_weights(path: Path) -> None:
    write_model(path, *_tensors())


def _read_weights(path: Path) -> None:
    from mstfilter.mst.completion.unet import load_network  # imports torch

    load_network.cache_clear()
    _ = NetworkCompleter(weights=str(path)).network


def _write_masks(path: Path) -> None:
    labels = np.zeros((60, 80), np.uint8)
    labels[10:20, 10:20], labels[30:40, 30:50] = 1, 2
    write_masks(path, 0, [labels, (labels > 0).astype(np.uint8)], weights=[0.7, 0.3])
    write_image(path / "000001.png", labels)


def _read_masks(path: Path) -> None:
    errors = []
    for pause in range(2):
        try:
            read_masks(path, pause, (60, 80))
        except InputError as error:
            errors.append(error)
    if errors:
        raise errors[0]


def _write_shapes(path: Path) -> None:
    folder = path / "000000" / "a"
    folder.mkdir(parents=True)
    write_image(folder / "mask.png", np.full((60, 80), 255, np.uint8))
    np.savez(folder / "x.npz", points=GRID.centres()[20:25, 20:25, :5].reshape(-1, 3))
    np.savez_compressed(folder / "y.npz", occupancy=np.ones((5, 5, 5)), origin=np.zeros(3), voxel_size=0.01)
    (folder / "weights.json").write_text('{"x.npz": 1, "y.npz": 2}', encoding="utf-8")


def _read_shapes(path: Path) -> None:
    for shapes in read_shapes(path, 0, (60, 80)):
        for file in shapes.files:
            place_shape(file, read_bytes(file, "a shape"), np.eye(4), GRID)


def _write_checkpoint(path: Path) -> None:
    path.mkdir()
    save_state(path / "state.npz", State(1, Population({"x": np.zeros((4, 2))}, np.zeros(4), {}), Key(0), True))


def _read_checkpoint(path: Path) -> None:
    load_state(path / "state.npz")


#: Every kind of input, by name.
KINDS = {
    "recording": Kind(_write_recording, _reader("")),
    "run": Kind(_write_run, _read_run),
    "report": Kind(_write_run, _draw_run),
    "preset": Kind(_write_preset, _read_preset),
    "study": Kind(_write_study, _read_study),
    "study folder": Kind(_write_study_folder, _read_study_folder),
    "weights": Kind(_write_weights, _read_weights),
    "masks": Kind(_write_masks, _read_masks),
    "shapes": Kind(_write_shapes, _read_shapes),
    "checkpoint": Kind(_write_checkpoint, _read_checkpoint),
    "tum": Kind(_layout("tum"), _reader("tum", "K=131,131,79.5,59.5", "pauses=every")),
    "redwood": Kind(_layout("redwood"), _reader("redwood", "pauses=every")),
    "stray": Kind(_layout("stray"), _reader("layout", "pauses=every")),
    "bop": Kind(_layout("bop"), _read_bop),
    "bag": Kind(_bag("bag"), _read_bag),
    "mcap": Kind(_bag("mcap"), _read_bag),
}

_VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 3, 1e308, -1e308, float("nan"), float("inf"), 10**18, 10**400, 2**63),
    *("", "x", "../../../../etc/passwd", "/dev/zero", "\x1b[2J\x1b]0;x\x07", "\u202e\u0000", "x" * 10**5),
    *([], {}, [[]], [None], {"x": 1}, [1, 2, 3], [[1.5] * 4] * 4, list(range(10**4))),
)


def spoil(rng: np.random.Generator, path: Path) -> str:
    """Make one change to the files below a folder; returns what was done, for messages."""
    files = sorted(p for p in path.rglob("*") if p.is_file() and not p.is_symlink() and p.name != "SHA256SUMS")
    files = [p for p in files if p.stat().st_size < 2**28]
    if not files:
        return "nothing left"
    file = files[rng.integers(len(files))]
    ways = [way for way, suffixes in _WAYS.items() if not suffixes or file.suffix in suffixes]
    special = [way for way in ways if _WAYS[way]]
    chosen = special if special and rng.random() < 0.6 else ways
    way = chosen[rng.integers(len(chosen))]
    try:
        way(rng, file, files)
    except Exception:  # it was spoiled before
        way = _truncate
        way(rng, file, files)
    return f"{way.__name__[1:]} of {file.relative_to(path)}"


def _flip(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    data = np.frombuffer(file.read_bytes() or b"\0", np.uint8).copy()
    for at in rng.integers(0, len(data), rng.integers(1, 20)):
        data[at] ^= 1 << rng.integers(8)
    file.write_bytes(data.tobytes())


def _truncate(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    os.truncate(file, int(rng.integers(0, file.stat().st_size + 1)))


def _garbage(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    starts = (b"", b"\x89PNG\r\n\x1a\n", b"PK\x03\x04", b"\x93NUMPY\x01\x00", b"\xff\xd8\xff", b"{", b"\x80\x04")
    file.write_bytes(starts[rng.integers(len(starts))] + rng.bytes(int(rng.integers(0, 300))))


def _grow(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    os.truncate(file, 2**33)  # sparse


def _swap(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    file.write_bytes(files[rng.integers(len(files))].read_bytes())


def _remove(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    file.unlink()


def _replace(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    """By a folder, a pipe or a link."""
    file.unlink()
    targets = ("/dev/zero", "/dev/stdin", "/etc/passwd", str(file), "/nowhere", "/")
    way = int(rng.integers(2 + len(targets)))
    if way == 0:
        file.mkdir()
    elif way == 1:
        os.mkfifo(file)
    else:
        file.symlink_to(targets[way - 2])


def _rename(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    names = ("\x1b[31mred\x07", "\u202egnp", "a\nb", "-rf", "é" * 100, "..png", "999999999999999999999")
    file.rename(file.with_name(names[rng.integers(len(names))] + file.suffix))


def _json(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    """A value of JSON is replaced, or missing, or nested too deep."""
    data = json.loads(file.read_text(encoding="utf-8"))
    places: list[tuple[Any, Any]] = [(None, None)]

    def walk(value: Any) -> None:
        items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        for key, inner in items:
            places.append((value, key))
            walk(inner)

    walk(data)
    shallow = places[: 40 if rng.random() < 0.7 else None]
    holder, key = shallow[rng.integers(len(shallow))]
    value = _VALUES[rng.integers(len(_VALUES))]
    if rng.random() < 0.05:
        file.write_text("[" * 10**5 + "]" * 10**5, encoding="utf-8")
        return
    if holder is None:
        data = value
    elif isinstance(holder, dict) and rng.random() < 0.25:
        del holder[key]
    else:
        holder[key] = value
    file.write_text(json.dumps(data), encoding="utf-8")


def _toml(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    lines = file.read_text(encoding="utf-8").splitlines()
    texts = ('""', '"../x"', '"./evil.py:Evil"', "nan", "-1", "1e400", "[]", "{}", "true", '"\\u001b[2J"', "9" * 5000)
    values = (*texts, "[" * 5000, '["a=b=c", "=", "n="]', "{x = 1}", "1979-05-27")
    k = int(rng.integers(len(lines)))
    key, _, _ = lines[k].partition("=")
    added = ["a." * 3000 + "b = 1", "[update.completer]", 'base = "mine.toml"', "x = 1", "[[arms]]", "[smoke]"]
    lines[k] = (
        f"{key}= {values[rng.integers(len(values))]}" if rng.random() < 0.7 else added[rng.integers(len(added))]
    )
    file.write_text("\n".join(lines), encoding="utf-8")


def _words(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    """A word of a text file is replaced."""
    words = file.read_text(encoding="utf-8").split(" ")
    given = ("nan", "-1", "1e308", "../../../../etc/passwd", "/dev/zero", "\x1b[2J", "", "x\n" * 100, "9" * 5000)
    words[rng.integers(len(words))] = given[rng.integers(len(given))]
    file.write_text(" ".join(words), encoding="utf-8")


def png_header(width: int, height: int) -> bytes:
    """A PNG of a few bytes that announces a size."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = [b"\x89PNG\r\n\x1a\n", struct.pack(">I", 13), head, struct.pack(">I", zlib.crc32(head))]
    for name, body in ((b"IDAT", zlib.compress(bytes(10**6))), (b"IEND", b"")):
        parts += [struct.pack(">I", len(body)), name + body, struct.pack(">I", zlib.crc32(name + body))]
    return b"".join(parts)


def _png(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    sizes = ((30_000, 30_000), (2**31 - 1, 1), (1, 2**31 - 1), (0, 0), (8192, 8192), (160, 120))
    file.write_bytes(png_header(*sizes[rng.integers(len(sizes))]))


def bomb(shape: tuple[int, ...], dtype: str = "<u2", gigabytes: float = 0.0, name: str = "labels") -> bytes:
    """An .npz file of a few kilobytes with an array that announces a shape, or unpacks to many gigabytes."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": dtype, "fortran_order": False, "shape": shape})
    out = io.BytesIO()
    with (
        zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open(f"{name}.npy", "w", force_zip64=True) as member,
    ):
        member.write(head.getvalue())
        for _ in range(int(gigabytes * 64)):
            member.write(bytes(2**24))
    return out.getvalue()


def _npz(rng: np.random.Generator, file: Path, files: list[Path]) -> None:
    """An array gets another shape or type, announces too much, is a bomb, or is missing."""
    with np.load(file) as data:
        arrays = {name: data[name] for name in data.files}
    name = sorted(arrays)[rng.integers(len(arrays))]
    old, way = arrays.pop(name), int(rng.integers(9))
    if way < 2:
        shape, gigabytes = ((10**6, 10**6), 0.0) if way == 0 else ((2**29,), 0.99)
        file.write_bytes(bomb(shape, gigabytes=gigabytes, name=name))
        return
    changed = (
        np.zeros((3, 4, 5, 6), old.dtype),
        np.array("text\x1b[2J"),
        np.full(old.shape, np.nan),
        np.array([{"a": 1}], dtype=object),
        np.full(old.shape, -(2**40)),
        old.ravel()[: old.size // 2],
    )
    if way < 8:
        arrays[name] = changed[way - 2]
    np.savez_compressed(file, **arrays)


_Way = Callable[[np.random.Generator, Path, list[Path]], None]
#: Ways to spoil a file -> its suffixes; () is any.
_WAYS: dict[_Way, tuple[str, ...]] = {
    **dict.fromkeys((_flip, _truncate, _garbage, _grow, _swap, _remove, _replace, _rename), ()),
    _json: (".json",),
    _toml: (".toml",),
    _words: (".txt", ".yaml"),
    _png: (".png",),
    _npz: (".npz",),
}


def outcome(kind: Kind, path: Path) -> str:
    """``"read"`` if an input was read, ``"refused"`` if the error is one clear line; else the error."""
    try:
        kind.read(path)
    except InputError as error:
        clear = all(text.isprintable() and len(text) < 2000 for text in (error.message, *error.hints))
        return "refused" if clear else f"unclear: {error.message!r}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "read"


def copy(example: Path, path: Path) -> Path:
    """A fresh copy of an example, beside a file that must not be touched."""
    shutil.rmtree(path.parent, ignore_errors=True)
    path.parent.mkdir(parents=True)
    (path.parent / "canary").write_text("untouched", encoding="utf-8")
    shutil.copytree(example, path)
    return path
