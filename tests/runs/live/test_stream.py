"""Streams: the same results as on a recording, dropped frames, bounded memory, errors."""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

import mstfilter
from mstfilter.app.report import write_report
from mstfilter.base.errors import InputError, InputWarning
from mstfilter.formats import Redwood, Settled, Still, open_format, write_image
from mstfilter.runs import RunFolder, filter_recording
from mstfilter.runs.live import filter_folder
from mstfilter.runs.presets import load_config
from mstfilter.scene import Recording, encode_hypotheses, scene_cache
from tests.formats.layouts import FPS, SHIFTS, video, write_redwood
from tests.scene.scenes import CAMERA, GRID
from tests.wrong_inputs import shifted_camera

RULE = Settled(hold_s=0.3)
FAST = mstfilter.preset("mst", "n=2", "n_proposed=2")
#: For tests of what a stream does with frames, whatever the filter makes of them.
QUICK = mstfilter.preset("floor_one_blob", "n=2")
RGB, DEPTH, _ = video()
TIMES = np.arange(len(SHIFTS)) / FPS
PAUSES = (3, 13)  # 0.3 s after the first frames 0 and 10 of the still intervals


def arrays(state):
    """Bytes of the particles and the weights of a state."""
    found = {
        name: np.asarray(value).tobytes() for name, value in encode_hypotheses(state.population.particles).items()
    }
    return found | {"log_weights": state.population.log_weights.tobytes()}


def pushed(**more):
    """The results at the pauses of a stream."""
    found = []
    with mstfilter.Stream(CAMERA.K, FAST, seed=4, on_pause=found.append, pauses=RULE, **more) as stream:
        for k in range(len(SHIFTS)):
            assert stream.push(RGB[k], DEPTH[k], TIMES[k])
    return found


def filtered(**more):
    """The states of the filter on a recording of the same frames."""
    scene_cache.clear()
    recording = Recording.from_arrays(RGB, DEPTH, CAMERA.K, times=TIMES, **more)
    return [state for state, _ in FAST.iterate(recording.clips(), 4)]


@pytest.mark.parametrize("threads", [pytest.param(1, marks=pytest.mark.nightly), 4])
def test_a_stream_has_the_results_of_the_recording(threads):
    states = filtered(pauses=RULE)
    scene_cache.clear()
    found = pushed(threads=threads)
    assert [pause.frames[-1] for pause in found] == list(PAUSES)
    assert [len(pause.clip) for pause in found] == [1, 11]
    assert [arrays(pause.state) for pause in found] == [arrays(state) for state in states]
    assert found[1].counts == {"pushed": len(SHIFTS)}


def test_a_stream_reduces_large_images():
    with mstfilter.Stream(CAMERA.K, QUICK, pauses=None, max_pixels=5000) as stream:
        for k in (0, 1):
            stream.push(RGB[k], DEPTH[k], TIMES[k], pause=True)
        stream.wait()
        small = CAMERA.limited(5000)
        for frame in stream.last.clip.frames:
            assert frame.depth.shape == (small.height, small.width)
            np.testing.assert_allclose(frame.camera.K, small.K)
            assert frame.camera.T_world_camera is not None


def test_frames_can_be_announced_as_pauses():
    states = filtered(pauses=(2, 15))
    found = []
    with mstfilter.Stream(CAMERA.K, FAST, seed=4, pauses=None, on_pause=found.append) as stream:
        with pytest.raises(InputError, match="no pause yet"):
            _ = stream.belief
        for k in range(len(SHIFTS)):
            stream.push(RGB[k], DEPTH[k], TIMES[k], pause=k in (2, 15))
        stream.wait()
        assert stream.hypotheses == tuple(stream.state.population.particles)
        assert stream.belief.object_count().sum() == pytest.approx(1)
        assert arrays(stream.state) == arrays(states[1])
    assert len(found) == 2


def test_late_frames_and_frames_without_depth_are_dropped_and_counted():
    found = []
    with mstfilter.Stream(CAMERA.K, FAST, seed=4, pauses=RULE, on_pause=found.append) as stream:
        for k in range(len(SHIFTS)):
            assert stream.push(RGB[k], DEPTH[k], TIMES[k])
            assert not stream.push(RGB[k], DEPTH[k], TIMES[k] - 0.05)
            assert not stream.push(RGB[k], None, TIMES[k] + 0.01)
            assert not stream.push(RGB[k], np.full_like(DEPTH[k], np.nan), TIMES[k] + 0.01)
    assert stream.counts == {"pushed": 4 * len(SHIFTS), "late": len(SHIFTS), "no depth": 2 * len(SHIFTS)}
    assert [pause.frames[-1] for pause in found] == [4 * k for k in PAUSES]
    assert arrays(found[-1].state) == arrays(filtered(pauses=RULE)[-1])


FAR = {"one stamp far ahead": 1e9, "one stamp ahead": 1e3, "one old stamp": -50.0}


@pytest.mark.parametrize("k", [0, 6])
@pytest.mark.parametrize("change", [*FAR, "clock set back", "clock set ahead"])
def test_a_stream_recovers_from_a_wrong_stamp_and_from_a_clock_that_is_set(change, k):
    times = TIMES + 100
    if change in FAR:
        times[k] += FAR[change]
    else:
        times[k:] += -50 if change == "clock set back" else 1e7
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        with mstfilter.Stream(CAMERA.K, QUICK, seed=4, pauses=None, on_pause=found.append) as stream:
            accepted = [stream.push(RGB[j], DEPTH[j], times[j], pause=j in (4, 15)) for j in range(len(TIMES))]
    assert accepted.count(False) <= 1 and accepted[4] and accepted[15]
    assert [pause.frames[-1] for pause in found] == [4, 15]
    stamps = found[1].clip.times
    assert (np.diff(stamps) > 0).all()
    if change == "one stamp ahead" and k:  # the step to the wrong stamp remains
        assert np.diff(stamps).max() == pytest.approx(1e3, abs=1)
    else:
        assert np.diff(stamps).max() < 0.25


def test_the_change_of_a_clock_is_told_and_a_late_frame_is_none():
    with mstfilter.Stream(CAMERA.K, QUICK, pauses=None) as stream:
        for when in (100.0, 100.1):
            assert stream.push(RGB[0], DEPTH[0], when)
        with pytest.warns(InputWarning, match="late"):
            assert not stream.push(RGB[0], DEPTH[0], 99.8)
        assert not stream.push(RGB[0], DEPTH[0], 99.9)  # frames that arrive late, in a row
        assert stream.push(RGB[0], DEPTH[0], 100.2)
        assert not stream.push(RGB[0], DEPTH[0], 5.0)
        with pytest.warns(InputWarning, match=r"jump by -95.1 s at frame 6: the clock was set"):
            assert stream.push(RGB[0], DEPTH[0], 5.1)
        assert stream.push(RGB[0], DEPTH[0], 5.2)
        assert stream.counts == {"pushed": 8, "late": 3}


def test_an_exception_drops_the_queue():
    """The step that is being computed is completed; of the ten frames that wait, each a pause, none is filtered."""
    begun, gate, found = threading.Event(), threading.Event(), []

    def show(pause):
        begun.set()
        gate.wait()
        found.append(pause.index)

    with pytest.raises(KeyboardInterrupt), mstfilter.Stream(CAMERA.K, QUICK, pauses=None, on_pause=show) as stream:
        stream.push(RGB[0], DEPTH[0], 0.0, pause=True)
        begun.wait()
        for k in range(1, 11):
            stream.push(RGB[k], DEPTH[k], float(k), pause=True)
        threading.Timer(0.2, gate.set).start()
        raise KeyboardInterrupt
    assert found == [0]
    with pytest.raises(InputError, match="closed"):
        stream.push(RGB[0], DEPTH[0], 20.0)


def test_streams_in_several_threads_have_the_results_of_one():
    def run(k):
        found = []
        with mstfilter.Stream(CAMERA.K, FAST, seed=k, pauses=None, threads=2, on_pause=found.append) as stream:
            for j in (0, len(SHIFTS) - 1):
                stream.push(RGB[j], DEPTH[j], TIMES[j], pause=True, wait=True)
        return [arrays(pause.state) for pause in found]

    expected = [run(k) for k in range(2)]
    scene_cache.clear()
    with ThreadPoolExecutor(2) as users:
        assert list(users.map(run, range(2))) == expected


def test_a_long_clip_is_thinned_and_has_the_result_of_the_frames_that_remain():
    found = []
    with mstfilter.Stream(CAMERA.K, FAST, seed=4, pauses=None, max_frames=6, on_pause=found.append) as stream:
        for k, shift in enumerate([0] * 40 + [1, 2, 3, 4] + [5] * 40):
            j = SHIFTS.index(shift)
            stream.push(RGB[j], DEPTH[j] + 1e-5 * (k % 3), k / FPS, pause=k in (0, 83))
            stream._queue.join()  # the frames wait for the thread, so that none is dropped
    last = found[-1]
    assert len(last.clip) <= 6 and last.counts["thinned"] == 84 - len(last.clip)
    scene_cache.clear()
    kept = Recording(last.clip.frames, last.clip.grid, (0, len(last.clip) - 1), last.clip.times)
    assert arrays(last.state) == arrays([state for state, _ in FAST.iterate(kept.clips(), 4)][-1])


def test_a_moved_camera_has_the_message_of_a_recording():
    arrays = shifted_camera()
    with pytest.raises(InputError) as recorded:
        Recording.from_arrays(**arrays)
    stream = mstfilter.Stream(arrays["K"], QUICK, pauses=None)
    for k in (0, 1):
        stream.push(arrays["rgb"][k], arrays["depth"][k], float(k), pause=True)
    with pytest.raises(InputError) as live:
        stream.wait()
    said = [error.value.message.partition(": ")[2] for error in (recorded, live)]
    assert said[0] == said[1] and "the camera moves from frame 0 to 1, but not its pose" in said[1]
    assert live.value.hints == recorded.value.hints
    with contextlib.suppress(InputError):
        stream.close()


def test_a_fault_of_several_pauses_gives_one_warning():
    grey = np.full_like(RGB[0], 90)
    with warnings.catch_warnings(record=True) as caught, mstfilter.Stream(CAMERA.K, QUICK, pauses=None) as stream:
        warnings.simplefilter("always")
        for k, rgb in enumerate((RGB[0], grey, grey)):
            stream.push(rgb, DEPTH[0], float(k), pause=True)
        stream.wait()
    assert [str(one.message).partition("\n")[0] for one in caught if one.category is InputWarning] == [
        "stream: the colour image of frame 1 is uniform"
    ]


def test_a_warning_does_not_hide_a_later_fault():
    """Half the shift of `shifted_camera` gives a warning, the whole shift an error with the same hints."""
    arrays, half = shifted_camera(), shifted_camera(0.5)
    frames = [(one["rgb"][k], one["depth"][k]) for one, k in ((arrays, 0), (half, 1), (arrays, 1))]
    with pytest.raises(InputError, match="from frame 0 to 2, but not its pose"):
        Recording.from_arrays(*(np.stack(images) for images in zip(*frames, strict=True)), arrays["K"])
    stream = mstfilter.Stream(arrays["K"], QUICK, pauses=None)
    with pytest.warns(InputWarning, match="from frame 0 to 1, but not its pose"):
        for k in (0, 1):
            stream.push(*frames[k], float(k), pause=True)
        stream.wait()
    stream.push(*frames[2], 2.0, pause=True)
    with pytest.raises(InputError, match="from frame 0 to 2, but not its pose"):
        stream.wait()
    with contextlib.suppress(InputError):
        stream.close()


def test_a_live_folder_has_the_robot_masks(tmp_path):
    path = write_redwood(tmp_path / "data", (0, 1))
    (path / "robot").mkdir()
    write_image(path / "robot" / "00001.png", np.where(DEPTH[0] < 0.7, 255, 0).astype(np.uint8))
    (frame,) = [frame for _, frame in Redwood().arriving(path, idle_s=0.8)]
    np.testing.assert_array_equal(frame.robot_mask, DEPTH[0] < 0.7)


def test_a_live_folder_waits_for_late_images_and_skips_what_it_cannot_read(tmp_path, monkeypatch):
    monkeypatch.setattr("mstfilter.formats.redwood._PARTNER_S", 0.6)
    path = write_redwood(tmp_path / "data", (0, 1, 2, 3, 4))
    late = (path / "depth" / "00001.png").rename(tmp_path / "late.png")
    (path / "depth" / "00003.png").write_bytes(b"no image")
    write_image(path / "depth" / "00002.png", np.zeros(DEPTH[0].shape, np.uint16))
    threading.Timer(0.2, lambda: late.rename(path / "depth" / "00001.png")).start()
    for file in (path / "color").iterdir():
        file.touch()
    with pytest.warns(InputWarning, match="00003.png, 00003.png of .* are skipped: .* cannot be decoded"):
        arrived = list(Redwood(fps=10).arriving(path, idle_s=1.5))
    assert [when for when, _ in arrived] == pytest.approx([0, 0.1, 0.2, 0.4])
    assert [frame.valid.any() for _, frame in arrived] == [True, True, False, True]  # a stream drops the third


@pytest.mark.parametrize("hours", [-5, 5])
def test_a_live_folder_does_not_trust_the_times_of_files(tmp_path, monkeypatch, hours):
    """Files of a computer whose clock differs: without the depth image of frame 1, the others are read."""
    monkeypatch.setattr("mstfilter.formats.redwood._PARTNER_S", 0.6)
    path = write_redwood(tmp_path / "data", (0, 1, 2, 3))
    late = (path / "depth" / "00001.png").rename(tmp_path / "late.png")
    when = time.time() + 3600 * hours
    for file in (*path.glob("color/*"), *path.glob("depth/*"), late):
        os.utime(file, (when, when))
    times = [when for when, _ in Redwood(fps=10).arriving(path, idle_s=5)]
    assert times == pytest.approx([0, 0.1, 0.2])
    threading.Timer(0.1, lambda: late.rename(path / "depth" / "00001.png")).start()
    monkeypatch.setattr("mstfilter.formats.redwood._PARTNER_S", 60)
    assert len(list(Redwood(fps=10).arriving(path, idle_s=5))) == 4


def test_no_frame_is_accepted_that_is_not_processed():
    """A camera pushes while another thread closes the stream, and closes it too."""
    stream = mstfilter.Stream(CAMERA.K, QUICK, pauses=None, max_frames=4, on_pause=lambda pause: time.sleep(0.1))
    accepted, refused = [], []

    def film():
        for k in range(1000):
            try:
                accepted.append(stream.push(RGB[k % 2], DEPTH[k % 2], float(k), pause=True, wait=True))
            except InputError as error:
                refused.append(error.message)
                return stream.close()

    camera = threading.Thread(target=film)
    camera.start()
    while len(accepted) < 6:
        time.sleep(0.01)
    stream.close()
    camera.join()
    stream.wait()
    assert refused == ["the stream is closed"]
    assert all(accepted) and stream.last.index == len(accepted) - 1  # every frame was a pause


def test_all_frames_have_poses_or_none():
    pose = CAMERA.T_world_camera
    for first, second in ((pose, None), (None, pose)):
        with mstfilter.Stream(CAMERA.K, QUICK, pauses=None) as stream:
            stream.push(RGB[0], DEPTH[0], 0.0, pose=first)
            with pytest.raises(InputError, match=f"frame 1 has {'no' if second is None else 'a'} pose"):
                stream.push(RGB[1], DEPTH[1], 1.0, pose=second)
            assert stream.push(RGB[1], DEPTH[1], 2.0, pose=first)


def test_a_recording_searches_the_pauses_in_the_images_that_a_stream_gets(tmp_path):
    class Seen(Settled):
        def find(self, times, read_rgb):
            np.testing.assert_array_equal(read_rgb(3), small.rgb)
            return super().find(times, read_rgb)

    path = write_redwood(tmp_path / "data")
    with mstfilter.Stream(CAMERA.K, QUICK, pauses=None, max_pixels=5000) as stream:
        stream.push(RGB[3], DEPTH[3], 0.0, pause=True)
        stream.wait()
        small = stream.last.clip.after
    assert Redwood(fps=FPS, pauses=Seen(hold_s=0.3), max_pixels=5000).open(path).pauses == PAUSES


def test_a_full_queue_drops_frames_and_says_so():
    gate = threading.Event()
    with mstfilter.Stream(CAMERA.K, QUICK, pauses=None, max_frames=4, on_pause=lambda pause: gate.wait()) as stream:
        with pytest.warns(InputWarning, match="overflow"):
            n = sum(stream.push(RGB[k % 17], DEPTH[k % 17], k, pause=True) for k in range(30))
        gate.set()
    assert n < 30 and stream.counts["overflow"] == 30 - n
    assert stream.last.index == n - 1  # every accepted frame was a pause


def test_frames_may_wait_for_a_place_in_the_queue():
    with mstfilter.Stream(CAMERA.K, QUICK, pauses=None, max_frames=4) as stream:
        assert all(stream.push(RGB[0], DEPTH[0], k, pause=k in (0, 19), wait=True) for k in range(20))
        stream.wait()
        assert stream.last.index == 1 and stream.counts["overflow"] == 0


@pytest.mark.parametrize("name", ["wait", "close", "push"])
def test_a_callback_cannot_wait_for_itself(name):
    arguments = {"rgb": RGB[1], "depth": DEPTH[1], "time": 1, "wait": True} if name == "push" else {}
    stream = mstfilter.Stream(CAMERA.K, QUICK, pauses=None, on_pause=lambda pause: getattr(stream, name)(**arguments))
    stream.push(RGB[0], DEPTH[0], 0, pause=True)
    for _ in range(2):
        with pytest.raises(InputError, match="in on_pause"):
            stream.close()


def test_a_first_frame_that_is_refused_does_not_set_the_camera():
    with mstfilter.Stream(CAMERA.K, QUICK, pauses=None) as stream:
        with pytest.raises(InputError, match="expected"):
            stream.push(np.repeat(RGB[0], 2, axis=1), DEPTH[0], 0)
        assert stream.push(RGB[0], DEPTH[0], 1, pause=True)


def test_errors_of_frames_and_threads_reach_the_caller():
    def fail(pause):
        raise RuntimeError("in the callback")

    stream = mstfilter.Stream(CAMERA.K, QUICK, grid=GRID, pauses=None, on_pause=fail)
    for rgb, depth, when, message in (
        (RGB[0][:50], DEPTH[0], 0, "expected"),
        (RGB[0], (1000 * DEPTH[0]), 0, "between 0.05 and 30 m"),
        (RGB[0], DEPTH[0], np.nan, "time of frame"),
    ):
        with pytest.raises(InputError, match=message):
            mstfilter.Stream(CAMERA, QUICK, pauses=None).push(rgb, depth, when)
    for rule in ("settled", Still()):
        with pytest.raises(InputError, match="pauses of a stream"):
            mstfilter.Stream(CAMERA, QUICK, pauses=rule)
    closed = mstfilter.Stream(CAMERA, QUICK, pauses=None)
    closed.close()
    with pytest.raises(InputError, match="closed"):
        closed.push(RGB[0], DEPTH[0])
    stream.push(RGB[0], DEPTH[0], pause=True)
    with pytest.raises(RuntimeError, match="callback"):
        stream.wait()
    with pytest.raises(RuntimeError, match="callback"):
        stream.push(RGB[0], DEPTH[0])
    with pytest.raises(RuntimeError, match="callback"):
        stream.close()


def test_a_folder_is_filtered_while_it_is_filled(tmp_path):
    whole, growing = write_redwood(tmp_path / "whole"), tmp_path / "growing"
    for part in ("color", "depth"):
        (growing / part).mkdir(parents=True)
    shutil.copy(whole / "intrinsic.json", growing)

    def record():
        for k in range(len(SHIFTS)):
            shutil.copy(whole / "color" / f"{k:05d}.png", growing / "color")
            time.sleep(0.02)
            data = (whole / "depth" / f"{k:05d}.png").read_bytes()
            with (growing / "depth" / f"{k:05d}.png").open("wb") as file:
                file.write(data[:100])
                file.flush()
                time.sleep(0.01)
                file.write(data[100:])

    reader, config = Redwood(fps=FPS, pauses=RULE, max_pixels=12_000), load_config("mst", ["n=2", "n_proposed=2"])
    recorder = threading.Thread(target=record)
    recorder.start()
    live = filter_folder(growing, reader, config, tmp_path / "live", 3, idle_s=2)
    recorder.join()
    run = filter_recording(reader.open(whole), config, tmp_path / "run", 3, n_threads=2)
    assert live.check().n_pauses == run.n_pauses == 2
    for t in range(2):
        assert (live.pause(t) / "SHA256SUMS").read_bytes() == (run.pause(t) / "SHA256SUMS").read_bytes()
    assert live.description["recording"]["pauses"] == list(PAUSES)
    assert live.description["status"] == "done"
    assert "pause 1" in write_report(live).read_text()
    shutil.rmtree(live.pause(1))  # as if the program was killed between the entry of a pause and the pause
    assert RunFolder.open(live.path).check().n_pauses == 1
    assert open_format(whole, options=["pauses.hold_s=0.3"], pauses="settled").pauses == RULE
    with pytest.raises(InputError, match="exists"):
        filter_folder(growing, reader, config, tmp_path / "live")
    with pytest.raises(InputError, match="later frames"):
        filter_folder(growing, Redwood(pauses=Still()), config, tmp_path / "other")
    with pytest.raises(InputError, match="start_s and stop_s"):
        filter_folder(growing, Redwood(pauses=RULE, stop_s=2.0), config, tmp_path / "other")
    with pytest.raises(InputError, match="missing|no image"):
        filter_folder(tmp_path, reader, config, tmp_path / "other", idle_s=0.1)


def test_a_stream_shifts_the_world_of_given_poses():
    """The poses of every frame, or that of the camera, in the world of a robot's base."""
    high = RigidTransform.from_translation([0.2, 0.1, 0.4])
    for camera, pose in ((CAMERA.K, high * CAMERA.pose), (CAMERA.at(high * CAMERA.pose), None)):
        shifted = pytest.warns(InputWarning, match="the world is shifted")
        with shifted, mstfilter.Stream(camera, QUICK, pauses=None) as stream:
            for k in range(2):
                stream.push(RGB[k], DEPTH[k], float(k), pose=pose, pause=True)
                stream.wait()
        for frame in stream.last.clip.frames:
            np.testing.assert_allclose(frame.camera.position, CAMERA.position + [0.2, 0.1, 0], atol=5e-3)
        assert stream.last.clip.grid.origin[2] == 0
