from mstfilter.lab.simulation.families import (
    FIRST_REPORTED_SEED as FIRST_REPORTED_SEED,
    GENERATOR_VERSION as GENERATOR_VERSION,
    PUSH_AIMS as PUSH_AIMS,
    SCENE_FAMILIES as SCENE_FAMILIES,
    SceneFamily as SceneFamily,
    scene_family as scene_family,
)
from mstfilter.lab.simulation.groups import Group as Group, part_image as part_image
from mstfilter.lab.simulation.objects import (
    MeshObject as MeshObject,
    ObjectSet as ObjectSet,
    open_objects as open_objects,
)
from mstfilter.lab.simulation.push_loop import LoopState as LoopState, PushLoop as PushLoop
from mstfilter.lab.simulation.recorder import (
    POSE_TOLERANCE as POSE_TOLERANCE,
    SimulatedScene as SimulatedScene,
    cached_path as cached_path,
    cached_recording as cached_recording,
    recipe_key as recipe_key,
    simulate_recording as simulate_recording,
)
from mstfilter.lab.simulation.renderer import Renderer as Renderer
from mstfilter.lab.simulation.sensor import (
    SENSORS as SENSORS,
    DepthSensor as DepthSensor,
    colour_reading as colour_reading,
)
from mstfilter.lab.simulation.world import (
    FingerPush as FingerPush,
    PushEffect as PushEffect,
    advance_push as advance_push,
    choose_push as choose_push,
    finish_push as finish_push,
    play_push as play_push,
)
