from mstfilter.base.errors import InputError as InputError
from mstfilter.formats import open_recording as open_recording
from mstfilter.mst.belief import Belief as Belief
from mstfilter.runs.live import Stream as Stream
from mstfilter.runs.presets import preset as preset
from mstfilter.scene import (
    Camera as Camera,
    Clip as Clip,
    Frame as Frame,
    Hypothesis as Hypothesis,
    ObjectRecord as ObjectRecord,
    Recording as Recording,
    VoxelGrid as VoxelGrid,
)
from mstfilter.scoring import weighted_coverage as weighted_coverage
from mstfilter.smc import ParticleFilter as ParticleFilter, Population as Population

__version__: str
