"""Objects from triangle meshes: folders of meshes, checks, and pools for training, tuning and reporting.

>>> from mstfilter.lab.simulation.objects import open_objects
>>> objects = open_objects("my_objects")  # doctest: +SKIP
>>> shape = objects.draw(np.random.default_rng(0), "all")  # doctest: +SKIP

A folder has files ``.obj``, ``.glb``, ``.gltf``, ``.stl`` and ``.ply``, each with one object, or a table
``index.csv`` with ``.npz`` archives (`_read_archives`). Sizes are true sizes in metres, and z points up; glTF files
have y up, as their standard says. `SceneFamily.object_scale` and `object_up` change both. Colours come from textures,
or from colours of vertices or faces. An object without colours gets a drawn texture.

A table ``index.csv`` may also describe files: the column ``id`` has their names without ending, ``class`` one of
`CLASSES` and ``stem`` a name that near duplicates share.

**Pools.** `pool_of` assigns each stem of a source to one of three pools by a hash of both: half of the stems to
training, a quarter each to tuning and reporting. So near duplicates are in one pool, and the pools do not depend on
which other objects a folder has.
"""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mstfilter.base.errors import InputError, missing_library
from mstfilter.base.files import cache_folder, read_csv, reading
from mstfilter.base.reading import read_arrays
from mstfilter.lab.simulation.shapes import Shape
from mstfilter.lab.simulation.surfaces import MeshSurface, Triangles, centred, prepared_mesh

MeshPool = Literal["training", "tuning", "reported", "all"]

CLASSES = ("box", "can", "bottle", "cup", "bowl", "plate", "tool", "cutlery", "ornament", "other")

AGREEMENT = 0.9  #: Least share of rays that agree about the inside of an object

_ENDINGS = (".obj", ".glb", ".gltf", ".stl", ".ply")
_SMALLEST, _LARGEST = 0.01, 0.6  # longest side of an object on a table, metres
_MOST_FACES = 500_000
_DOUBTFUL = 0.97  # objects of an index with a smaller agreement of rays are left out
_SIZES = (0.8, 1.3)  # of objects of an index, times the size as given
_SHORT, _LONG = 0.04, 0.32  # longest side of an object of an index, metres
_COMMON = ("box", "can", "bottle", "cup", "bowl")  # drawn twice as often
_LARGE = 0.3  # longest side from which an object is drawn half as often, metres
_UPRIGHT, _ON_A_SIDE, _ANY = 0.70, 0.25, 0.05

_FINISHES: Mapping[str, tuple[str, ...]] = {
    "box": ("carton", "carton", "plain"),
    "can": ("label",),
    "bottle": ("label", "plain"),
    "cup": ("glazed", "glazed", "ceramic"),
    "bowl": ("glazed", "glazed", "ceramic"),
    "plate": ("glazed", "glazed", "ceramic"),
    "tool": ("metal", "plain"),
    "cutlery": ("metal",),
    "ornament": ("wood", "plain"),
    "other": ("plain", "plain", "wood"),
}


def pool_of(source: str, stem: str) -> MeshPool:
    """The pool of a stem of a source: training for one half, tuning and reported for a quarter each."""
    part = hashlib.sha256(f"{source}/{stem}".encode()).digest()[0] % 4
    pools: tuple[MeshPool, ...] = ("training", "training", "tuning", "reported")
    return pools[part]


@dataclass(frozen=True, eq=False)
class MeshObject:
    """A mesh of a folder."""

    name: str
    where: str  #: file, for errors
    triangles: Triangles  #: z up, metres, the middle of the bounding box at the origin
    source: str = ""
    stem: str = ""
    kind: str = "other"  #: one of `CLASSES`

    @property
    def pool(self) -> MeshPool:
        return pool_of(self.source, self.stem or self.name)

    @property
    def half(self) -> np.ndarray:
        """Half edges (3,) of the bounding box, metres."""
        return np.abs(self.triangles.vertices).max(axis=0)

    def surface(self) -> MeshSurface:
        """The prepared mesh. Raises InputError if the surface is open."""
        try:
            return _prepared(self.triangles)
        except InputError as error:
            raise error.with_message(f"object {self.where}: {error.message}") from error

    def shape(self, scale: float, turn: np.ndarray | None = None) -> Shape:
        """The rigid body of the object, `scale` times as large."""
        surface = self.surface()
        volume = surface.volume * scale**3
        # Wood, filled packages and porcelain: 0.7 g a cubic centimetre of the body, thin walls are denser.
        thin = surface.volume / float(8 * np.prod(surface.half)) < 0.15
        mass = float(np.clip((2000.0 if thin else 700.0) * volume, 0.02, 1.5))
        return Shape.of_surface(surface, scale, self.kind, self.name, mass, _finish(self.kind, surface.half, thin))


@functools.lru_cache(maxsize=512)
def _prepared(triangles: Triangles) -> MeshSurface:
    return prepared_mesh(triangles, cache_folder() / "objects", AGREEMENT)


def _finish(kind: str, half: np.ndarray, thin: bool) -> tuple[str, ...]:
    """Styles of texture of an object without colours.

    Labels need an object that is as wide as deep. An open box, which has `thin` walls, has no print.
    """
    if kind == "box" and thin:
        return ("plain",)
    round_ = 0.9 < half[0] / half[1] < 1.1
    found = _FINISHES.get(kind, _FINISHES["other"])
    return found if round_ or found != ("label",) else ("plain",)


@dataclass(frozen=True, eq=False)
class ObjectSet:
    """The objects of a folder."""

    folder: Path
    objects: tuple[MeshObject, ...]
    indexed: bool = False  #: whether the folder has archives: sources are balanced, and sizes vary
    key: str = field(init=False)  #: a hash of all objects

    def __post_init__(self) -> None:
        names = "".join(f"{one.name}/{one.kind}/{one.source}/{one.stem}/{one.triangles.key}" for one in self.objects)
        object.__setattr__(self, "key", hashlib.sha256(names.encode()).hexdigest()[:16])

    def of_pool(self, pool: MeshPool) -> tuple[MeshObject, ...]:
        """The objects of a pool. Raises InputError if there is none."""
        found = tuple(one for one in self.objects if pool == "all" or one.pool == pool)
        if not found:
            raise InputError(
                f"objects {self.folder}: none of {len(self.objects)} objects is in the pool {pool!r}",
                "use mesh_pool=all, or more objects",
            )
        return found

    def draw(
        self,
        rng: np.random.Generator,
        pool: MeshPool,
        kinds: tuple[str, ...] = (),
        but: tuple[str, ...] = (),
    ) -> Shape:
        """The shape of a random object of a pool, of one of `kinds` if there is one.

        Objects with the names `but` are not drawn as long as there are others.
        """
        objects = self.of_pool(pool)
        objects = tuple(one for one in objects if one.kind in kinds) or objects
        objects = tuple(one for one in objects if one.name not in but) or objects
        if not self.indexed:
            return objects[int(rng.integers(len(objects)))].shape(1.0)
        # A source with four times as many objects is drawn twice as often.
        sources = sorted({one.source for one in objects})
        counts = np.array([sum(one.source == source for one in objects) for source in sources])
        source = sources[int(rng.choice(len(sources), p=np.sqrt(counts) / np.sqrt(counts).sum()))]
        these = [one for one in objects if one.source == source]
        chosen = these[int(rng.choice(len(these), p=_frequencies(these)))]
        longest = 2 * float(chosen.half.max())
        return chosen.shape(float(np.clip(rng.uniform(*_SIZES), _SHORT / longest, max(_LONG / longest, 0.5))))


def _frequencies(objects: list[MeshObject]) -> np.ndarray:
    """How often each object is drawn: more often what is common on tables, less often what fills them."""
    found = [(2.0 if one.kind in _COMMON else 1.0) * (0.5 if 2 * one.half.max() > _LARGE else 1.0) for one in objects]
    return np.array(found) / sum(found)


def find_folder(folder: str) -> Path:
    """The folder of meshes that a family names. Raises InputError if it does not exist."""
    named = os.path.expandvars(folder)
    if "$" in named or not named.strip():
        raise InputError(
            "the scene family needs a folder of meshes",
            "name it: mstfilter simulate FAMILY OUT --objects FOLDER, or objects=FOLDER in Python and study files",
            "or set the environment variable MSTFILTER_OBJECTS, in which m1, m2 and m3 look for it",
        )
    path = Path(named).expanduser()
    if not path.is_dir():
        raise InputError(f"objects {path}: no such folder", f"expected a folder with files {', '.join(_ENDINGS)}")
    return path


def open_objects(folder: str | Path, scale: float = 1.0, up: Literal["auto", "y", "z"] = "auto") -> ObjectSet:
    """Read and check all meshes of a folder.

    Lengths in the files are multiplied by `scale`. `up` is the axis that points up in the files; "auto" is y for glTF
    files and z for others. Raises InputError if the folder has no meshes, or a mesh is unreadable, empty, or not of
    the size of objects on a table. Whether surfaces are closed is checked when an object is used
    (`MeshObject.surface`).
    """
    path = find_folder(str(folder))
    files = sorted(p for p in path.rglob("*") if p.suffix.lower() in (*_ENDINGS, ".npz", ".csv"))
    state = tuple((str(p), p.stat().st_mtime_ns, p.stat().st_size) for p in files)
    return _open(path, scale, up, state)


@functools.lru_cache(maxsize=4)
def _open(path: Path, scale: float, up: str, state: tuple[tuple[str, int, int], ...]) -> ObjectSet:
    files = [Path(name) for name, _, _ in state]
    index = _read_index(path / "index.csv")
    meshes = [p for p in files if p.suffix.lower() in _ENDINGS]
    archives = [p for p in files if p.suffix.lower() == ".npz"] if index else []
    if not meshes and not archives:
        raise InputError(
            f"objects {path}: the folder has no meshes",
            f"one file an object: {', '.join(_ENDINGS)}; or index.csv with .npz archives",
        )
    found = [_of_file(p, index, scale, up) for p in meshes]
    for archive in archives:
        found += _read_archives(archive, index, scale)
    if not found:
        raise InputError(f"objects {path}: no object of index.csv has rays that agree about its inside")
    found.sort(key=lambda one: (one.source, one.name))
    return ObjectSet(path, tuple(found), bool(archives))


def _read_index(path: Path) -> dict[str, dict[str, str]]:
    if not path.is_file():
        return {}
    with reading(path, "a table of objects"):
        return {row["id"]: row for row in read_csv(path) if row.get("id")}


def _described(one: MeshObject, row: Mapping[str, str]) -> dict[str, Any]:
    kind = row.get("class") or "other"
    return {"source": row.get("source") or "", "stem": row.get("stem") or one.name, "kind": kind}


def _of_file(path: Path, index: Mapping[str, Mapping[str, str]], scale: float, up: str) -> MeshObject:
    try:
        triangles = _read_mesh(path)
    except InputError:
        raise
    except Exception as error:  # of the many that readers of meshes raise
        raise InputError(
            f"object {path}: the mesh cannot be read: {error}", "open it in a mesh editor and save it as .ply or .glb"
        ) from error
    axis = up if up != "auto" else ("y" if path.suffix.lower() in (".glb", ".gltf") else "z")
    vertices = triangles.vertices * scale
    if axis == "y":
        vertices = vertices[:, [0, 2, 1]] * (1, -1, 1)
    one = _checked(path.stem, str(path), replace(triangles, vertices=vertices), scale)
    return replace(one, **_described(one, index.get(path.stem, {})))


def _checked(name: str, where: str, triangles: Triangles, scale: float) -> MeshObject:
    """The object of a mesh. Raises InputError if the mesh is empty, broken or not of the size of objects."""
    if not len(triangles.faces):
        raise InputError(
            f"object {where}: the mesh has no faces", "points alone are no object: make a surface of them"
        )
    if len(triangles.faces) > _MOST_FACES:
        raise InputError(
            f"object {where}: the mesh has {len(triangles.faces):,} faces, at most {_MOST_FACES:,} are used",
            "simplify it; 3,000 to 20,000 faces are enough at this resolution",
        )
    used = np.unique(triangles.faces)
    if used[0] < 0 or used[-1] >= len(triangles.vertices):
        raise InputError(f"object {where}: a face names vertex {used[-1]}, of {len(triangles.vertices)}")
    if not np.isfinite(triangles.vertices[used]).all():
        raise InputError(f"object {where}: a vertex is not finite")
    one = MeshObject(name, where, centred(triangles))
    longest = 2 * float(one.half.max())
    if not _SMALLEST <= longest <= _LARGEST:
        fits = [
            (unit, factor)
            for unit, factor in (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254))
            if _SMALLEST <= longest * factor <= _LARGEST
        ]
        hints = [f"if the file is in {unit}: object_scale={factor * scale:g}" for unit, factor in fits[:2]]
        raise InputError(
            f"object {where}: its longest side is {longest:.3g} m, expected {_SMALLEST} to {_LARGEST} m", *hints
        )
    if float(one.half.min()) < 0.0005:
        raise InputError(
            f"object {where}: its shortest side is {2000 * float(one.half.min()):.2g} mm: a sheet has no volume",
            "give it a thickness, or leave it out",
        )
    return one


def _read_archives(path: Path, index: Mapping[str, Mapping[str, str]], scale: float) -> Iterator[MeshObject]:
    """The objects of an ``.npz`` archive that the index names.

    Arrays of an archive: ``id`` (n,), ``v`` (V, 3) metres, ``f`` (F, 3), ``v_start`` and ``f_start`` (n + 1,), and,
    if there are colours, ``colour`` (F, 3) uint8 and ``has_colour`` (n,).
    """
    z = read_arrays(path, "an archive of meshes")
    missing = [name for name in ("id", "v", "f", "v_start", "f_start") if name not in z]
    if missing:
        raise InputError(f"archive of meshes {path} has no array {missing[0]!r}")
    for i, name in enumerate(z["id"].tolist()):
        row = index.get(name)
        if row is None or float(row.get("ray_agreement") or 1.0) < _DOUBTFUL:
            continue
        v, f = slice(*z["v_start"][i : i + 2]), slice(*z["f_start"][i : i + 2])
        colours = None
        if "colour" in z and z["has_colour"][i]:
            colours = np.repeat(z["colour"][f][:, None], 3, axis=1)
        triangles = Triangles(z["v"][v].astype(np.float64) * scale, z["f"][f].astype(np.int64), colours)
        one = _checked(name, f"{path}: {name}", triangles, scale)
        yield replace(one, **_described(one, row))


def _read_mesh(path: Path) -> Triangles:
    """The triangles of a file, of all parts of its scene."""
    try:
        import trimesh
    except ModuleNotFoundError as error:
        raise missing_library(error, f"reading {path.name}") from error

    scene = trimesh.load_scene(str(path), process=False)
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    colours: list[np.ndarray | None] = []
    places: list[np.ndarray] = []
    numbers: list[np.ndarray] = []
    images: list[np.ndarray] = []
    count = 0
    for node in sorted(scene.graph.nodes_geometry):
        transform, name = scene.graph[node]
        part: Any = scene.geometry[name]
        if not hasattr(part, "faces") or not len(part.faces):
            continue
        vertices.append(np.asarray(part.vertices, dtype=np.float64) @ transform[:3, :3].T + transform[:3, 3])
        faces.append(np.asarray(part.faces, dtype=np.int64) + count)
        count += len(part.vertices)
        colour, image, place = _looks(part)
        n = len(part.faces)
        colours.append(colour)
        numbers.append(np.full(n, -1 if image is None else len(images), np.int32))
        places.append(np.zeros((n, 3, 2), np.float32) if place is None else place)
        if image is not None:
            images.append(image)
    if not faces:
        return Triangles(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    known = any(colour is not None for colour in colours) or bool(images)
    grey = [np.full((len(f), 3, 3), 180, np.uint8) if c is None else c for f, c in zip(faces, colours, strict=True)]
    textured: dict[str, Any] = {}
    if images:
        textured = {"image": np.concatenate(numbers), "place": np.concatenate(places), "images": tuple(images)}
    return Triangles(
        np.concatenate(vertices), np.concatenate(faces), np.concatenate(grey) if known else None, **textured
    )


def _looks(part: Any) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
    """Colours of corners (F, 3, 3), image (h, w, 3), and corners in the image (F, 3, 2) of a part, if known."""
    visual = part.visual
    if visual.kind == "face":
        return np.repeat(np.asarray(visual.face_colors, np.uint8)[:, None, :3], 3, axis=1), None, None
    if visual.kind == "vertex":
        return np.asarray(visual.vertex_colors, np.uint8)[part.faces][..., :3], None, None
    if visual.kind != "texture":
        return None, None, None
    material = visual.material
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is not None and visual.uv is not None and len(visual.uv) == len(part.vertices):
        place = np.asarray(visual.uv, np.float32)[part.faces]
        place[..., 1] = 1 - place[..., 1]
        return None, np.asarray(image.convert("RGB"), np.uint8), place
    plain = np.asarray(material.main_color, np.uint8)[:3]
    return np.broadcast_to(plain, (len(part.faces), 3, 3)).copy(), None, None
