"""Folders of instance masks: the law of the samples, the work, and files that cannot be used."""

from __future__ import annotations

import io
import json
import zipfile
from collections import Counter
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chisquare

from mstfilter.completion import Extrude
from mstfilter.errors import InputError
from mstfilter.frontends import (
    MaskProposal,
    mask_tree,
    nested_masks,
    node_values,
    read_masks,
    write_automatic_masks,
    write_masks,
)
from mstfilter.frontends.mask_files import decode_rle
from mstfilter.presets import preset
from mstfilter.scene import render, scene_cache, write_image
from mstfilter.segmentation import ExactCuts, ObjectRule
from mstfilter.smc.testing import ProposalContract
from mstfilter.testing import scene_example
from mstfilter.testing.scenes import _labels
from tests.segmentation.scenes import GRID, boxes, clip_of

SCENE = boxes(((8, 20, 0), (20, 34, 12)), ((24, 22, 0), (36, 36, 8)), ((40, 22, 0), (52, 36, 10)))
CLIP = clip_of(SCENE, width=160)
SHAPE = CLIP.after.depth.shape
SHOWN = render(SCENE, GRID, CLIP.after.camera).labels


def halves(mask: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """A mask cut in the middle, along columns (1) or rows (0)."""
    where = np.nonzero(mask)
    low = np.indices(mask.shape)[axis] <= np.median(where[axis])
    return mask & low, mask & ~low


BOX = [k == SHOWN for k in (1, 2, 3)]


def stack(*masks: np.ndarray) -> np.ndarray:
    return np.array(masks)


def segments_of(hypothesis) -> frozenset[str]:
    """The masks of a hypothesis, by the keys of their completions, which depend on frame and mask only."""
    return frozenset(o.completion_key for o in hypothesis.objects)


def law(tmp_path: Path) -> dict[frozenset[str], float]:
    """Write three regions, and return all segmentations with their probability, written down by hand."""
    folder = tmp_path / "masks"
    left, right = halves(BOX[0], 1)
    top, bottom = halves(BOX[1], 0)
    write_masks(folder, 0, [BOX[0].astype(int), left + 2 * right.astype(int)], weights=[3, 1], region="a")
    # A mask of score .9 and its two parts of score .6: the mask with probability .9 / (.9 + .6).
    write_masks(folder, 0, [(stack(top, BOX[1], bottom), [0.6, 0.9, 0.6])], region="b")
    # Alternatives without weights: the mean scores of their largest masks, .5 and .8.
    third = halves(BOX[2], 1)
    write_masks(folder, 0, [(stack(BOX[2]), [0.5]), (stack(*third), [0.7, 0.9])], region="c")
    options = [
        [((BOX[0],), 0.75), ((left, right), 0.25)],
        [((BOX[1],), 0.6), ((top, bottom), 0.4)],
        [((BOX[2],), 0.5 / 1.3), (third, 0.8 / 1.3)],
    ]
    expected = {}
    for combination in product(*options):
        single = tmp_path / f"single{len(expected)}"
        masks = [mask for chosen, _ in combination for mask in chosen]
        write_masks(single, 0, [stack(*masks)])
        (hypothesis,) = MaskProposal(str(single)).sample(np.random.default_rng(0), CLIP, 1).particles
        assert hypothesis.n_objects == len(masks)
        expected[segments_of(hypothesis)] = float(np.prod([p for _, p in combination]))
    assert sum(expected.values()) == pytest.approx(1)
    return expected


def test_regions_alternatives_and_levels_are_sampled_with_their_law(tmp_path):
    """Chi-square test against enumeration; a correct sampler fails it with probability 1e-6."""
    expected = law(tmp_path)
    population = MaskProposal(str(tmp_path / "masks")).sample(np.random.default_rng(1), CLIP, 4000)
    found = Counter(segments_of(h) for h in population.particles)
    assert set(found) <= set(expected)
    assert len(expected) == 8
    assert (population.log_weights == 0).all()
    counts = [found[one] for one in expected]
    assert chisquare(counts, 4000 * np.array(list(expected.values()))).pvalue > 1e-6


def test_the_work_is_that_of_the_distinct_masks(tmp_path, monkeypatch):
    """Four regions of ten alternatives: one tree for each file, one completion for each distinct mask."""
    for r, box in enumerate([BOX[0], BOX[1], *halves(BOX[2], 1)]):
        columns = np.nonzero(box)[1]
        cuts = np.linspace(columns.min() + 2, columns.max() - 1, 10)
        write_masks(tmp_path, 0, [np.where(np.indices(SHAPE)[1] < cut, 1, 2) * box for cut in cuts], region=f"r{r}")
    calls = Counter()
    for cls, name in ((ObjectRule, "segments"), (Extrude, "fill")):
        usual = getattr(cls, name)
        monkeypatch.setattr(cls, name, lambda *given, name=name, usual=usual: calls.update([name]) or usual(*given))
    scene_cache.clear()
    for seed in (0, 1):  # the same masks again: all work is found by its content
        population = MaskProposal(str(tmp_path)).sample(np.random.default_rng(seed), CLIP, 300)
        assert population.notes["distinct_hypotheses"] > 250
    assert calls["fill"] <= 80 and calls["segments"] <= 40


def test_equal_masks_of_two_alternatives_are_completed_once(tmp_path):
    left, right = halves(BOX[0], 1)
    write_masks(tmp_path, 0, [stack(BOX[1], BOX[0]), stack(left, BOX[1], right)])
    population = MaskProposal(str(tmp_path)).sample(np.random.default_rng(0), CLIP, 40)
    assert population.notes["distinct_segments"] == 4
    assert population.notes["distinct_hypotheses"] == 2


def test_masks_of_the_table_and_specks_are_no_objects(tmp_path):
    table = (SHOWN == 0) & (np.indices(SHAPE)[0] > SHAPE[0] // 2)
    speck = np.zeros(SHAPE, bool)
    row, column = np.argwhere(BOX[1])[len(np.argwhere(BOX[1])) // 2]
    speck[row, column] = True
    write_masks(tmp_path, 0, [stack(table, speck, BOX[0])])
    (hypothesis,) = MaskProposal(str(tmp_path)).sample(np.random.default_rng(0), CLIP, 1).particles
    assert hypothesis.n_objects == 1


def test_a_mask_of_the_table_hides_no_objects(tmp_path):
    """A mask of everything, as mask generators return it, is never taken as a whole."""
    whole = np.ones(SHAPE, bool)
    left, right = halves(BOX[0], 1)
    write_masks(tmp_path, 0, [(stack(whole, BOX[0], BOX[1], left, right), [1.0, 0.5, 0.5, 0.5, 0.5])])
    population = MaskProposal(str(tmp_path)).sample(np.random.default_rng(0), CLIP, 60)
    assert {h.n_objects for h in population.particles} == {2, 3}


def test_no_masks_give_no_objects(tmp_path):
    write_masks(tmp_path, 0, [np.zeros(SHAPE, int), np.zeros((0, *SHAPE), bool)])
    (hypothesis,) = MaskProposal(str(tmp_path)).sample(np.random.default_rng(0), CLIP, 1).particles
    assert hypothesis.n_objects == 0


def test_three_levels_of_nested_masks():
    """Probabilities of all cuts of a chain of masks with a rest, from the walk that the module describes."""
    whole = np.zeros((6, 8), bool)
    whole[1:5, 1:7] = True
    left, right = halves(whole, 1)
    top, bottom = halves(left, 0)
    corner = top & (np.indices(top.shape)[1] == 1)
    tree, stop = mask_tree(stack(corner, whole, top, left, right, bottom), [1.0, 0.8, 0.5, 0.6, 0.2, 0.7])
    sample = ExactCuts(temperature=1).sample(np.random.default_rng(0), tree, node_values(tree, stop), 6000)
    found = Counter(len(cut) - 1 for cut in sample.cuts)  # without leaf 0
    stop_whole, stop_left, stop_top = 0.8 / (0.8 + 0.4), 0.6 / (0.6 + 0.6), 0.5 / (0.5 + 1.0)
    expected = [
        stop_whole,  # whole
        (1 - stop_whole) * stop_left,  # left, right
        (1 - stop_whole) * (1 - stop_left) * stop_top,  # top, bottom, right
        (1 - stop_whole) * (1 - stop_left) * (1 - stop_top),  # corner, rest of top, bottom, right
    ]
    assert set(found) == {1, 2, 3, 4}
    assert chisquare([found[k] for k in (1, 2, 3, 4)], 6000 * np.array(expected)).pvalue > 1e-6


def test_nested_masks_makes_disjoint_or_nested_sets():
    """Random discs with jagged borders; the result builds a tree, and masks change by at most a tenth."""
    rng = np.random.default_rng(5)
    rows, columns = np.indices((60, 80))
    masks, scores = [], rng.random(40)
    for _ in range(40):
        centre, radius = rng.random(2) * (60, 80), rng.uniform(2, 25)
        masks.append(np.hypot(rows - centre[0], columns - centre[1]) + 0.8 * rng.random((60, 80)) < radius)
    kept, kept_scores = nested_masks(np.array(masks), scores)
    tree, _ = mask_tree(kept, kept_scores)
    assert 3 < len(kept) < 40
    assert kept_scores.max() == scores.max()
    assert tree.n_nodes > len(kept)
    for mask, score in zip(kept, kept_scores, strict=True):
        before = masks[int(np.flatnonzero(scores == score)[0])]
        assert not (mask & ~before).any()
    whole, part = masks[0] | True, rows < 30
    again, _ = nested_masks(stack(whole, part, part | (columns == 0)), [0.5, 0.9, 0.8])
    assert len(again) == 2  # the third is the second again


def test_the_recipe_writes_the_masks_of_a_generator(tmp_path):
    class Generator:
        def generate(self, image):
            assert image.shape == (*SHAPE, 3)
            left, right = halves(BOX[0], 1)
            found = [(BOX[0], 0.9), (left, 0.8), (right, 0.8), (BOX[1], 1.02), (np.ones(SHAPE, bool), 0.5)]
            return [{"segmentation": m, "predicted_iou": s, "area": int(m.sum())} for m, s in found]

    write_automatic_masks(str(tmp_path), [CLIP], Generator())
    population = MaskProposal(str(tmp_path)).sample(np.random.default_rng(0), CLIP, 50)
    assert {h.n_objects for h in population.particles} >= {2, 3}


def encode_rle(mask: np.ndarray) -> tuple[list[int], str]:
    """COCO run lengths as numbers and as text, written from the description of cocoapi's `rleToString`."""
    flat = mask.T.ravel().astype(int)
    ends = [0, *np.flatnonzero(np.diff(flat)) + 1, len(flat)]
    runs = [0] * int(flat[0]) + np.diff(ends).tolist()
    text = ""
    for i, run in enumerate(runs):
        x = run - runs[i - 2] if i > 2 else run
        more = True
        while more:
            c = x & 31
            x >>= 5
            more = x != -1 if c & 16 else x != 0
            text += chr((c | 32 if more else c) + 48)
    return runs, text


def test_files_of_all_kinds_hold_the_same_masks(tmp_path):
    for k, mask in enumerate(BOX):
        runs, text = encode_rle(mask)
        assert (decode_rle(runs, SHAPE) == mask).all()
        assert (decode_rle(text, SHAPE) == mask).all(), k
    annotations = [
        {"segmentation": {"size": list(SHAPE), "counts": encode_rle(mask)[k % 2]}, "predicted_iou": 0.9, "area": 1}
        for k, mask in enumerate(BOX)
    ]
    (tmp_path / "000000.json").write_text(json.dumps(annotations))
    (tmp_path / "1.json").write_text(json.dumps({"masks": annotations}))
    write_image(tmp_path / "000002.png", SHOWN.astype(np.uint8))
    write_image(tmp_path / "000003.png", (300 * SHOWN).astype(np.uint16))
    np.savez(tmp_path / "000004.npz", labels=SHOWN.astype(np.int32))
    write_masks(tmp_path, 5, [stack(*BOX)])
    (tmp_path / ".hidden").write_text("")
    (tmp_path / "README").write_text("")
    leaves = [read_masks(tmp_path, k, SHAPE).regions[0].trees[0].leaves for k in range(6)]
    for one in leaves:
        assert (one == SHOWN).all()


def npz(**arrays):
    def write(path: Path) -> None:
        np.savez(path / "000000.npz", **arrays)

    return write


def text(name, content):
    def write(path: Path) -> None:
        (path / name).parent.mkdir(exist_ok=True, parents=True)
        (path / name).write_text(content if isinstance(content, str) else json.dumps(content))

    return write


def image(name, content):
    def write(path: Path) -> None:
        (path / name).parent.mkdir(exist_ok=True, parents=True)
        write_image(path / name, content)

    return write


def huge(path: Path) -> None:
    """A header that announces 10^15 masks."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "|b1", "fortran_order": False, "shape": (10**15, *SHAPE)})
    with zipfile.ZipFile(path / "000000.npz", "w") as archive:
        archive.writestr("masks.npy", file.getvalue())


def several(*writers):
    def write(path: Path) -> None:
        for one in writers:
            one(path)

    return write


def weighted(content):
    """Two alternatives with this content of weights.json."""
    return several(
        *(image(f"000000/{n}.png", SHOWN.astype(np.uint8)) for n in "ab"), text("000000/weights.json", content)
    )


def runs(counts):
    """An annotation with these run lengths."""
    return text("000000.json", [{"segmentation": {"size": list(SHAPE), "counts": counts}}])


PNG = image("000000.png", SHOWN.astype(np.uint8))
ENTRY = {"segmentation": {"size": list(SHAPE), "counts": encode_rle(BOX[0])[0]}}
LIST = ENTRY["segmentation"]["counts"]
SHIFTED = np.roll(BOX[0], 3, axis=1)
HOSTILE = {
    "pickle": (npz(labels=np.array([{"a": 1}], dtype=object)), "holds objects"),
    "huge scores": (npz(masks=stack(BOX[0]), scores=np.zeros(70000)), "scores have shape (70000,)"),
    "huge npz": (huge, "does not fit into 128 bytes"),
    "other arrays": (npz(x=np.zeros(3)), "no array labels or masks"),
    "text for npz": (text("000000.npz", "not a zip"), "cannot be read"),
    "another size, png": (image("000000.png", np.zeros((9, 8), np.uint8)), "9 x 8 pixels"),
    "another size, json": (text("000000.json", [{"segmentation": {"size": [3, 4], "counts": [12]}}]), "3 x 4 pixels"),
    "overlap": (npz(masks=stack(BOX[0], SHIFTED)), "masks 0 and 1 overlap"),
    "equal masks": (npz(masks=stack(BOX[0], BOX[0])), "are equal"),
    "empty mask": (npz(masks=stack(BOX[0], BOX[0] & False)), "mask 1 is empty"),
    "overflow": (npz(labels=np.where(BOX[0], 65537, 0)), "0 to 65537, expected 0 to 65535"),
    "negative": (npz(labels=np.where(BOX[0], -1, 0)), "-1 to 0"),
    "float labels": (npz(labels=np.zeros(SHAPE)), "expected integers"),
    "too few scores": (npz(masks=stack(*BOX), scores=np.ones(2)), "scores have shape (2,)"),
    "nan score": (npz(masks=stack(*BOX), scores=np.array([1, np.nan, 1])), "score of mask 1 is nan"),
    "text scores": (npz(masks=stack(BOX[0]), scores=np.array(["a"])), "expected numbers"),
    "colour png": (image("000000.png", np.zeros((*SHAPE, 3), np.uint8)), "expected one channel"),
    "broken png": (text("000000.png", "PNG"), "cannot be decoded"),
    "broken json": (text("000000.json", '[{"segmentation":'), "cannot be read: Expecting value"),
    "json number": (text("000000.json", 3), "not a list"),
    "polygon": (text("000000.json", [{"segmentation": [[1, 2, 3, 4]]}]), "no segmentation with size and counts"),
    "short runs": (runs([5]), "sum to 5"),
    "negative runs": (runs([-1, *LIST[1:], 1]), "run lengths sum"),
    "broken text runs": (runs("é"), "character"),
    "cut text runs": (runs("o"), "within a number"),
    "text score": (text("000000.json", [{**ENTRY, "score": "high"}]), "expected a number"),
    "empty folder": (lambda path: None, "has no masks"),
    "missing pause": (image("000003.png", SHOWN.astype(np.uint8)), "no masks for pause 0; it has 3"),
    "pause twice": (several(PNG, text("0.json", [])), "twice"),
    "folder without files": (lambda path: (path / "000000").mkdir(), "has no masks"),
    "unknown file": (text("000000/a.tif", "x"), "is not a file of masks"),
    "files and folders": (
        several(image("000000/a.png", SHOWN.astype(np.uint8)), text("000000/b/0.json", [])),
        "both",
    ),
    "regions overlap": (
        several(image("000000/a/0.png", SHOWN.astype(np.uint8)), image("000000/b/0.png", SHOWN.astype(np.uint8))),
        "regions a and b share",
    ),
    "weights of others": (weighted({"a.png": 1}), "one weight for each of a.png, b.png"),
    "weight nan": (weighted('{"a.png": NaN, "b.png": 1}'), "weight of a.png is nan"),
    "weights zero": (weighted({"a.png": 0, "b.png": 0}), "all weights are 0"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_files_that_cannot_be_used_are_one_clear_error(tmp_path, case):
    write, message = HOSTILE[case]
    write(tmp_path)
    with pytest.raises(InputError) as caught:
        read_masks(tmp_path, 0, SHAPE)
    assert message in caught.value.message + " ".join(caught.value.hints)
    assert "\n" not in caught.value.message


def test_the_memory_of_a_file_is_bounded(tmp_path, monkeypatch):
    """Files of a few kilobytes can announce gigabytes of empty masks."""
    monkeypatch.setattr("mstfilter.frontends.mask_files.MAX_FILE", 10 * SHAPE[0] * SHAPE[1])
    for write in (text("000000.json", [ENTRY] * 11), npz(masks=np.zeros((11, *SHAPE), bool))):
        for path in tmp_path.iterdir():
            path.unlink()
        write(tmp_path)
        with pytest.raises(InputError, match="list of at most 10 masks|at most 192000 are read"):
            read_masks(tmp_path, 0, SHAPE)


class TestContract(ProposalContract):
    """Two readings of the scene, of which one joins two boxes, and nested masks."""

    @pytest.fixture(autouse=True)
    def folder(self, tmp_path):
        clip = scene_example(np.random.default_rng(0), 1)[1]
        labels = render(_labels(2), clip.grid, clip.after.camera).labels
        write_masks(tmp_path, 1, [np.minimum(labels, 2), stack(labels == 1, labels > 1, labels == 3)])
        self.path = str(tmp_path)

    def make(self):
        return MaskProposal(self.path)

    def example(self, rng, n):
        return scene_example(rng, n)


def test_a_folder_is_required():
    for folder, message in (("", "is not given"), ("nowhere", "does not exist")):
        with pytest.raises(InputError, match=message):
            preset("mst", "proposal=mask_folder", *([f"proposal.folder={folder}"] if folder else [])).proposal.sample(
                np.random.default_rng(0), CLIP, 1
            )


def test_writing_replaces_what_was_there_or_changes_nothing(tmp_path):
    write_masks(tmp_path, 0, [SHOWN, BOX[0].astype(int), BOX[1].astype(int)], [1, 1, 1])
    write_masks(tmp_path, 0, [SHOWN])
    assert len(read_masks(tmp_path, 0, SHAPE).regions[0].trees) == 1
    with pytest.raises(InputError, match="overlap"):
        write_masks(tmp_path, 0, [stack(BOX[0], SHIFTED)])
    for alternatives, weights in (([], None), ([SHOWN], [1, 2])):
        with pytest.raises(InputError, match="expected at least 1 of each"):
            write_masks(tmp_path, 0, alternatives, weights)
    assert (read_masks(tmp_path, 0, SHAPE).regions[0].trees[0].leaves == SHOWN).all()
    assert [path.name for path in tmp_path.iterdir()] == ["000000"]
