"""A recording with truth, small and exact: two boxes; one slides, at the end the other hides behind it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mstfilter.formats import RecordingWriter, open_recording
from mstfilter.scene import render
from mstfilter.smc import Proposal
from tests.scene.scenes import CAMERA, GRID, table_scene


def slide(path, shifts=(0, 1, 2, 3, 4), noise=True):
    """Pauses at even places of `shifts`: how many voxels box 1 stands to the right."""
    rng = np.random.default_rng(0)
    with RecordingWriter(path, CAMERA, GRID) as writer:
        for index, shift in enumerate(shifts):
            rgb, depth, labels = table_scene(shift, rng if noise else None)
            pose = np.eye(4)
            pose[0, 3] = shift * GRID.voxel_size
            writer.add_frame(
                rgb,
                depth,
                index / 5,
                "action" if index % 2 else "static",
                instance=render(labels, GRID, CAMERA).labels.astype(np.uint8),
                poses={1: pose, 2: np.eye(4)},
            )
            if index % 2 == 0:
                writer.add_voxels(labels)
    return open_recording(path)


@dataclass(frozen=True)
class ProposalRecorder(Proposal):
    """Another proposal, with the keys of the hypotheses that it has drawn, by pause."""

    proposal: Proposal
    drawn: list = field(default_factory=list)

    def sample(self, rng, observation, n):
        population = self.proposal.sample(rng, observation, n)
        self.drawn.append([h.key for h in population.particles])
        return population
