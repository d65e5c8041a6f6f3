"""Filter the frames of a RealSense camera. Needs pyrealsense2. Stop with Ctrl-C."""

import numpy as np
import pyrealsense2 as rs

import mstfilter


def show(pause):
    print(f"pause {pause.index}: {stream.objects}\n  {pause.latency_s:.1f} s after the last frame")


pipeline, config = rs.pipeline(), rs.config()
config.enable_stream(rs.stream.color, 640, 480, rs.format.rgb8, 15)
config.enable_stream(rs.stream.depth, 640, 480, rs.format.z16, 15)
profile = pipeline.start(config)
scale = profile.get_device().first_depth_sensor().get_depth_scale()
lens = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
K = np.array([[lens.fx, 0, lens.ppx], [0, lens.fy, lens.ppy], [0, 0, 1]])
align = rs.align(rs.stream.color)

try:
    with mstfilter.Stream(K, "mst", on_pause=show) as stream:  # Ctrl-C drops the frames that wait
        while True:
            frames = align.process(pipeline.wait_for_frames())
            colour, depth = frames.get_color_frame(), frames.get_depth_frame()
            stream.push(
                np.asarray(colour.get_data()), np.asarray(depth.get_data()) * scale, frames.get_timestamp() / 1000
            )
except KeyboardInterrupt:
    pass
finally:
    pipeline.stop()
