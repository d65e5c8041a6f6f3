"""The report of a study: made from its folder alone; its conclusions follow the intervals."""

from __future__ import annotations

import html
import json
import re
import shutil

import numpy as np
import pytest

from mstfilter.app.report.study_report import write_study_report
from mstfilter.base.errors import InputError
from mstfilter.runs.study import RESULT, StudyFolder, summarise
from tests.app.report.pages import Page
from tests.app.report.runs import make_run
from tests.app.test_cli import call


def make_study(path, n_scenes=4, arms=("ours", "<theirs>"), groups=("s1", "s2"), fail=True, reported_only=()):
    """A study folder written by hand: ours is better by 0.1."""
    rng, runs = np.random.default_rng(0), []
    scenes = [
        {"name": f"{g}-{k}", "group": g, "source": {"family": g, "seed": k, "set": {}}, "key": f"{g}{k}"}
        for g in groups
        for k in range(n_scenes)
    ]
    for scene in scenes:
        for arm in arms:
            for seed in (0, 1):
                folder = f"{arms.index(arm)}_{scene['name']}_{seed}"
                name = f"{arm} on {scene['name']}, seed {seed}"
                named = {"arm": arm, "scene": scene["name"], "group": scene["group"], "seed": seed}
                runs.append({"name": name, "folder": folder, "identity": folder, **named})
                (path / "runs" / folder).mkdir(parents=True)
                if fail and arm != arms[0] and scene is scenes[-1] and seed:
                    failed = {
                        "status": "failed",
                        "error": "it <broke>",
                        "hints": ["mend it"],
                        "tries": 3,
                        "trace": "x",
                    }
                    (path / "runs" / folder / RESULT).write_text(json.dumps({"identity": folder, **failed}))
                    continue
                q = 0.6 + 0.1 * (arm == arms[0]) + 0.01 * rng.random((3, 5))
                rows = [
                    {"pause": t, "n": 5, "quality": float(q[t].mean()), "quality_one_blob": 0.3,
                     "quality_hidden": None, "qualities": q[t].tolist()}
                    for t in range(3)
                ]  # fmt: skip
                costs = [{"seconds": 2.0, "core_seconds": 1.5, "peak_mb": 300.0, "seconds_update": 2.0}] * 3
                done = {"identity": folder, "status": "done", "metrics": "", "rows": rows, "costs": costs}
                (path / "runs" / folder / RESULT).write_text(json.dumps(done))
    config = {"n": 5, "resampler": {"component": "systematic"}}
    described = [
        {"name": arm, "reported_only": arm in reported_only, "uses_truth": [], "config": {**config, "n": 5 + k}}
        for k, arm in enumerate(arms)
    ]
    description = {"format": 2, "name": "a study", "description": "", "reference": arms[0], "arms": described}
    (path / "study.json").write_text(json.dumps({**description, "scenes": scenes, "seeds": [0, 1], "runs": runs}))
    return path


def test_contents_of_the_study_page(tmp_path):
    study = make_study(tmp_path)
    text = write_study_report(study).read_text()
    compared = "&lt;theirs&gt; and ours on s1 in quality (higher is better)"
    assert f"{compared}: no difference can be claimed at n = 4, where p is never below 0.12 (-0.1" in text
    assert "31 of 32 runs" in text and "1 failed" in text
    assert "it &lt;broke&gt;" in text and "mend it" in text and "<broke>" not in text
    assert "simulated by mstfilter" in text
    assert text.count('<svg class="figure"') == 2
    assert not re.search(r"(src|href)=\"(http|//)", text) and "<script" not in text
    assert "n = 6" in text  # where the arms differ
    mean = StudyFolder.open(study).summary().metric("s1", "ours").mean
    assert f"<b>{mean:.3f}</b>" in text


def test_enough_scenes_allow_a_claim(tmp_path):
    text = write_study_report(make_study(tmp_path, n_scenes=20, groups=("s1",), fail=False)).read_text()
    assert re.search(
        r"&lt;theirs&gt; is below ours on s1 in quality \(higher is better\) \(-0\.(09|10)\d+, 95 %", text
    )
    assert "first look" not in text.lower()


def test_the_same_study_gives_the_same_page(tmp_path):
    study = make_study(tmp_path)
    first = write_study_report(study, tmp_path / "a.html").read_bytes()
    assert write_study_report(study, tmp_path / "b.html").read_bytes() == first


def test_more_arms_than_colours_are_drawn_in_several_figures(tmp_path):
    """Each with the reference, points and boxes; none is left out."""
    arms = tuple(f"arm {k}" for k in range(15))
    text = write_study_report(make_study(tmp_path, n_scenes=2, arms=arms, groups=("s1",), fail=False)).read_text()
    drawn = re.findall(r'<svg class="figure".*?</svg>', text, flags=re.S)
    times = [svg for svg in drawn if "over time" in svg]
    assert len(times) == 2 and len(drawn) == 3
    points = 2 * 2 * 3 * 5  # scenes, seeds, pauses, hypotheses
    for svg, others in zip(times, (arms[1:8], arms[8:]), strict=True):
        assert set(re.findall(r">(arm \d+)<", svg)) == {arms[0], *others}
        assert svg.count("<use") >= points * (1 + len(others))
    assert text.count("<figcaption>Each point") == 1


def test_conclusions_leave_out_arms_that_are_reported_only(tmp_path):
    arms = ("ours", "theirs", "floor")
    text = write_study_report(
        make_study(tmp_path, arms=arms, groups=("s1",), fail=False, reported_only=("floor",))
    ).read_text()
    assert "With baselines and oracles" in text and text.count('<svg class="figure"') == 3
    assert "theirs and ours on" in text and "floor and ours on" not in text


def test_null_in_a_result(tmp_path):
    """A number that is not known is left out; a result with null elsewhere is no result."""
    study = make_study(tmp_path, n_scenes=2, groups=("s",))
    paths = {json.loads(p.read_text())["status"]: p for p in sorted(study.glob(f"runs/*/{RESULT}"))}
    done, failed = (json.loads(paths[status].read_text()) for status in ("done", "failed"))
    n = len(StudyFolder.open(study).rows())
    for change in ({"qualities": [0.5, None, 0.6]}, {"qualities": [None]}, {"qualities": None}, {"quality": None}):
        rows = [{**row, **change} for row in done["rows"]]
        paths["done"].write_text(json.dumps({**done, "rows": rows}))
        assert len(StudyFolder.open(study).rows()) == n
    assert write_study_report(study).is_file()
    for name in ("error", "hints", "trace", "tries"):
        paths["failed"].write_text(json.dumps({**failed, name: [None] if name == "hints" else None}))
        StudyFolder.open(study).write_tables()
        assert StudyFolder.open(study).failures() == []


def test_a_study_without_results_has_a_page(tmp_path):
    study = make_study(tmp_path)
    for path in study.rglob(RESULT):
        path.unlink()
    assert "0 of 32 runs" in write_study_report(study).read_text()


def test_command(tmp_path, capsys):
    code, out, _ = call("report", make_study(tmp_path / "s"), "--out", tmp_path / "r.html", capsys=capsys)
    assert code == 0 and "r.html" in out
    with pytest.raises(InputError, match="not a study folder"):
        write_study_report(tmp_path)


def test_arms_that_use_the_ground_truth_are_marked(tmp_path):
    study = make_study(tmp_path, groups=("s1",), fail=False)
    assert "uses the ground truth" not in write_study_report(study).read_text()
    description = json.loads((study / "study.json").read_text())
    description["arms"][1]["uses_truth"] = ["TrueMasks"]
    (study / "study.json").write_text(json.dumps(description))
    text = write_study_report(study).read_text()
    assert (
        "uses the ground truth: TrueMasks" in text and "&lt;theirs&gt; *</td>" in text and "ours *</td>" not in text
    )


def test_times_leave_out_the_seed_that_fills_the_cache():
    rows = [
        {"family": "s1", "scene": "a", "arm": "x", "seed": seed, "pause": 0, "seconds": value}
        for seed, value in ((3, 9.0), (4, 1.0), (5, 2.0))
    ]
    assert summarise(rows, "x", ["seconds"]).metric("s1", "x", "seconds").mean == 1.5
    assert summarise(rows[:1], "x", ["seconds"]).metric("s1", "x", "seconds").mean == 9.0


def results(study):
    """Rows of all runs from the files: arm, scene, seed, pause, quality."""
    for run in json.loads((study / "study.json").read_text())["runs"]:
        for row in json.loads((study / "runs" / run["folder"] / RESULT).read_text()).get("rows", ()):
            yield run["arm"], run["scene"], run["seed"], row["pause"], row["quality"]


def section(text, title):
    """The cells of the tables of a section, without the heads."""
    part = text[text.index(f"<h2>{title}</h2>") :]
    part = part[: part.index("</section>")]
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in re.findall(r"<tr.*?</tr>", part)]
    return [[html.unescape(re.sub("<.*?>", "", cell)) for cell in row] for row in rows if row]


def test_each_scene_has_the_mean_of_each_arm(tmp_path):
    study = make_study(tmp_path)
    found = section(write_study_report(study).read_text(), "Each scene")
    values = list(results(study))
    expected = []
    for scene in [f"{g}-{k}" for g in ("s1", "s2") for k in range(4)]:
        row = [scene]
        for arm in ("ours", "<theirs>"):
            seeds = [
                np.mean([q for a, s, i, t, q in values if (a, s, i) == (arm, scene, seed) and t > 0])
                for seed in (0, 1)
                if any((a, s, i) == (arm, scene, seed) for a, s, i, _, _ in values)  # one run failed
            ]
            row.append(f"{np.mean(seeds):.3f}")
        expected.append(row)
    assert found == expected


def test_the_largest_differences_are_paired_by_seed(tmp_path):
    study = make_study(tmp_path, arms=("ours", "theirs", "floor"), reported_only=("floor",))
    of = {key: q for *key, q in results(study) for key in [tuple(key)]}
    differences = {}
    for (arm, scene, seed, t), q in of.items():
        if arm == "theirs" and t > 0:
            differences.setdefault((scene, t), []).append(q - of["ours", scene, seed, t])
    ranked = sorted(((np.mean(d), place) for place, d in differences.items()), key=lambda one: -abs(one[0]))[:3]
    found = section(write_study_report(study).read_text(), "Where methods differ most")
    assert [(row[0], row[1], row[2], row[3], row[-1]) for row in found] == [
        ("quality", "theirs", scene, str(t), f"{d:+.3f}") for d, (scene, t) in ranked
    ]


@pytest.mark.nightly
def test_pictures_of_the_largest_differences(tmp_path):
    """Of runs that were kept: image, truth and hypotheses of both arms; matching objects have the same number."""
    study = make_study(tmp_path / "study", n_scenes=2, groups=("s1",), fail=False)
    assert "<image" not in write_study_report(study).read_text()
    run = make_run(tmp_path / "run")
    for folder in (study / "runs").iterdir():
        if "s1-0" in folder.name:
            shutil.copytree(run.path, folder, dirs_exist_ok=True)
    text = write_study_report(study).read_text()
    assert all(link.startswith(("data:", "#")) for link in Page(text).links)
    titles = re.findall(r"<h3>(s1-\d, pause \d): &lt;theirs&gt;", text)
    places = [tuple(row[2:4]) for row in section(text, "Where methods differ most")]
    assert titles == [f"{scene}, pause {t}" for scene, t in places if scene == "s1-0"] and titles
    for k, part in enumerate(text.split("<h3>s1-0, pause")[1:]):
        assert part.count(f'href="#photo-{k}"') >= 4  # image, truth, hypotheses of both
        assert re.findall(r"<h4>(.*?)</h4>", part) == ["ours", "&lt;theirs&gt;"]
        # Both arms have the same hypotheses here, so colours and numbers are the same.
        first, second = part.split("<h4>")[1:3]
        pictures = [re.findall(r'<image href="(.*?)"', one) for one in (first, second)]
        assert pictures[0] == pictures[1] and pictures[0]
