from mstfilter.scene.arrays import (
    component_key as component_key,
    content_key as content_key,
    max_of_three as max_of_three,
    read_only as read_only,
)
from mstfilter.scene.cache import Cache as Cache, memo as memo, memo_many as memo_many, scene_cache as scene_cache
from mstfilter.scene.camera import (
    WORKING_PIXELS as WORKING_PIXELS,
    Camera as Camera,
    look_at as look_at,
    rigid_from_matrix as rigid_from_matrix,
    scaled_area as scaled_area,
    scaled_length as scaled_length,
)
from mstfilter.scene.encoding import decode_hypotheses as decode_hypotheses, encode_hypotheses as encode_hypotheses
from mstfilter.scene.evidence import (
    Evidence as Evidence,
    FreeSpace as FreeSpace,
    NoFreeSpace as NoFreeSpace,
    Projection as Projection,
    check_grid as check_grid,
    check_grids as check_grids,
    log_quality as log_quality,
    surface_agreement as surface_agreement,
)
from mstfilter.scene.frame import (
    Clip as Clip,
    Frame as Frame,
    areas_of_colours as areas_of_colours,
    check_depth as check_depth,
    depth_sigma as depth_sigma,
    grey_blocks as grey_blocks,
    main_colour as main_colour,
)
from mstfilter.scene.geometry import (
    frame_geometry as frame_geometry,
    frame_points as frame_points,
)
from mstfilter.scene.heights import (
    above_table as above_table,
    fill_from_nearest as fill_from_nearest,
    filled_above_table as filled_above_table,
    pixels_above_table as pixels_above_table,
    posed_camera as posed_camera,
    readings_above_table as readings_above_table,
)
from mstfilter.scene.occupancy import Occupancy as Occupancy
from mstfilter.scene.outlines import outlined as outlined
from mstfilter.scene.partitions import (
    CommonRefinement as CommonRefinement,
    WeightedSegmentations as WeightedSegmentations,
    canonical as canonical,
    common_refinement as common_refinement,
)
from mstfilter.scene.pauses import PauseRule as PauseRule, pauses_with_depth as pauses_with_depth
from mstfilter.scene.planes import (
    BASELINE as BASELINE,
    TABLE_TOLERANCE as TABLE_TOLERANCE,
    fit_support_plane as fit_support_plane,
    table_residual as table_residual,
)
from mstfilter.scene.plausibility import (
    Finding as Finding,
    Look as Look,
    examine as examine,
    examine_next as examine_next,
    report_findings as report_findings,
)
from mstfilter.scene.recording import (
    LazyFrames as LazyFrames,
    Recording as Recording,
    UsesFiles as UsesFiles,
    find_world as find_world,
    truth_reader as truth_reader,
)
from mstfilter.scene.rendering import (
    Rendering as Rendering,
    project as project,
    render as render,
    render_hypothesis as render_hypothesis,
)
from mstfilter.scene.support import Foreground as Foreground, foreground as foreground, pixel_graph as pixel_graph
from mstfilter.scene.voxels import (
    MAX_LABEL as MAX_LABEL,
    Crop as Crop,
    Hypothesis as Hypothesis,
    ObjectRecord as ObjectRecord,
    ObjectView as ObjectView,
    Seen as Seen,
    VoxelGrid as VoxelGrid,
    as_labels as as_labels,
    free_id as free_id,
    occupied_box as occupied_box,
)
