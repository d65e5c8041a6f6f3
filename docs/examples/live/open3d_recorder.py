"""Filter the frames of an Azure Kinect by the sensor classes of open3d. Stop with Ctrl-C."""

import time

import numpy as np
import open3d as o3d

import mstfilter


def show(pause):
    print(f"pause {pause.index}: {stream.objects}\n  {pause.latency_s:.1f} s after the last frame")


settings = o3d.io.AzureKinectSensorConfig()
sensor = o3d.io.AzureKinectSensor(settings)
if not sensor.connect(0):
    raise SystemExit("the sensor is not connected")
# Intrinsics of the colour camera in this mode: `AzureKinectMKVReader` of a recording reports them.
K = np.array([[605.0, 0, 639.5], [0, 605.0, 359.5], [0, 0, 1]])

try:
    with mstfilter.Stream(K, "mst", on_pause=show) as stream:  # Ctrl-C drops the frames that wait
        while True:
            frame = sensor.capture_frame(True)  # depth is aligned to colour
            if frame is not None:
                stream.push(np.asarray(frame.color), np.asarray(frame.depth) * 0.001, time.monotonic())
except KeyboardInterrupt:
    pass
finally:
    sensor.disconnect()
