"""Quality of the front ends on simulated first pauses that were not used in the fit, in the image and in space.

    python experiments/segmentation_fit/check.py
    python experiments/segmentation_fit/check.py --border FOLDER --out DIR    # another border model
    python experiments/segmentation_fit/check.py --smoke --out DIR    # one scene: a quick test

Writes results/quality.csv beside this file.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scenes import CHECKED, CHECKED_SEEDS, Pause, pauses, small

from mstfilter.base.files import write_csv
from mstfilter.lab.simulation import SCENE_FAMILIES, SimulatedScene
from mstfilter.mst.completion import Extrude
from mstfilter.mst.segmentation import (
    BorderTree,
    LearnedTree,
    MergeLogOdds,
    MetropolisHastingsCuts,
    OptimalCut,
    SceneCutObjectness,
    TreeCutProposal,
    UcmTree,
    optimal_cut,
)
from mstfilter.scene import Clip
from mstfilter.scoring import weighted_coverage

OLD = {"tree": UcmTree(), "value": SceneCutObjectness()}
NEW = {"tree": LearnedTree(), "value": MergeLogOdds()}
ARMS: dict[str, TreeCutProposal] = {
    "scenecut, optimal cut": TreeCutProposal(**OLD, sampler=OptimalCut()),
    "scenecut, samples": TreeCutProposal(**OLD, sampler=MetropolisHastingsCuts()),
    "learned, optimal cut": TreeCutProposal(**NEW, sampler=OptimalCut()),
    "learned, samples at temperature 0.5": TreeCutProposal(**NEW, sampler=MetropolisHastingsCuts(temperature=0.5)),
    "learned, samples at temperature 1": TreeCutProposal(**NEW, sampler=MetropolisHastingsCuts(temperature=1.0)),
    "learned, samples at temperature 2": TreeCutProposal(**NEW, sampler=MetropolisHastingsCuts(temperature=2.0)),
}
N = 10
RESULTS = Path(__file__).resolve().parent / "results"


def main(out: Path, smoke: bool, border: str) -> None:
    """Score all front ends on every scene and write the table."""
    rows, seen = [], {"tree": BorderTree(weights=border), "value": MergeLogOdds()}
    arms = {
        **ARMS,
        "border, optimal cut": TreeCutProposal(**seen, sampler=OptimalCut()),
        "border, samples at temperature 1": TreeCutProposal(**seen, sampler=MetropolisHastingsCuts(temperature=1.0)),
    }
    for name, family in ((name, SCENE_FAMILIES[name]) for name in (("demo",) if smoke else CHECKED)):
        table: dict[str, list[tuple[float, ...]]] = {arm: [] for arm in [*arms, "true masks"]}
        for seed in CHECKED_SEEDS[: 1 if smoke else None]:
            shown = small(family) if smoke else family
            [pause], volume = pauses(shown, seed), SimulatedScene(shown, seed).truth()
            clip = Clip((pause.frame,), pause.grid, 0)
            for arm, proposal in arms.items():
                n = 1 if isinstance(proposal.sampler, OptimalCut) else N
                population = proposal.sample(np.random.default_rng(seed), clip, n)
                tree, w = proposal.tree_of(pause.frame, pause.grid)
                image = np.nan
                if n == 1:
                    labels = proposal.objects.label_image(tree, optimal_cut(tree, w), pause.frame, pause.grid)
                    image = weighted_coverage(labels, pause.image)
                q = [weighted_coverage(h.labels, volume) for h in population.particles]
                distinct = population.notes["distinct_hypotheses"]
                table[arm].append(
                    (image, float(np.mean(q)), float(np.max(q)), distinct, np.mean(population.notes["objects"]))
                )
            table["true masks"].append(_true_masks(pause, volume))
        for arm, found in table.items():
            mean = [f"{x:.3f}" for x in np.array(found).mean(axis=0)]
            rows.append([name, arm, *mean])
            print(name, arm, *mean)
    header = ("family", "arm", "image", "space_mean", "space_best", "distinct", "objects")
    write_csv(out / "quality.csv", [dict(zip(header, row, strict=True)) for row in rows])


def _true_masks(pause: Pause, volume: np.ndarray) -> tuple[float, ...]:
    from mstfilter.mst.completion import arbitrate

    masks = [pause.image == k for k in range(1, int(pause.image.max()) + 1) if (pause.image == k).any()]
    completions = Extrude().complete(np.random.default_rng(0), pause.frame, masks, pause.grid)
    q = weighted_coverage(arbitrate(completions, pause.grid), volume)
    return 1.0, q, q, 1, len(masks)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="one scene; needs --out")
    parser.add_argument("--border", default="border", help="a border model with fitted evidence")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    if (options.smoke or options.border != "border") and options.out == RESULTS:
        parser.error("this would overwrite the results: name another folder with --out")
    main(options.out, options.smoke, options.border)
