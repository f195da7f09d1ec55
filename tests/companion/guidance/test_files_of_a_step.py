"""How much code a frame passes on its way to a setpoint: what a vehicle does not have is not in its step."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import companion
import vision
from benchmarks.rendered import camera_settings, rendered_scene
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose
from vision.camera_model import CameraModel, CameraMount

ROOT = Path(companion.__file__).parent.parent
PACKAGES = tuple(str(Path(package.__file__ or "").parent) for package in (companion, vision))
# The simulated camera and driver are not the product's.
BENCH = str(Path(companion.__file__).parent / "bench")
CAMERA = CameraModel.from_horizontal_fov(480, 360, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1, pitch_rad=math.radians(-10.0))


@contextmanager
def called(into: set[tuple[str, str]]) -> Iterator[None]:
    """Collect the (file, function) of every call in the product meanwhile."""

    def note(frame: FrameType, event: str, argument: Any) -> None:
        code = frame.f_code
        name = code.co_filename
        ours = name.startswith(PACKAGES) and not name.startswith(BENCH)
        if event == "call" and ours and code.co_name != "<module>":
            into.add((str(Path(name).relative_to(ROOT)), code.co_qualname))

    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(None)


def passed(command: str) -> set[tuple[str, str]]:
    """What the frames of five seconds of a flight pass, from the image to the setpoint that is sent."""
    car = SceneObject("car", (4.2, 1.8, 1.5), lambda _: ScenePose(18.0, 1.0, 1.2))
    settings = camera_settings(CAMERA, MOUNT, {"detector.image_size": "320", "detector.threads": "1"})
    scene, _ = rendered_scene([car], CAMERA, MOUNT, 11)
    flight = LockstepFlight.airborne(
        seed=11,
        height_m=3.0,
        camera=lambda vehicle: RenderedCamera(settings, scene, vehicle, rate_hz=5.0, depth=False),
    )
    (camera,) = flight.cameras
    assert isinstance(camera, RenderedCamera)
    flight.turn_to(0.0)
    flight.run(2.0)
    flight.command(command)
    flight.run(3.0)
    assert flight.guidance.busy
    found: set[tuple[str, str]] = set()
    deliver, step, send_now = flight._deliver, flight.step, flight.streamer.send_now
    frames, sent = 0, flight.streamer.sent_count

    def delivering(now_ns: int) -> bool:
        nonlocal frames
        with called(found):
            seen = deliver(now_ns)
        frames += seen
        return seen

    def stepping() -> None:
        with called(found):
            step()

    def sending(now_ns: int) -> None:
        with called(found):
            send_now(now_ns)

    flight._deliver = delivering  # type: ignore[method-assign]
    flight.step = stepping  # type: ignore[method-assign,assignment]
    flight.streamer.send_now = sending  # type: ignore[method-assign]
    flight.run(5.0)
    assert flight.guidance.busy
    assert frames > 20
    assert flight.streamer.sent_count - sent > 100
    return found


# What this vehicle does not have: a gimbal, markers, other vehicles, senders of velocities, depth, a map.
ABSENT = (
    "companion/guidance/avoidance.py",
    "companion/guidance/command_queue.py",  # no command waits
    "companion/guidance/formation/neighbours.py",
    "companion/guidance/formation/pose.py",
    "companion/guidance/gimbal/controller.py",
    "companion/guidance/limits/obstacles.py",
    "companion/perception/freeze_reports.py",
    "companion/perception/marker_tracker.py",
    "companion/service/velocity_senders.py",
)
# 22 of them in vision/.
MOST_FILES = 52


def test_frame_passes_only_what_the_vehicle_has() -> None:
    files = {file for file, _ in passed("approach car distance=5")}
    assert all((ROOT / file).exists() for file in ABSENT)
    assert not files & set(ABSENT)
    assert len(files) <= MOST_FILES, sorted(files)
