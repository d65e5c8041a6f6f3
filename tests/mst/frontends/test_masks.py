"""Folders of instance masks: the law of the samples, the work, and files that cannot be used."""

from __future__ import annotations

import io
import json
import zipfile
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chisquare

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.formats import write_image
from mstfilter.mst.completion import Extrude
from mstfilter.mst.frontends import (
    MaskProposal,
    Segmenter,
    mask_tree,
    nested_masks,
    node_values,
    read_masks,
    write_automatic_masks,
    write_masks,
)
from mstfilter.mst.segmentation import ExactCuts, ObjectRule
from mstfilter.mst.testing import scene_example
from mstfilter.mst.testing.scenes import _labels
from mstfilter.runs.presets import preset
from mstfilter.scene import Recording, project, render, scene_cache
from mstfilter.smc.testing import ProposalContract
from tests.mst.segmentation.scenes import GRID, boxes, clip_of

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
    """Write alternatives, and return all segmentations with their probability, written down by hand."""
    left, right = halves(BOX[0], 1)
    top, bottom = halves(BOX[1], 0)
    # A mask of score .9 and its two parts of score .6: the mask with probability .9 / (.9 + .6).
    nested = stack(top, BOX[1], bottom, BOX[2]), [0.6, 0.9, 0.6, 1.0]
    write_masks(tmp_path / "masks", 0, [left + 2 * right.astype(int), BOX[0].astype(int), nested], weights=[1, 2, 5])
    options = [
        ((left, right), 1 / 8),
        ((BOX[0],), 2 / 8),
        ((BOX[1], BOX[2]), 5 / 8 * 0.6),
        ((top, bottom, BOX[2]), 5 / 8 * 0.4),
    ]
    expected = {}
    for masks, probability in options:
        single = tmp_path / f"single{len(expected)}"
        write_masks(single, 0, [stack(*masks)])
        (hypothesis,) = MaskProposal(str(single)).sample(np.random.default_rng(0), CLIP, 1).particles
        assert hypothesis.n_objects == len(masks)
        expected[segments_of(hypothesis)] = probability
    return expected


def test_alternatives_and_levels_are_sampled_with_their_law(tmp_path):
    """Chi-square test against enumeration; a correct sampler fails it with probability 1e-6."""
    expected = law(tmp_path)
    population = MaskProposal(str(tmp_path / "masks")).sample(np.random.default_rng(1), CLIP, 4000)
    found = Counter(segments_of(h) for h in population.particles)
    assert set(found) == set(expected) and len(expected) == 4
    assert (population.log_weights == 0).all()
    counts = [found[one] for one in expected]
    assert chisquare(counts, 4000 * np.array(list(expected.values()))).pvalue > 1e-6


@dataclass(frozen=True)
class Given(Segmenter):
    """The alternatives of `law`, but for their weights, which follow from the scores."""

    def segment(self, frame):
        left, right = halves(BOX[0], 1)
        assert frame is CLIP.after
        return [left + 2 * right.astype(int), (stack(BOX[0]), [0.5]), (stack(BOX[1], BOX[2]), [0.5, 0.5])]


def test_a_segmenter_proposes_what_its_masks_would_from_a_folder(tmp_path):
    write_masks(tmp_path, 0, Given().segment(CLIP.after))
    one, other = (p.sample(np.random.default_rng(3), CLIP, 50) for p in (Given(), MaskProposal(str(tmp_path))))
    assert [h.key for h in one.particles] == [h.key for h in other.particles]
    assert len({segments_of(h) for h in one.particles}) == 3


@pytest.mark.parametrize(
    ("masks", "error"),
    [
        ([], "there are no masks"),
        ([np.zeros((3, 4), int)], "3 x 4 pixels, the image is"),
        ([np.full(SHAPE, 0.5)], "labels has shape .* and type float64"),
    ],
)
def test_a_segmenter_that_returns_no_masks_of_the_image(monkeypatch, masks, error):
    monkeypatch.setattr(Given, "segment", lambda self, frame: masks)
    with pytest.raises(InputError, match=error):
        Given().sample(np.random.default_rng(0), CLIP, 2)


def test_the_weight_of_an_alternative_is_the_mean_score_of_its_largest_masks(tmp_path):
    left, right = halves(BOX[2], 1)
    write_masks(tmp_path, 0, [(stack(BOX[2], left), [0.5, 0.1]), (stack(left, right), [0.7, 0.9])])
    np.testing.assert_allclose(read_masks(tmp_path, 0, SHAPE).weights, [0.5 / 1.3, 0.8 / 1.3])


def test_the_work_is_that_of_the_distinct_masks(tmp_path, monkeypatch):
    """Ten alternatives: one tree for each file, one completion for each distinct mask."""
    columns = np.nonzero(BOX[0])[1]
    cuts = np.linspace(columns.min() + 2, columns.max() - 1, 10)
    write_masks(tmp_path, 0, [np.where(np.indices(SHAPE)[1] < cut, 1, 2) * BOX[0] + 3 * BOX[1] for cut in cuts])
    calls = Counter()
    for cls, name in ((ObjectRule, "segments"), (Extrude, "fill")):
        usual = getattr(cls, name)
        monkeypatch.setattr(cls, name, lambda *given, name=name, usual=usual: calls.update([name]) or usual(*given))
    scene_cache.clear()
    for seed in (0, 1):  # the same masks again: all work is found by its content
        population = MaskProposal(str(tmp_path)).sample(np.random.default_rng(seed), CLIP, 300)
        assert population.notes["distinct_hypotheses"] == 10
    assert calls["fill"] <= 21 and calls["segments"] == 10


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


def test_files_of_all_kinds_hold_the_same_masks(tmp_path):
    write_image(tmp_path / "000000.png", SHOWN.astype(np.uint8))
    write_image(tmp_path / "1.png", (300 * SHOWN).astype(np.uint16))
    np.savez(tmp_path / "000002.npz", labels=SHOWN.astype(np.int32))
    write_masks(tmp_path, 3, [stack(*BOX)])
    (tmp_path / ".hidden").write_text("")
    (tmp_path / "README").write_text("")
    leaves = [read_masks(tmp_path, k, SHAPE).trees[0].leaves for k in range(4)]
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


PNG = image("000000.png", SHOWN.astype(np.uint8))
SHIFTED = np.roll(BOX[0], 3, axis=1)
HOSTILE = {
    "pickle": (npz(labels=np.array([{"a": 1}], dtype=object)), "holds objects"),
    "huge scores": (npz(masks=stack(BOX[0]), scores=np.zeros(70000)), "scores have shape (70000,)"),
    "huge npz": (huge, "does not fit into 128 bytes"),
    "other arrays": (npz(x=np.zeros(3)), "no array labels or masks"),
    "text for npz": (text("000000.npz", "not a zip"), "cannot be read"),
    "another size, png": (image("000000.png", np.zeros((9, 8), np.uint8)), "9 x 8 pixels"),
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
    "empty folder": (lambda path: None, "has no masks"),
    "missing pause": (image("000003.png", SHOWN.astype(np.uint8)), "no masks for pause 0; it has 3"),
    "pause twice": (several(PNG, npz(labels=SHOWN)), "twice"),
    "folder without files": (lambda path: (path / "000000").mkdir(), "has no masks"),
    "unknown file": (text("000000/a.tif", "x"), "is not a file of masks"),
    "folder in a folder": (image("000000/a/0.png", SHOWN.astype(np.uint8)), "is not a file of masks"),
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
    monkeypatch.setattr("mstfilter.mst.frontends.mask_files.MAX_FILE", 10 * SHAPE[0] * SHAPE[1])
    npz(masks=np.zeros((11, *SHAPE), bool))(tmp_path)
    with pytest.raises(InputError, match="at most 192000 are read"):
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
    assert len(read_masks(tmp_path, 0, SHAPE).trees) == 1
    with pytest.raises(InputError, match="overlap"):
        write_masks(tmp_path, 0, [stack(BOX[0], SHIFTED)])
    for alternatives, weights in (([], None), ([SHOWN], [1, 2])):
        with pytest.raises(InputError, match="expected at least 1 of each"):
            write_masks(tmp_path, 0, alternatives, weights)
    assert (read_masks(tmp_path, 0, SHAPE).trees[0].leaves == SHOWN).all()
    assert [path.name for path in tmp_path.iterdir()] == ["000000"]


def test_a_surface_without_readings_is_estimated_as_by_the_other_proposals(tmp_path):
    frame, mask = CLIP.after, BOX[0]
    rows, columns = np.nonzero(mask)
    hole = mask & (np.indices(SHAPE)[1] > columns.min() + 4) & (np.indices(SHAPE)[0] > rows.min() + 4)
    rgb = np.where(mask[..., None], np.array([200, 30, 30], np.uint8), np.full((*SHAPE, 3), 120, np.uint8))
    dark = replace(CLIP, frames=(replace(frame, rgb=rgb, depth=np.where(hole, np.nan, frame.depth)),))
    write_masks(tmp_path / "masks", 0, [stack(mask)])
    covered = []
    for mend in (False, True):
        proposal = MaskProposal(str(tmp_path / "masks"), objects=ObjectRule(mend=mend))
        (hypothesis,) = proposal.sample(np.random.default_rng(0), dark, 1).particles
        covered.append((project(hypothesis, frame.camera)[hole] > 0).mean())
    assert covered[0] < 0.8 and covered[1] > 0.95, covered


def test_masks_of_frames_instead_of_pauses_give_a_warning(tmp_path):
    recording = Recording((CLIP.after,) * 2, CLIP.grid, (0,), (0.0, 1.0))
    write_masks(tmp_path, 0, [BOX[0].astype(int)])
    MaskProposal(str(tmp_path)).check_files(recording)
    write_masks(tmp_path, 1, [BOX[0].astype(int)])
    with pytest.warns(InputWarning, match="numbers above 0, but arrays has 1 pauses"):
        MaskProposal(str(tmp_path)).check_files(recording)
