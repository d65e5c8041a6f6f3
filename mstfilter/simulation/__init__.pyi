from mstfilter.simulation.families import (
    FIRST_REPORTED_SEED as FIRST_REPORTED_SEED,
    GENERATOR_VERSION as GENERATOR_VERSION,
    SCENE_FAMILIES as SCENE_FAMILIES,
    SceneFamily as SceneFamily,
    scene_family as scene_family,
)
from mstfilter.simulation.recorder import (
    TOLERANCE as TOLERANCE,
    Scene as Scene,
    cache_folder as cache_folder,
    cached_recording as cached_recording,
    recipe_key as recipe_key,
    record as record,
    simulate as simulate,
)
from mstfilter.simulation.renderer import Renderer as Renderer
from mstfilter.simulation.sensor import DepthSensor as DepthSensor
from mstfilter.simulation.world import (
    Effect as Effect,
    Push as Push,
    advance as advance,
    choose_push as choose_push,
    finish as finish,
    play as play,
)
