"""Kinds of image files, each written by a library or by hand, not by the package."""

from __future__ import annotations

import json
import sys
import zipfile

import cv2
import numpy as np
import pytest
from PIL import Image

from mstfilter.base.errors import InputError
from mstfilter.formats import open_recording, read_depth, read_rgb
from mstfilter.formats.pauses import Ends
from mstfilter.formats.redwood import Redwood
from tests.formats.layouts import K, units, video
from tests.formats.test_layouts import WORLD, same_frames

MILLIMETRES = np.array([[0, 700, 1500], [65535, 65534, 1]], np.uint16)
METRES = np.array([[np.nan, 0.7, 1.5], [np.nan, 65.534, 0.001]], np.float32)


def write_pgm(path, pixels):
    """The plain bytes of a PGM file: 16 bits, the higher byte first."""
    header = f"P5\n# depth\n{pixels.shape[1]} {pixels.shape[0]}\n65535\n".encode()
    path.write_bytes(header + pixels.astype(">u2").tobytes())


def write_exr(path, **channels):
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR absent: pip install -e '.[exr]'")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    openexr.File(header, {name.replace("_", "."): np.ascontiguousarray(c) for name, c in channels.items()}).write(
        str(path)
    )


def test_integers_of_every_kind_are_depth_in_units(tmp_path):
    write_pgm(tmp_path / "a.pgm", MILLIMETRES)
    np.savez(tmp_path / "b.npz", MILLIMETRES)
    np.savez_compressed(tmp_path / "c.npz", depth=MILLIMETRES, confidence=np.ones((2, 3)))
    np.save(tmp_path / "d.npy", MILLIMETRES.astype(np.int32))
    cv2.imwrite(str(tmp_path / "e.png"), np.dstack([MILLIMETRES] * 3))
    Image.fromarray(MILLIMETRES).save(tmp_path / "f.tif")
    for file in sorted(tmp_path.iterdir()):
        np.testing.assert_allclose(read_depth(file, 0.001), METRES, rtol=1e-6, err_msg=file.name)


@pytest.mark.parametrize("kind", [np.float16, np.float32])
@pytest.mark.parametrize("names", [("Z",), ("R", "G", "B"), ("Y",), ("R", "G", "B", "View_Depth_Z")])
def test_openexr(tmp_path, names, kind):
    """Background is infinite or very far, as renderers write it; beside colours, depth is the channel Z."""
    metres = np.array([[0.5, 1.25, np.inf], [2.0, np.nan, 6e4 if kind == np.float16 else 1e10]], kind)
    others = np.array([[1, 2, 3], [4, 5, 6]], kind)
    write_exr(
        tmp_path / "a.exr",
        **{n: others * k if "Z" in names[-1] and n in "RGB" else metres for k, n in enumerate(names)},
    )
    expected = np.array([[0.5, 1.25, np.nan], [2.0, np.nan, 6e4 if kind == np.float16 else np.nan]])
    np.testing.assert_allclose(read_depth(tmp_path / "a.exr", 0.001), expected, rtol=1e-3)


def test_openexr_without_depth_or_library(tmp_path, monkeypatch):
    write_exr(tmp_path / "a.exr", R=METRES, G=METRES + 1, B=METRES)
    with pytest.raises(InputError, match="has the channels B, G, R"):
        read_depth(tmp_path / "a.exr", 1)
    (tmp_path / "b.exr").write_bytes((tmp_path / "a.exr").read_bytes()[:60])
    with pytest.raises(InputError, match="b.exr"):
        read_depth(tmp_path / "b.exr", 1)
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(InputError, match="depth in OpenEXR files needs OpenEXR") as caught:
        read_depth(tmp_path / "a.exr", 1)
    assert "mstfilter[exr]" in caught.value.hints[0] and ".npy" in caught.value.hints[1]


def test_what_is_no_depth_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((4, 4), 90, np.uint8))
    cv2.imwrite(str(tmp_path / "map.png"), np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    cv2.imwrite(str(tmp_path / "three.png"), np.arange(48, dtype=np.uint16).reshape(4, 4, 3))
    np.savez(tmp_path / "two.npz", a=METRES, b=METRES)
    for name, message in (("grey.png", "uint8"), ("map.png", "uint8"), ("three.png", "16 bits"), ("two.npz", "a, b")):
        with pytest.raises(InputError, match=message):
            read_depth(tmp_path / name, 0.001)
    with pytest.raises(InputError, match="uint8") as caught:
        read_depth(tmp_path / "map.png", 0.001)
    assert "colour map" in caught.value.hints[0]


def test_colour_of_16_bits_and_other_files(tmp_path):
    rgb = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "wide.png"), rgb[..., ::-1].astype(np.uint16) * 257)
    cv2.imwrite(str(tmp_path / "wide.tif"), rgb[..., ::-1].astype(np.uint16) * 257)
    (tmp_path / "a.ppm").write_bytes(b"P6 8 6 255\n" + rgb.tobytes())
    Image.fromarray(rgb).save(tmp_path / "a.bmp")
    Image.fromarray(rgb).save(tmp_path / "a.png")
    for file in sorted(tmp_path.iterdir()):
        np.testing.assert_array_equal(read_rgb(file), rgb, err_msg=file.name)
    cv2.imwrite(str(tmp_path / "depth.png"), MILLIMETRES)
    cv2.imwrite(str(tmp_path / "three.png"), np.dstack([MILLIMETRES] * 3))
    for name in ("depth.png", "three.png"):
        with pytest.raises(InputError, match="is it a depth image|expected 8 bits"):
            read_rgb(tmp_path / name)
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.write(tmp_path / "a.png", "x/a.png")
    np.testing.assert_array_equal(read_rgb(zipfile.Path(tmp_path / "a.zip", "x/a.png")), rgb)


@pytest.mark.parametrize("kind", ["exr", "npz", "pgm"])
def test_folders_of_other_kinds_of_depth(tmp_path, kind):
    rgb, depth, _ = video((0, 1))
    path = tmp_path / "mine"
    for part in ("rgb", "depth"):
        (path / part).mkdir(parents=True)
    for k in range(2):
        Image.fromarray(rgb[k]).save(path / "rgb" / f"{k}.bmp")
        file = path / "depth" / f"{k}.{kind}"
        if kind == "exr":
            write_exr(file, R=depth[k].astype(np.float32))
        elif kind == "npz":
            np.savez_compressed(file, depth[k].astype(np.float32))
        else:
            write_pgm(file, units(depth[k], 0.001))
    same_frames(Redwood(K=K, pauses=Ends(), world=WORLD).open(path), (0, 1))


def test_pairs_of_other_kinds(tmp_path):
    rgb, depth, _ = video((0, 1))
    for k in range(2):
        Image.fromarray(rgb[k]).save(tmp_path / f"v{k}_rgb.ppm")
        np.save(tmp_path / f"v{k}_depth.npy", depth[k].astype(np.float32))
    (tmp_path / "info.json").write_text(json.dumps({"K": K, "depth_scale_m": 0.001}))
    recording = open_recording(tmp_path)
    assert len(recording) == 2
    np.testing.assert_array_equal(recording.frames[1].rgb, rgb[1])
    np.testing.assert_allclose(recording.frames[1].depth, depth[1], atol=1e-6)


def test_names_of_redwoods_object_scans(tmp_path):
    """Numbers of frames and microseconds, which differ between colour and depth; the frames are paired by time."""
    rgb, depth, _ = video((0, 1, 2))
    for part in ("rgb", "depth"):
        (tmp_path / part).mkdir()
    for k, (a, b) in enumerate(((0, 0), (33361, 33366), (5066722, 5066700))):
        Image.fromarray(rgb[k]).save(tmp_path / "rgb" / f"{k + 1:07d}-{a:012d}.png")
        Image.fromarray(units(depth[k], 0.001)).save(tmp_path / "depth" / f"{k + 1:07d}-{b:012d}.png")
    recording = Redwood(K=K, pauses=Ends(), world=WORLD).open(tmp_path)
    same_frames(recording, (0, 1, 2))
    np.testing.assert_allclose(recording.times, (0, 0.033361, 5.066722))
