"""How long do the networks take on a CPU?

    OMP_NUM_THREADS=1 python experiments/benchmarks/networks.py [--smoke --out FILE]

Processor time on one core, on the pauses of a simulated scene (`s3`, seed 0; 640 x 480 pixels, 1 cm voxels). The
objects of a pause are completed in one batch from their true masks, by the network and by extrusion; the border
network sees the frame, and the tree without it is built beside. Writes networks.csv, medians over pauses; `ratio` is
the median ratio to the weight-free rival of the same pause.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from mstfilter.completion import Extrude, NetworkCompleter
from mstfilter.files import write_csv
from mstfilter.formats import open_recording
from mstfilter.oracles.truth import RecordingTruth
from mstfilter.scene import scene_cache
from mstfilter.segmentation import BorderTree, ColourDepthBoundary, LearnedTree
from mstfilter.simulation import cached_recording

SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 6}


def spent(work: Callable[..., object], *arguments: object) -> float:
    """Processor time in milliseconds of work of which nothing is in the cache."""
    scene_cache.clear()
    began = time.process_time()
    work(*arguments)
    return 1e3 * (time.process_time() - began)


def main(small: bool, out: Path) -> None:
    """Measure and write the table."""
    torch.set_num_threads(1)
    recording = open_recording(cached_recording("demo", 0, **SMALL) if small else cached_recording("s3", 0))
    truth = RecordingTruth(recording)
    rows: dict[str, list[tuple[float, float]]] = {}
    for t, clip in enumerate(recording.clips()):
        frame, image = clip.after, truth.instance(t)
        masks = [image == k for k in np.unique(image[image > 0])]
        batch = np.random.default_rng(0), frame, masks, clip.grid
        network, rule = (spent(c.complete, *batch) / len(masks) for c in (NetworkCompleter(), Extrude()))
        pairs = {"completion of an object": (network, rule)}
        boundary = ColourDepthBoundary().boundary(frame)
        plain = spent(LearnedTree().build, boundary, frame)
        pairs["border network, an image"] = spent(BorderTree().network.look, frame), plain
        pairs["tree with borders, an image"] = spent(BorderTree().build, boundary, frame), plain
        for name, both in pairs.items():
            rows.setdefault(name, []).append(both)
    table = []
    for name, both in rows.items():
        ours, rival = np.array(both).T
        table.append(
            {
                "what": name,
                "ms": np.median(ours),
                "weight_free_ms": np.median(rival),
                "ratio": np.median(ours / rival),
            }
        )
        print(f"{name:<28}{table[-1]['ms']:7.1f} ms, without network {table[-1]['weight_free_ms']:.1f} ms")
    write_csv(out, table, float_format=".3g")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="a small scene; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "networks.csv")
    given = parser.parse_args()
    if given.smoke and given.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another file with --out")
    main(given.smoke, given.out)
