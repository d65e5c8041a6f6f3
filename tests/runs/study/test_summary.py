"""From rows to means and differences, against numbers worked out by hand."""

from __future__ import annotations

import csv
import re

import numpy as np
import pytest

from mstfilter.runs.study import StudyFolder
from mstfilter.runs.study.summary import summarise
from mstfilter.scoring import LOG_LOSS
from mstfilter.scoring.statistics import compare, holm, interval
from tests.app.report.test_study_report import make_study, results


def rows():
    """Two families, two arms, three scenes, two seeds, three pauses; quality from a table of our own."""
    rng = np.random.default_rng(0)
    for family in ("f", "g"):
        for scene in range(3):
            for arm in ("ours", "theirs"):
                for seed in range(2):
                    for t in range(3):
                        yield {
                            "family": family, "scene": f"{family}{scene}", "arm": arm, "seed": seed, "pause": t,
                            "time_s": t, "quality": float(rng.random()), "quality_hidden": None if t < 2 else 0.5,
                            "core_seconds": float(t),
                        }  # fmt: skip


def test_means_are_over_later_pauses_then_seeds_then_scenes():
    table = list(rows())
    found = summarise(table, "ours", ["core_seconds"])
    chosen = found.metric("g", "ours")
    for scene in ("g0", "g1", "g2"):
        seeds = [
            np.mean(
                [
                    r["quality"]
                    for r in table
                    if (r["scene"], r["arm"], r["seed"]) == (scene, "ours", seed) and r["pause"]
                ]
            )
            for seed in range(2)
        ]
        assert chosen.by_scene[scene] == pytest.approx(np.mean(seeds))
    assert chosen.mean == pytest.approx(np.mean(list(chosen.by_scene.values())))
    assert found.metric("f", "ours", "quality_hidden").mean == 0.5
    assert found.metric("f", "ours", "core_seconds").mean == 1.0  # of all pauses
    assert found.metric("f", "ours", "time_s") is None
    assert set(found.names) == {"quality", "quality_slope", "quality_hidden", "core_seconds"}


def test_slope_is_a_pause():
    table = [{**r, "quality": 0.9 - 0.1 * r["pause"]} for r in rows()]
    assert summarise(table, "ours").metric("f", "theirs", "quality_slope").mean == pytest.approx(-0.1)


def test_differences_are_paired_and_adjusted_together():
    found = summarise(list(rows()), "ours", ["core_seconds"])
    primary = found.compared()
    assert [(d.family, d.arm, d.reference) for d in primary] == [("f", "theirs", "ours"), ("g", "theirs", "ours")]
    for one in primary:
        expected = compare(found.metric(one.family, "theirs").by_scene, found.metric(one.family, "ours").by_scene)
        assert one.difference.mean == expected.mean and one.difference.p == expected.p
        assert one.difference.p_holm >= one.difference.p
        assert "n = 3" in one.words
    assert found.compared("core_seconds") == []
    assert {d.metric for d in found.differences} == {"quality", "quality_slope", "quality_hidden"}


def test_floors_take_no_part_in_the_adjustment():
    table = list(rows())
    floor = [{**r, "arm": "floor"} for r in table if r["arm"] == "theirs"]
    with_floor = summarise([*table, *floor], "ours", reported_only=["floor"])
    assert [d.difference.p_holm for d in with_floor.compared() if not d.reported_only] == [
        d.difference.p_holm for d in summarise(table, "ours").compared()
    ]
    reported_only = [d for d in with_floor.compared() if d.reported_only]
    assert [d.arm for d in reported_only] == ["floor", "floor"] and np.isnan(reported_only[0].difference.p_holm)
    assert not [r for r in with_floor.difference_rows() if r["arm"] == "floor" and r["conclusion"]]


def test_a_scene_that_one_arm_lacks_is_left_out_of_the_pairs():
    table = [r for r in rows() if not (r["arm"] == "theirs" and r["scene"] == "f1")]
    found = summarise(table, "ours")
    assert found.compared()[0].difference.n == 2
    assert len(found.metric("f", "ours").by_scene) == 3


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("n_scenes", "lag", "better"),
    [
        (20, (0.1, 0.1), True),
        (20, (0.1, -0.001), True),  # the other endpoint is worse by less than .005
        (20, (0.1, -0.01), False),
        (20, (0.0, 0.1), True),
        (19, (0.1, 0.1), False),
        (1, (0.1, 0.1), False),
    ],
)
def test_a_filter_is_better_by_the_rule_for_claims(n_scenes, lag, better):
    """`lag` is how far the other arm is behind in quality and in log loss, times 1 to 2."""
    rng = np.random.default_rng(1)
    table = [
        {"family": "f", "scene": str(k), "arm": arm, "seed": 0, "pause": 1,
         "quality": 0.5 - behind * lag[0] * (1 + rng.random()), LOG_LOSS: 0.5 + behind * lag[1] * (1 + rng.random())}
        for k in range(n_scenes)
        for arm, behind in (("ours", 0), ("theirs", 1))
    ]  # fmt: skip
    assert summarise(table, "ours").is_better("f", "theirs") is better


def test_own_metrics_are_adjusted_with_the_endpoints():
    rng = np.random.default_rng(2)
    table = [
        {"family": "f", "scene": str(k), "arm": arm, "seed": 0, "pause": 1,
         "quality": 0.1 * shift + rng.normal(), "height": shift + rng.normal(), "split": rng.normal()}
        for k in range(8)
        for arm, shift in (("ours", 0), ("theirs", 1))
    ]  # fmt: skip
    found = summarise(table, "ours", own=["height"])
    p = {one.metric: one.difference for one in found.differences}
    expected = holm([p["quality"].p, p["height"].p])
    assert [p["quality"].p_holm, p["height"].p_holm] == expected.tolist()
    assert np.isnan(p["split"].p_holm) and found.compared_first == ("quality", LOG_LOSS, "height")
    [words] = [one.words for one in found.differences if one.metric == "height"]
    assert words.startswith("theirs and ours on f in height: ") and "better" not in words


STRANGE = r"50% a_b & c#1 {x}~^\d|<e> $"  # every character that LaTeX or Markdown reads as a command
LATEX = {"textbackslash{}": "\\", "textasciitilde{}": "~", "textasciicircum{}": "^"}
LATEX |= {"textless{}": "<", "textgreater{}": ">", "textbar{}": "|"}


def latex_rows(path):
    """Cells of a LaTeX table, read by an independent parser of the commands that the table may use."""
    text = path.read_text()
    assert re.fullmatch(r"% .*\n\\begin\{table\}(.*\n)*\\end\{table\}\n", text)
    assert [text.count(rf"\{rule}") for rule in ("toprule", "midrule", "bottomrule", "hline")] == [1, 1, 1, 0]
    body = text[text.index(r"\toprule") + 8 : text.index(r"\bottomrule")].replace("\\midrule", "")
    rows = []
    for line in filter(None, map(str.strip, body.split("\n"))):
        assert line.endswith(r" \\")
        cells = []
        for cell in re.split(r" (?<!\\)& ", line[:-3]):
            cell = re.sub(r"\$([+-])\$", r"\1", cell)
            assert not re.search(r"(?<!\\)[&%$#_]", cell), cell
            cells.append(re.sub(r"\\(text\w+\{\}|.)", lambda m: LATEX.get(m[1], m[1]), cell).replace("--", "–"))
        rows.append(cells)
    columns = re.search(r"\\begin\{tabular\}\{(\w+)\}", text)[1]
    assert {len(row) for row in rows} == {len(columns)}
    return rows


def markdown_rows(path):
    lines = path.read_text().split("\n\n", 1)[1].splitlines()
    rows = [re.split(r" (?<!\\)\| ", line.removeprefix("| ").removesuffix(" |")) for line in lines]
    assert set("".join(rows.pop(1))) == set("-:")
    return [[re.sub(r"\\(.)", r"\1", cell) for cell in row] for row in rows]


def test_tables_for_a_text_have_means_intervals_and_numbers_of_scenes(tmp_path):
    """Against means and intervals of values that are read from the files of the runs."""
    study = make_study(tmp_path, n_scenes=5, arms=("ours", STRANGE), groups=("s1",), fail=True)
    StudyFolder.open(study).write_tables()
    runs = {}
    for arm, scene, seed, pause, q in results(study):
        if pause > 0:
            runs.setdefault((arm, scene), {}).setdefault(seed, []).append(q)

    def scene_means(arm, seeds_of=None):
        found = [(runs[arm, f"s1-{k}"], runs[seeds_of or arm, f"s1-{k}"]) for k in range(5)]
        return [np.mean([np.mean(qs) for seed, qs in mine.items() if seed in both]) for mine, both in found]

    ours, theirs = scene_means("ours"), scene_means(STRANGE)
    paired = np.subtract(scene_means(STRANGE, "ours"), scene_means("ours", STRANGE))

    def estimate(values, sign=""):
        low, high = interval(np.array(values))
        return f"{np.mean(values):{sign}.3f} [{low:{sign}.3f}, {high:{sign}.3f}]"

    head = ["family", "method", "n", "quality", "log loss (nats)", "time per step (s)"]
    means = [["s1", arm, "5", estimate(q), "–", "2.00"] for arm, q in (("ours", ours), (STRANGE, theirs))]
    with (study / "differences.csv").open(newline="", encoding="utf-8") as file:
        p = next(row["p_holm"] for row in csv.DictReader(file) if row["metric"] == "quality")
    difference = ["s1", STRANGE, "5", estimate(paired, "+"), f"{float(p):.3f}", "–", "–"]
    for read, kind in ((latex_rows, "tex"), (markdown_rows, "md")):
        assert read(study / f"summary.{kind}") == [head, *means]
        assert read(study / f"differences.{kind}")[1:] == [difference]
    caption = (study / "summary.md").read_text().split("\n")[0]
    assert "95 % bootstrap intervals" in caption and "n scenes" in caption and "warm cache" in caption
    assert r"95~\% bootstrap intervals" in (study / "summary.tex").read_text()


def test_seeds_that_failed_in_one_arm_are_left_out_of_the_difference():
    """Equal arms, whose second seed is better. The reference has no second seed on every other scene."""
    table = [
        {"family": "f", "scene": str(k), "arm": arm, "seed": seed, "pause": 1, "quality": 0.5 + 0.1 * seed + 0.01 * k}
        for k in range(20)
        for arm in ("ours", "theirs")
        for seed in (0, 1)
        if not (arm == "ours" and seed and k % 2)
    ]
    [one] = summarise(table, "ours").compared()
    assert (one.difference.n, one.difference.mean) == (20, pytest.approx(0, abs=1e-12))
    assert summarise(table, "ours").metric("f", "theirs").by_scene["1"] == pytest.approx(0.56)


def test_the_first_seed_of_each_scene_fills_the_cache():
    """The first seed failed in scene B, so the second one filled the cache there. In scene C, seed 5 ran first."""
    table = [
        {"family": "f", "scene": scene, "arm": "a", "seed": k, "pause": 1, "quality": 0.5, "seconds": t}
        for scene, times in (
            ("A", {0: 100.0, 1: 1.0, 2: 1.0}),
            ("B", {1: 100.0, 2: 1.0}),
            ("C", {5: 100.0, 3: 1.0}),
        )
        for k, t in times.items()
    ]
    found = summarise(table, "a", ["seconds"])
    assert found.warm and found.metric("f", "a", "seconds").by_scene == {"A": 1, "B": 1, "C": 1}
