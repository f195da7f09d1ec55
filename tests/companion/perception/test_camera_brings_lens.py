"""`mavlink-sim --camera front` and a camera of `shm://front`, without lens settings."""

from __future__ import annotations

import asyncio
import math
import os
import secrets
from collections.abc import Iterator

import numpy as np
import pytest

from companion.perception.cameras import WorkerCamera
from companion.settings.reading import load_settings
from mavlink_sim.camera.renderer import DEFAULT_CAMERA, DEFAULT_MOUNT
from mavlink_sim.testing import running_simulator
from vision.camera_model import CameraModel
from vision.geolocation import PixelRays
from vision.shared_frame import segment_path

pytestmark = pytest.mark.realtime

HEIGHT_M = 3.0
# A ground that is made quickly.
BARE = '[ground]\nkinds = ["concrete"]\ntile_texels = 256\ntexel_m = 0.05\n'


@pytest.fixture(scope="module")
def front(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    scene = tmp_path_factory.mktemp("scene") / "bare.toml"
    scene.write_text(BARE)
    name = f"test-lens-{os.getpid()}-{secrets.token_hex(4)}"
    with running_simulator(scene=scene, camera=name, camera_rate=5.0):
        yield name
    segment_path(name).unlink(missing_ok=True)


def started_camera(front: str, **settings: str) -> tuple[WorkerCamera, list[tuple[str, str]], int]:
    """Start and stop a camera; return it, its events, and how often its camera settings changed."""
    events: list[tuple[str, str]] = []
    changes = 0

    def changed() -> None:
        nonlocal changes
        changes += 1

    overrides = {"source.uri": f"shm://{front}", "source.open_timeout_s": "90", "detector.enabled": "false"}
    overrides |= {f"camera.{key}": value for key, value in settings.items()}
    camera = WorkerCamera(
        load_settings(os.devnull, overrides, environment={}),
        None,
        on_result=lambda *_: None,
        on_preview=lambda *_: None,
        on_event=lambda level, text: events.append((level, text)),
        on_calibration=changed,
    )

    async def start() -> None:
        await camera.start()
        await camera.supervisor.stop()

    asyncio.run(start())
    return camera, events, changes


def ground_range_m(camera: WorkerCamera, true_m: float) -> float:
    """The camera's range of a ground point at `true_m` ahead of a level vehicle; NaN above the horizon."""
    eye = DEFAULT_MOUNT.position_frd_m
    offset = np.array([[true_m, 0.0, HEIGHT_M]]) - eye
    pixels = DEFAULT_CAMERA.project(offset @ DEFAULT_MOUNT.ned_from_optical(np.eye(3)))
    section = camera.settings.camera
    model = section.model(DEFAULT_CAMERA.width, DEFAULT_CAMERA.height)
    return float(PixelRays.of(model, section.mount(), np.eye(3), pixels).on_ground(HEIGHT_M)[0, 0])


def test_ground_point_has_its_true_range_without_settings(front: str) -> None:
    camera, events, changes = started_camera(front)
    assert changes == 1
    assert [level for level, _ in events if level != "info"] == []
    for true_m in (5.0, 10.0, 20.0):
        assert ground_range_m(camera, true_m) == pytest.approx(true_m, abs=0.01)


def test_conflicting_setting_is_one_warning(front: str) -> None:
    camera, events, _ = started_camera(front, horizontal_fov_deg="80", mount_pitch_deg="0")
    ((level, text),) = [event for event in events if event[0] != "info"]
    assert level == "warning"
    for value in ("80.0°", "70.0°", "mount_pitch_deg 0 (camera: -20)"):
        assert value in text
    own = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
    assert camera.settings.camera.model(640, 480) == own
    assert camera.settings.camera.mount().pitch_rad == 0.0
