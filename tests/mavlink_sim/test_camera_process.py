"""The camera in its own process: frames for poses, and its end with its parent."""

from __future__ import annotations

import math
import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from mavlink_sim.camera.freeze import CameraFreeze
from mavlink_sim.camera.process import CameraProcess
from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.attitude import quaternion_from_euler
from vision.camera_model import CameraModel, CameraMount
from vision.frame import Frame
from vision.shared_frame import SHARED_MEMORY_DIRECTORY, SharedFrameReader, segment_path

pytestmark = [
    pytest.mark.skipif(not SHARED_MEMORY_DIRECTORY.is_dir(), reason="needs Linux's /dev/shm"),
    pytest.mark.realtime,
]
DEADLINE_S = 60.0
CAMERA = CameraModel.from_horizontal_fov(160, 120, math.radians(70.0))
WORLD = World((WorldObject(0, "car", (12.0, 0.0, 0.0)),), Ground(("concrete",), 0, 256, 0.05))


def until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        if time.monotonic() > deadline:
            raise AssertionError(f"not within {DEADLINE_S} s: {what}")
        time.sleep(0.01)


@pytest.fixture
def name() -> Iterator[str]:
    chosen = f"test-camera-{os.getpid()}-{secrets.token_hex(4)}"
    yield chosen
    segment_path(chosen).unlink(missing_ok=True)


@pytest.fixture
def camera(name: str) -> Iterator[CameraProcess]:
    process = CameraProcess(WORLD, CAMERA, CameraMount(), 60.0, name)
    process.start()
    yield process
    process.stop()


def first_frame(camera: CameraProcess, position: tuple[float, float, float], yaw_rad: float) -> Frame:
    stamp_ns = time.monotonic_ns()
    camera.send_pose(position, quaternion_from_euler(0.0, 0.0, yaw_rad), stamp_ns)
    name = camera.shared_name
    assert name is not None
    until(lambda: segment_path(name).exists(), "the camera's shared memory")
    got: list[Frame] = []
    with SharedFrameReader(name) as reader:

        def attitude() -> bool:
            frame = reader.latest()
            if frame is not None and frame.captured_ns == stamp_ns:
                got.append(frame)
            return bool(got)

        until(attitude, "a frame of the pose sent")
    return got[0]


def test_frames_show_their_poses_the_newest_wins_and_stopping_cleans_up(camera: CameraProcess) -> None:
    frame = first_frame(camera, (1.0, 0.0, -2.0), 0.0)
    here = Renderer(WORLD, CAMERA, CameraMount()).render((1.0, 0.0, -2.0), np.eye(3))
    assert frame.depth_m is not None
    assert np.allclose(frame.depth_m, here.depth_m, equal_nan=True)
    assert np.abs(frame.image.astype(int) - here.image).mean() < 4.0
    turned = first_frame(camera, (1.0, 0.0, -2.0), math.pi)
    assert turned.sequence > frame.sequence
    assert turned.depth_m is not None
    assert not np.allclose(turned.depth_m, here.depth_m, equal_nan=True)

    for number in range(200):
        camera.send_pose((0.0, 0.0, -2.0), (1.0, 0.0, 0.0, 0.0), number + 1)
    assert camera.shared_name is not None
    with SharedFrameReader(camera.shared_name) as reader:

        def newest() -> bool:
            frame = reader.latest()
            return frame is not None and frame.captured_ns == 200

        until(newest, "the last pose drawn")
        last = reader.latest()
        assert last is not None
        assert last.sequence < 150

    assert camera.alive
    camera.stop()
    assert not camera.alive
    assert not segment_path(camera.shared_name).exists()


def _ignores_interrupts(pid: int) -> bool:
    """Whether the camera's own code runs already: what it does first is to ignore SIGINT."""
    with open(f"/proc/{pid}/status", encoding="ascii") as status:
        ignored = next(line for line in status if line.startswith("SigIgn"))
    return bool(int(ignored.split()[1], 16) >> (signal.SIGINT - 1) & 1)


@pytest.mark.parametrize("painting", [False, True], ids=["while it is imported", "while it paints"])
def test_starting_camera_stops_quickly_and_silently(
    name: str, painting: bool, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    vast = World((), Ground(("meadow", "grass", "rows"), 0, 2048, 0.05))  # seconds of painting
    camera = CameraProcess(vast, CAMERA, CameraMount(), 60.0, name)
    camera.start()
    pid = camera.pid
    assert pid is not None
    if painting:
        until(lambda: _ignores_interrupts(pid), "the camera's own code")
    os.kill(pid, signal.SIGINT)  # Ctrl-C reaches it as well
    camera.stop()
    assert not camera.alive
    assert not camera.ready  # it did not go on until then
    assert not segment_path(name).exists()
    assert (caplog.text, capfd.readouterr().err) == ("", "")


def test_poses_to_a_dead_or_hung_camera_do_not_block(camera: CameraProcess) -> None:
    first_frame(camera, (0.0, 0.0, -2.0), 0.0)
    assert camera.pid is not None
    os.kill(camera.pid, signal.SIGSTOP)
    try:
        for number in range(3000):
            camera.send_pose((0.0, 0.0, -2.0), (1.0, 0.0, 0.0, 0.0), number)
        assert camera.dropped_poses > 0
    finally:
        os.kill(camera.pid, signal.SIGKILL)
    until(lambda: not camera.alive, "the killed camera's end")
    before = camera.dropped_poses
    camera.send_pose((0.0, 0.0, -2.0), (1.0, 0.0, 0.0, 0.0), 1)
    assert camera.dropped_poses == before + 1


PARENT = """
import sys, time
from mavlink_sim.camera.process import CameraProcess
from mavlink_sim.world.world import Ground, World
from vision.camera_model import CameraModel, CameraMount
if __name__ == "__main__":
    world = World((), Ground(("concrete",), 0, 256, 0.05))
    lens = CameraModel.from_horizontal_fov(64, 48, 1.2)
    camera = CameraProcess(world, lens, CameraMount(), 30.0, sys.argv[1])
    camera.start()
    camera.send_pose((0.0, 0.0, -2.0), (1.0, 0.0, 0.0, 0.0), 1)
    print(camera.pid, flush=True)
    sys.stdin.read()
"""


def test_the_camera_ends_when_its_parent_is_killed(name: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PARENT, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        until(lambda: segment_path(name).exists(), "the camera's shared memory")
        parent.kill()
        until(lambda: not _runs(pid), "the camera's end")
    assert not segment_path(name).exists()


def _runs(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_invalid_rate_refused() -> None:
    with pytest.raises(ValueError, match=r"rate .*0\.0 Hz"):
        CameraProcess(WORLD, rate_hz=0.0)


def test_frozen_process_repeats_its_last_frame(camera: CameraProcess) -> None:
    before = first_frame(camera, (1.0, 0.0, -2.0), 0.0)
    stamp_ns = time.monotonic_ns()
    freeze = CameraFreeze.IMAGE | CameraFreeze.DEPTH
    camera.send_pose((5.0, 0.0, -2.0), (1.0, 0.0, 0.0, 0.0), stamp_ns, freeze=freeze)
    assert camera.shared_name is not None
    with SharedFrameReader(camera.shared_name) as reader:
        until(lambda: (frame := reader.latest()) is not None and frame.captured_ns == stamp_ns, "the frame")
        after = reader.latest()
    assert after is not None
    assert np.array_equal(before.image, after.image)
    assert before.depth_m is not None
    assert after.depth_m is not None
    assert np.array_equal(before.depth_m, after.depth_m, equal_nan=True)
