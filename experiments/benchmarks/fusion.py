"""Compare crossover with a direct implementation, and lazy with built candidates; writes fusion.csv. See README.md.

Each round has a new table with 5 samples and 5 predictions; all programs fuse all pairs, in random order.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import fusion_plain as plain
import numpy as np
from fusion_parents import GRID, N_OBJECTS, parents, table, table_labels

from mstfilter import preset
from mstfilter.crossover import Crossover, CrossoverUpdate, RandomOrder, conflict_graph
from mstfilter.files import write_csv
from mstfilter.partition import NoDivision
from mstfilter.scene import Camera, Clip, Frame, Hypothesis, NoFreeSpace, canonical, look_at, render, scene_cache
from mstfilter.smc import Population, Systematic
from mstfilter.study import peak_megabytes

HERE = Path(__file__).parent
CAMERA = Camera.from_intrinsics(525, 525, 319.5, 239.5, 640, 480, look_at((0.0, -0.9, 0.8), (0, 0, 0.05)))
N, ETA, KEPT = 5, 5, 5


def fusion_update(name: str) -> CrossoverUpdate:
    """The update of a preset without division, which needs motion: the clip has one frame."""
    update = preset(name).update
    assert isinstance(update, CrossoverUpdate)
    return replace(update, division=NoDivision(), eta=ETA)


def clip_of(seed: int) -> Clip:
    """A clip of one frame of the true table: depth without noise, no colour."""
    depth = render(table_labels(table(np.random.default_rng(seed))), GRID, CAMERA).depth
    directions = CAMERA.rays() @ CAMERA.pose.as_matrix()[:3, :3].T
    floor = -CAMERA.position[2] / np.minimum(directions[..., 2], -1e-6)
    depth = np.where(np.isnan(depth), floor, depth).astype(np.float32)
    return Clip((Frame(np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA),), GRID, 1)


def populations(seed: int, n_proposed: int, n_predicted: int) -> tuple[Population, Population]:
    """Samples and predictions of a table with uneven weights."""
    rng = np.random.default_rng(seed)
    sides = parents(rng, n_proposed, n_predicted)
    proposed, predicted = (Population(side, 0.5 * rng.standard_normal(len(side))) for side in sides)
    return proposed, predicted


@dataclass(frozen=True)
class RecordedOrder(RandomOrder):
    """A random order that stores its draws."""

    seen: list = field(default_factory=list)

    def draw(self, rng, graph, component):
        self.seen.append(super().draw(rng, graph, component))
        return self.seen[-1]


class RecordedGenerator:
    """A generator that stores its uniform numbers."""

    def __init__(self, seed: int) -> None:
        self.rng, self.uniform = np.random.default_rng(seed), []

    def permutation(self, n: int) -> np.ndarray:
        return self.rng.permutation(n)

    def random(self, n: int) -> np.ndarray:
        self.uniform.append(self.rng.random(n))
        return self.uniform[-1]


def agree(crossover: Crossover, proposed: Hypothesis, predicted: Hypothesis, seed: int) -> bool:
    """Whether both programs make the same labels, up to renaming, from the same random decisions."""
    tape, structure = RecordedGenerator(seed), RecordedOrder()
    child = replace(crossover, structure=structure).cross(tape, proposed, predicted)
    graph = conflict_graph(proposed.labels, predicted.labels)
    vertex = list(zip(graph.side.tolist(), graph.label.tolist(), strict=True))
    decisions = plain.Decisions({}, {}, {v: k + 1 for k, v in enumerate(vertex)})
    for (order, edges), uniform in zip(structure.seen, tape.uniform, strict=True):
        decisions.priority.update({vertex[v]: k for k, v in enumerate(order)})
        decisions.chance.update({(vertex[a], vertex[b]): u for (a, b), u in zip(edges, uniform, strict=True)})
    theirs = plain.crossover(None, proposed.labels, predicted.labels, decisions)
    return np.array_equal(canonical(child.labels), canonical(theirs))


def cpu(work: Callable[[], object]) -> float:
    """Processor time of a call in seconds."""
    start = time.process_time()
    work()
    return time.process_time() - start


def one_round(seed: int, n: int, order: np.random.Generator) -> dict[str, float]:
    """Seconds of each program; per candidate if it makes several."""
    proposed, predicted = populations(seed, n, n)
    clip, paper, rules = clip_of(seed), fusion_update("paper"), fusion_update("mst_rules")
    unseen = replace(paper, free_space=NoFreeSpace())
    pairs = [(i, j) for i in range(n) for j in range(n)]

    def direct() -> None:
        for i, j in pairs:
            rng = np.random.default_rng([seed, i, j])
            plain.crossover(rng, proposed.particles[i].labels, predicted.particles[j].labels)

    def ours(crossover: Crossover) -> None:
        for i, j in pairs:
            crossover.cross(np.random.default_rng([seed, i, j]), proposed.particles[i], predicted.particles[j])

    def step(update: CrossoverUpdate, lazy: bool) -> None:
        fused = update.update(np.random.default_rng(seed), predicted, proposed, clip)
        candidates = fused.particles
        fused = fused if lazy else fused.realised()
        chosen = Systematic().resample(np.random.default_rng(seed), fused, KEPT).realised()
        assert len(chosen) == KEPT and candidates.n_built == (KEPT if lazy else n * n * ETA)

    drawn = replace(rules, evidence=()).update(np.random.default_rng(seed), predicted, proposed, clip)
    drawn = Systematic().resample(np.random.default_rng(seed), drawn, 4 * n).realised()

    def score() -> None:
        for term in rules.evidence:
            term.log_score(drawn.particles, clip)

    def projected() -> None:
        scene_cache.clear()  # a new frame at every step
        for hypothesis in predicted.particles:
            paper.free_space.project(hypothesis, clip.after)

    work: dict[str, tuple[Callable[[], None], int]] = {
        "plain": (direct, len(pairs)),
        "paper": (lambda: ours(paper.crossover), len(pairs)),
        "mst_rules": (lambda: ours(rules.crossover), len(pairs)),
        "all": (lambda: step(unseen, lazy=False), 1),
        "lazy": (lambda: step(unseen, lazy=True), 1),
        "projection": (projected, 1),
        "evidence": (score, len(drawn)),
    }
    names = list(work)
    order.shuffle(names)
    return {name: cpu(work[name][0]) / work[name][1] for name in names}


def large(name: str, n: int, n_proposed: int) -> dict[str, float]:
    """One step with n hypotheses in this process: number of particles kept, seconds, peak memory in MiB."""
    proposed, predicted = populations(0, n_proposed, n)
    clip, update = clip_of(0), fusion_update(name)
    start = time.process_time()
    fused = update.update(np.random.default_rng(0), predicted, proposed, clip)
    chosen = Systematic().resample(np.random.default_rng(0), fused, n).realised()
    return {"kept": len(chosen), "seconds": time.process_time() - start, "peak": peak_megabytes()}


def main() -> None:
    """Check that both programs agree, run the rounds and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--smoke", action="store_true", help="one small round; needs --out")
    parser.add_argument("--large", nargs=3, metavar=("PRESET", "N", "N_PROPOSED"), help="one step; prints JSON")
    options = parser.parse_args()
    if options.large:
        print(json.dumps(large(options.large[0], int(options.large[1]), int(options.large[2]))))
        return
    if options.smoke and options.out == HERE:
        parser.error("--smoke would overwrite the results: name another folder with --out")
    n, many, rounds = (1, (2, 1), 1) if options.smoke else (N, (100, 20), options.rounds)

    proposed, predicted = populations(1000, n, n)
    crossover, pairs = fusion_update("paper").crossover, [(i, j) for i in range(n) for j in range(n)]
    same = sum(agree(crossover, proposed.particles[i], predicted.particles[j], 10 * i + j) for i, j in pairs)
    if same != len(pairs):
        sys.exit(f"only {same} of {len(pairs)} pairs give the same labels on the same random decisions")

    order = np.random.default_rng(0)
    if not options.smoke:
        one_round(rounds, 1, order)  # warm-up
    rows = [one_round(seed, n, order) for seed in range(rounds)]

    def measured(what: str, name: str) -> tuple[str, str, str, str, str]:
        values = [1e3 * r[name] for r in rows]
        return what, "ms", f"{np.median(values):.2f}", f"{min(values):.2f}", ""

    def ratio(what: str, a: Callable[[dict], float], b: Callable[[dict], float], target: str = "") -> tuple:
        of_minima = min(map(a, rows)) / min(map(b, rows))
        return what, "ratio", f"{np.median([a(r) / b(r) for r in rows]):.1f}", f"{of_minima:.1f}", target

    done = [
        ("pairs with the same labels on the same random decisions", "pairs", str(same), "", f">= {len(pairs)}"),
        measured("a candidate, straightforward numpy and networkx", "plain"),
        measured("a candidate, paper's crossover", "paper"),
        ratio("straightforward / paper's crossover", lambda r: r["plain"], lambda r: r["paper"], ">= 5"),
        measured(f"all {n * n * ETA} candidates built, {KEPT} chosen", "all"),
        measured(f"{KEPT} of {n * n * ETA} chosen, then built", "lazy"),
        ratio("all built / only the chosen built", lambda r: r["all"], lambda r: r["lazy"], ">= 20"),
        measured(f"free space of a new frame, {n} predictions projected", "projection"),
        ratio(
            "all built / only the chosen built, projection on either side",
            lambda r: r["all"] + r["projection"],
            lambda r: r["lazy"] + r["projection"],
        ),
        measured("a candidate, crossover of mst_rules", "mst_rules"),
        measured(f"evidence of mst_rules, a scored candidate of {4 * n}", "evidence"),
    ]
    for name, target in (("paper", "<= 2048"), ("mst_rules", "")):
        command = [sys.executable, __file__, "--large", name, *map(str, many)]
        found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        assert found["kept"] == many[0]
        what = f"{name}: {many[0]} hypotheses x {many[1]} samples x {ETA}"
        done.append((f"{what}, peak memory", "MiB", f"{found['peak']:.0f}", "", target))
        done.append((f"{what}, time", "s", f"{found['seconds']:.1f}", "", ""))
    columns = ("what", "unit", "median", "of_minima", "target", "clock")
    write_csv(options.out / "fusion.csv", [dict(zip(columns, (*row, "cpu"), strict=True)) for row in done])
    for row in done:
        print(f"{row[0]:62s} {row[2]:>10s} {row[3]:>10s} {row[1]:6s} {row[4]}")
    print(f"{N_OBJECTS} objects, {GRID.shape[0]} x {GRID.shape[1]} x {GRID.shape[2]} voxels, {rounds} rounds")


if __name__ == "__main__":
    main()
