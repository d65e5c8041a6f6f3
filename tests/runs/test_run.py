"""Runs: folders, resuming, reproducibility, and the presets on small real pipelines."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.formats import open_recording
from mstfilter.mst.frontends import ExternalCompletion, write_masks
from mstfilter.runs.presets import build_filter, describe_filter, load_config
from mstfilter.runs.run import component_files, filter_recording
from mstfilter.runs.run_folder import RunFolder
from mstfilter.scene import scene_cache
from mstfilter.scoring import weighted_coverage
from tests.runs.study.scenes import slide
from tests.runs.study.test_failures import BROKEN

SMALL = ["n=2", "n_proposed=2"]  # of `mst`, where the number of particles is of no account


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return open_recording(slide(tmp_path_factory.mktemp("recordings") / "slide"))


@pytest.fixture(scope="module")
def finished(recording, tmp_path_factory):
    """A run with seed 2."""
    return filter_recording(recording, load_config("mst", SMALL), tmp_path_factory.mktemp("runs") / "run", seed=2)


def content(folder):
    """Bytes of every file of a run but times."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.name not in ("seconds.json", "report.html"))
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


@pytest.mark.parametrize("name", ["mst", "paper", "authors"])
def test_every_preset_runs_and_its_description_builds_it_again(recording, tmp_path, name):
    run = filter_recording(recording, load_config(name), tmp_path / "run", seed=1)
    assert run.n_pauses == 3
    assert run.description["status"] == "done"
    config = RunFolder.open(run.path).description["config"]
    assert describe_filter(build_filter(config)) == describe_filter(build_filter(load_config(name)))
    for t in range(3):
        info, hypotheses = run.info(t), run.hypotheses(t)
        assert len(hypotheses) == info["n"] == 5
        truth = run.truth(t)
        for k, hypothesis in enumerate(hypotheses):
            assert info["quality"]["objects"][k] == weighted_coverage(hypothesis.labels, truth)
        assert sum(info["weights"]) == pytest.approx(1.0)
        assert set(run.seconds(t)) >= {"proposal", "update"}
    # The two boxes stand apart: anything that works finds them.
    assert np.mean(run.info(2)["quality"]["objects"]) > 0.6


def test_the_same_seed_gives_the_same_bytes(recording, finished, tmp_path):
    scene_cache.clear()
    filter_recording(open_recording(recording.path), load_config("mst", SMALL), tmp_path / "b", seed=2)
    a, b = content(finished.path), content(tmp_path / "b")
    assert a.keys() == b.keys()
    assert [k for k in a if a[k] != b[k]] == []
    filter_recording(recording, load_config("mst", SMALL), tmp_path / "c", seed=3)
    c = content(tmp_path / "c")
    assert any(a[k] != c[k] for k in a if k.endswith("state.npz"))


@pytest.mark.parametrize("n_threads", [2, pytest.param(4, marks=pytest.mark.nightly), 8])
def test_the_number_of_threads_changes_no_byte(recording, finished, tmp_path, n_threads):
    scene_cache.clear()
    filter_recording(recording, load_config("mst", SMALL), tmp_path / "b", seed=2, n_threads=n_threads)
    a, b = content(finished.path), content(tmp_path / "b")
    assert a.keys() == b.keys() and [k for k in a if a[k] != b[k]] == []


@pytest.mark.parametrize("stop", [*(pytest.param(k, marks=pytest.mark.nightly) for k in (0, 2)), 1])
def test_an_interrupted_run_resumes_to_the_same_result(recording, finished, tmp_path, stop):

    def interrupt(done, total):
        if done == stop and not (tmp_path / "stopped").exists():
            (tmp_path / "stopped").touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        filter_recording(recording, load_config("mst", SMALL), tmp_path / "part", seed=2, progress=interrupt)
    if stop == 0:
        assert not (tmp_path / "part").exists()  # nothing was done: nothing is there
    else:
        assert RunFolder.open(tmp_path / "part").n_pauses == stop
        assert RunFolder.open(tmp_path / "part").description["status"] == "interrupted"
        (tmp_path / "part" / "pauses" / f".{stop:03d}.partial").mkdir(exist_ok=True)  # what a kill leaves behind
    filter_recording(recording, load_config("mst", SMALL), tmp_path / "part", seed=2)
    whole, part = content(finished.path), content(tmp_path / "part")
    assert whole.keys() == part.keys()
    assert [k for k in whole if whole[k] != part[k]] == []


def test_a_folder_of_another_run_is_refused(recording, finished, tmp_path):
    shutil.copytree(finished.path, tmp_path / "run")
    before = content(tmp_path / "run")
    with pytest.raises(InputError, match=r"its seed differs \(2 there, 3 now\)"):
        filter_recording(recording, load_config("mst", SMALL), tmp_path / "run", seed=3)
    with pytest.raises(InputError, match=r"its config differs \(n: 2 there, 4 now\)"):
        filter_recording(recording, load_config("mst", ["n=4", "n_proposed=2"]), tmp_path / "run", seed=2)
    assert content(tmp_path / "run") == before
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "precious.txt").write_text("x")
    with pytest.raises(InputError, match="not an empty folder"):
        filter_recording(recording, load_config("mst", SMALL), tmp_path / "other", seed=3)


@pytest.mark.parametrize(("source", "target"), [pytest.param(0, 1, marks=pytest.mark.nightly), (1, 0), (2, 2)])
def test_pauses_of_another_run_or_pause_are_refused(recording, finished, tmp_path, source, target):
    """A pause of a run with another seed, and another pause of this run. Without it, the run is resumed."""
    shutil.copytree(finished.path, tmp_path / "run")
    run = RunFolder.open(tmp_path / "run")
    shutil.rmtree(run.pause(target))
    if source == target:
        other = filter_recording(recording, load_config("mst", ["n=3", "n_proposed=2"]), tmp_path / "other", seed=4)
        shutil.copytree(other.pause(source), run.pause(target))
    else:
        shutil.copytree(finished.pause(source), run.pause(target))
    message = f"{target:03d} is of another run or pause: its state is of pause {source} with seed "
    for reads in (lambda: filter_recording(recording, load_config("mst", SMALL), run.path, seed=2), run.check):
        with pytest.raises(InputError, match=message) as raised:
            reads()
        assert f"remove the folders of pause {target} and all later pauses" in raised.value.hints[0]
    for t in range(target, 3):
        shutil.rmtree(run.pause(t))
    filter_recording(recording, load_config("mst", SMALL), run.path, seed=2)
    assert content(run.path) == content(finished.path)


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: path.write_text("{")])
def test_times_are_no_part_of_the_result(recording, finished, tmp_path, damage):
    """A run without them is resumed, and has scores and a report."""
    shutil.copytree(finished.path, tmp_path / "run")
    run = RunFolder.open(tmp_path / "run")
    damage(run.pause(0) / "seconds.json")
    shutil.rmtree(run.pause(2))
    filter_recording(recording, load_config("mst", SMALL), run.path, seed=2)
    assert content(run.path) == content(finished.path) and run.seconds(0) == {} != run.seconds(1)
    assert len(run.estimates()) == 3


def test_a_run_without_a_description_is_resumed(recording, finished, tmp_path):
    shutil.copytree(finished.path, tmp_path / "run")
    run = RunFolder.open(tmp_path / "run")
    written = json.loads((run.path / "run.json").read_text())
    del written["description"]
    (run.path / "run.json").write_text(json.dumps(written))
    shutil.rmtree(run.pause(2))
    again = filter_recording(recording, load_config("mst", SMALL), run.path, seed=2)
    assert again.n_pauses == 3 and again.description["status"] == "done"
    a, b = content(finished.path), content(again.path)
    assert [name for name in a if a[name] != b[name]] in ([], ["run.json"])


@pytest.mark.parametrize("pause", [1, 2, 3])
def test_a_folder_that_is_removed_while_the_run_is_written_is_named(recording, tmp_path, pause):
    """Nothing is written in its place."""

    def remove(done, total):
        if done == pause:
            shutil.rmtree(tmp_path / "run")

    with pytest.raises(InputError, match="was removed while the run was written"):
        filter_recording(recording, load_config("floor_one_blob"), tmp_path / "run", progress=remove)
    assert not (tmp_path / "run").exists()


def test_broken_input_and_useless_settings_make_no_folder(recording, tmp_path):
    broken = tmp_path / "broken"
    shutil.copytree(recording.path, broken)
    image = broken / "depth" / "000004.png"
    image.write_bytes(image.read_bytes()[:-50])
    with pytest.raises(InputError, match="truncated"):
        filter_recording(open_recording(broken), load_config("mst", SMALL), tmp_path / "run")
    for override in ("n=0", "n_proposed=-1", "update.n_views=-1", "update.quality_exponent=nan", "trigger.share=0"):
        with pytest.raises(InputError):
            filter_recording(recording, load_config("mst", [override]), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_failing_component_leaves_complete_pauses(recording, tmp_path):
    overrides = f"transition={BROKEN}:Breaks", "transition.at=2", *SMALL
    with pytest.raises(RuntimeError, match="broke"):
        filter_recording(recording, load_config("mst", overrides), tmp_path / "run", allow_files=True)
    run = RunFolder.open(tmp_path / "run")
    assert run.n_pauses == 2
    assert run.description["status"] == "failed"
    assert run.description["config"]["transition"]["component"].endswith("broken.py:Breaks")
    with pytest.raises(InputError, match="not loaded here"):
        load_config("mst", overrides, allow_files=False)


def test_a_changed_component_file_or_recording_is_another_run(recording, tmp_path):
    """Another image between the pauses, another component file: another run."""
    source = tmp_path / "mine.py"
    text = (
        "from dataclasses import dataclass\n"
        "from mstfilter.smc.resampling import Systematic\n"
        "@dataclass(frozen=True)\n"
        "class Mine(Systematic):\n"
        "    pass\n"
    )
    source.write_text(text)
    config = load_config("mst_rules", [f"resampler={source}:Mine", "transition=identity", *SMALL])
    filter_recording(recording, config, tmp_path / "run", allow_files=True)
    filter_recording(recording, config, tmp_path / "run", allow_files=True)  # the same: nothing to do
    source.write_text(f'"""My file."""\n{text}# the end\n')
    filter_recording(recording, config, tmp_path / "run", allow_files=True)  # only comments differ
    source.write_text(text + "another = 1\n")
    with pytest.raises(InputError, match="its files differs"):
        filter_recording(recording, config, tmp_path / "run", allow_files=True)
    changed = tmp_path / "changed"
    shutil.copytree(recording.path, changed)
    shutil.copy(changed / "rgb" / "000000.png", changed / "rgb" / "000001.png")
    assert open_recording(changed).key != recording.key


def test_a_run_on_other_masks_is_another_run(recording, tmp_path):
    """Masks of the user that have changed since, at any pause, and the same masks written again."""

    def run():
        overrides = "proposal=mask_folder", f"proposal.folder={tmp_path / 'masks'}"
        return filter_recording(recording, load_config("mst_rules", ["n=1", *overrides]), tmp_path / "run")

    def write(k, shift):
        masks = np.zeros(recording.frames[0].depth.shape, np.uint16)
        masks[20 + shift : 40, 20:40] = 1
        write_masks(tmp_path / "masks", k, [masks])

    for k in range(3):
        write(k, 0)
    run()
    write(2, 0)
    run()
    write(2, 1)
    with pytest.raises(InputError, match="its files differs .folder of MaskProposal: "):
        run()


def test_all_folders_of_a_component_count(tmp_path):
    """Two components of one class, one inside the other."""
    for name in "ab":
        (tmp_path / name).mkdir()
    one = ExternalCompletion(folder=str(tmp_path / "a"), other=ExternalCompletion(folder=str(tmp_path / "b")))
    seen = [component_files(one)]
    for name in "ab":
        (tmp_path / name / "x").write_text(name)
        seen.append(component_files(one))
    assert len({tuple(found.values()) for found in seen}) == 3


def test_masks_below_a_link_count(recording, tmp_path):
    masks = np.zeros(recording.frames[0].depth.shape, np.uint16)
    masks[20:40, 20:40] = 1
    for k in range(3):
        write_masks(tmp_path / "masks", k, [masks])
    first = tmp_path / "masks" / "000000"
    first.rename(tmp_path / "elsewhere")
    first.symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    (tmp_path / "masks" / "loop").symlink_to(tmp_path / "masks", target_is_directory=True)
    filter = build_filter(load_config("mst_rules", ["proposal=mask_folder", f"proposal.folder={tmp_path / 'masks'}"]))
    before = component_files(filter)
    again = tmp_path / "masks" / "again"
    again.symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    twice = component_files(filter)
    next(path for path in (tmp_path / "elsewhere").iterdir() if path.is_file()).write_bytes(b"other")
    assert before != twice != component_files(filter)
    again.unlink()
    assert component_files(filter) != before


@pytest.mark.parametrize("kind", [np.int64, np.int32, np.uint16])
def test_true_label_images_of_any_integer_type_are_stored(recording, tmp_path, kind):
    """OpenCV clips other types than uint8 and uint16 to 8 bits."""
    image = np.zeros(recording.frames[0].depth.shape, kind)
    image[20:40, 20:40] = 300
    config = load_config("floor_one_blob", ["n=1"])
    folder = filter_recording(replace(recording, instance=lambda index: image), config, tmp_path / "run")
    np.testing.assert_array_equal(folder.instance(0), image)
    with pytest.raises(InputError, match="true label image of pause 0 has shape"):
        filter_recording(replace(recording, instance=lambda index: image[:9]), config, tmp_path / "other")
    assert not (tmp_path / "other").exists()
