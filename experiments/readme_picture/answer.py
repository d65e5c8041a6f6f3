"""The first picture of the README: what is believed before a push along an open border, and after it.

    python experiments/readme_picture/answer.py [--out docs/images/answer.png]
    python experiments/readme_picture/answer.py --smoke --out FILE

The scene is the one of docs/ambiguity.md, the family `row` with seed 7, filtered by `mst` with the tree `seams` and
seed 0. The push is the first of `push_candidates`.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt

import mstfilter
from mstfilter import Belief
from mstfilter.app.report.answer import Answer, Arrow, draw_answer
from mstfilter.lab.simulation import PushLoop, scene_family
from mstfilter.mst.belief import push_candidates

LEAST = 0.1  # borders with probabilities nearer to 0 or 1 are left out, for a picture that is quickly read
REACH = ((-0.5, -0.5, 0.0), (0.5, 0.5, 0.4))


def main() -> None:
    """Filter the scene and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).resolve().parents[2] / "docs" / "images" / "answer.png"
    parser.add_argument("--out", type=Path, default=default)
    parser.add_argument("--smoke", action="store_true", help="small images; needs --out")
    options = parser.parse_args()
    if options.smoke and options.out == default:
        parser.error("--smoke would overwrite the picture: name another file with --out")
    family = scene_family("row")
    if options.smoke:
        family = replace(family, width=320, height=240)
    loop = PushLoop(family, seed=7)
    mst = mstfilter.preset("mst", "proposal.tree=seams")
    state, info = mst.step(mst.start(seed=0), loop.clip)
    belief, camera = Belief.of_step(state, info), loop.clip.after.camera
    table = belief.objects()
    shown = [(loop.clip.after.rgb, Answer.of(belief, table, camera))]
    pushes = push_candidates(belief, camera, REACH)
    if pushes:
        state, info = mst.step(state, loop.play(pushes[0]))
        belief = Belief.of_step(state, info)
        shown.append((loop.clip.after.rgb, Answer.of(belief, belief.objects(previous=table), camera)))
    _, _, width, height = shown[0][1].box
    figure, axes = plt.subplots(1, len(shown), figsize=(12, 6 * height / width), layout="constrained", squeeze=False)
    played = [Arrow.of(push, camera, push.label) for push in pushes[:1]]
    for place, (image, answer), push in zip(axes[0], shown, [*played, None], strict=True):
        print(*answer.sentences)
        borders = [one for one in answer.borders if LEAST < one.one_object < 1 - LEAST]
        draw_answer(place, replace(answer, box=shown[0][1].box, borders=borders, push=push), image)
    figure.savefig(options.out, dpi=100)


if __name__ == "__main__":
    main()
