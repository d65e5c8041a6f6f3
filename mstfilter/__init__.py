"""Particle filtering over scene hypotheses.

>>> import mstfilter
>>> recording = mstfilter.Recording.from_arrays(rgb, depth, K)     # depth in metres
>>> state, infos = mstfilter.preset("mst").run(recording.clips(), seed=0)
>>> state.population.best.volumes()

See `mstfilter.presets` for the assembled filters, `mstfilter.smc` for the filter itself, `mstfilter.scene`
for cameras, recordings and hypotheses.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_EXPORTS = {
    "Belief": "mstfilter.fusion.belief",
    "Camera": "mstfilter.scene.camera",
    "Clip": "mstfilter.scene.clip",
    "Frame": "mstfilter.scene.frame",
    "Hypothesis": "mstfilter.scene.voxels",
    "InputError": "mstfilter.errors",
    "ObjectRecord": "mstfilter.scene.voxels",
    "ParticleFilter": "mstfilter.smc.particle_filter",
    "Population": "mstfilter.smc.population",
    "Recording": "mstfilter.scene.recording",
    "VoxelGrid": "mstfilter.scene.voxels",
    "preset": "mstfilter.presets",
    "weighted_coverage": "mstfilter.scene.quality",
}

__all__ = ["__version__", *_EXPORTS]

if TYPE_CHECKING:
    from mstfilter.errors import InputError as InputError
    from mstfilter.fusion.belief import Belief as Belief
    from mstfilter.presets import preset as preset
    from mstfilter.scene.camera import Camera as Camera
    from mstfilter.scene.clip import Clip as Clip
    from mstfilter.scene.frame import Frame as Frame
    from mstfilter.scene.quality import weighted_coverage as weighted_coverage
    from mstfilter.scene.recording import Recording as Recording
    from mstfilter.scene.voxels import Hypothesis as Hypothesis
    from mstfilter.scene.voxels import ObjectRecord as ObjectRecord
    from mstfilter.scene.voxels import VoxelGrid as VoxelGrid
    from mstfilter.smc.particle_filter import ParticleFilter as ParticleFilter
    from mstfilter.smc.population import Population as Population


def __getattr__(name: str) -> Any:
    # Names are looked up on first use: `import mstfilter` stays quick, scipy and OpenCV come when needed.
    if name in _EXPORTS:
        value = getattr(import_module(_EXPORTS[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'mstfilter' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
