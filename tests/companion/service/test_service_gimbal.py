"""The service with its camera on a gimbal: targets are used only with a known gimbal attitude."""

from __future__ import annotations

import asyncio
import json
import math
import os
import time
from dataclasses import replace

import numpy as np
import pytest

from companion.guidance.behaviour import BehaviourContext
from companion.guidance.interface import StreamStatus
from companion.perception.assembly import CameraTelemetry, _pose_at, _view_at
from companion.perception.messages import Attitude, GimbalAttitude
from companion.service import Service
from companion.settings.reading import load_settings
from companion.vehicle.gimbal import GimbalState, YawFrame
from companion.vehicle.state import VehicleState
from vision.attitude import quaternion_from_euler
from vision.detections import Detections
from vision.frame import Frame
from vision.pipeline import PerceptionResult

PITCH_RAD, HEADING_RAD = -0.9, 1.2


def service_of(**settings: str) -> Service:
    changes = {key.replace("__", "."): value for key, value in settings.items()}
    return Service(load_settings(os.devnull, {"vehicle.driver": "pymavlink", **changes}, {}))


def state_at(now_ns: int, gimbal: GimbalState | None) -> VehicleState:
    return VehicleState(
        heartbeat_ns=now_ns,
        attitude_ns=now_ns,
        position_ns=now_ns,
        attitude=quaternion_from_euler(0.2, -0.2, HEADING_RAD),
        position_ned_m=(0.0, 0.0, -8.0),
        home_position_ned_m=(0.0, 0.0, 0.0),
        gimbal=gimbal,
    )


def looking_down(now_ns: int, pitch_rad: float = PITCH_RAD) -> GimbalState:
    attitude = quaternion_from_euler(0.0, pitch_rad, 0.0)
    return GimbalState(1, now_ns, now_ns, now_ns, attitude, YawFrame.NOSE)


def seen(captured_ns: int) -> PerceptionResult:
    box = np.array([[310.0, 230.0, 329.0, 249.0]], np.float32)
    car = Detections(box, np.array([0.9], np.float32), np.array([0]), ("car",))
    return PerceptionResult(1, captured_ns, captured_ns, 640, 480, car, {"total": 1.0}, dropped=0)


def set_state(service: Service, state: VehicleState) -> None:
    service.driver.link_count = 1  # type: ignore[misc]
    service.driver._telemetry.state = state  # type: ignore[attr-defined]
    service._on_state(state)


def see(service: Service, captured_ns: int) -> None:
    """Pass a new result of the steering camera."""
    camera, result = service.cameras[0], seen(captured_ns)
    camera.update(result)
    service.inputs.on_result(camera, result)


def step(service: Service, now_ns: int) -> BehaviourContext:
    """Run one step of guidance; return the behaviours' context."""
    inputs = service.inputs.assemble(now_ns, service.driver.state, StreamStatus())
    service.guidance.step(now_ns, inputs)
    assert service.guidance.context is not None
    return service.guidance.context


async def test_targets_need_the_gimbals_attitude() -> None:
    service, now_ns = service_of(camera__on_gimbal="true"), time.monotonic_ns()
    set_state(service, state_at(now_ns, None))
    see(service, now_ns)
    assert not service.cameras[0].targets
    error = service.status()["targets"]["localization_error"]
    assert "no attitude " in error
    assert "gimbal received" in error
    gimbal = service.status()["gimbal"]
    assert gimbal is not None
    assert "not responding" in (gimbal["problem"] or "")
    context = step(service, now_ns)
    assert not context.perception_fresh
    assert "not responding" in context.gimbal.direction_fault

    set_state(service, state_at(now_ns + 1, looking_down(now_ns + 1)))
    see(service, now_ns + 1)
    (target,) = service.cameras[0].targets
    assert target.elevation_rad == pytest.approx(PITCH_RAD, abs=0.01)
    assert target.bearing_rad == pytest.approx(HEADING_RAD, abs=0.01)
    context = step(service, now_ns + 1)
    assert context.perception_fresh
    assert context.targets == (target,)
    json.dumps(service.status(), allow_nan=False)
    # A stale attitude: detections have no direction again, and the status reports why.
    later_ns = now_ns + 2_000_000_000
    set_state(service, replace(state_at(later_ns, looking_down(now_ns + 1))))
    see(service, later_ns)
    assert not service.cameras[0].targets
    error = service.status()["targets"]["localization_error"]
    assert " s newer than " in error
    assert "attitude " in error
    assert "gimbal" in error
    assert "2.0 s" in step(service, later_ns).gimbal.direction_fault


async def test_fixed_camera_needs_no_gimbal() -> None:
    service, now_ns = service_of(), time.monotonic_ns()
    set_state(service, state_at(now_ns, None))
    see(service, now_ns)
    assert len(service.cameras[0].targets) == 1
    assert service.status()["gimbal"] is None
    assert step(service, now_ns).gimbal.direction_fault == ""


def test_camera_pitch_includes_the_gimbal() -> None:
    service, now_ns = service_of(camera__on_gimbal="true", camera__mount_pitch_deg="-10"), time.monotonic_ns()
    set_state(service, state_at(now_ns, looking_down(now_ns)))
    assert service.inputs.camera_pitch_rad(service.driver.state) == pytest.approx(
        PITCH_RAD - math.radians(10.0)
    )
    fixed = service_of(camera__mount_pitch_deg="-10")
    assert fixed.inputs.camera_pitch_rad(fixed.driver.state) == pytest.approx(-math.radians(10.0))


def test_recorded_camera_has_a_calibration_that_arrives_later() -> None:
    service = service_of()
    camera, mounting = service.cameras[0], service.guidance.gimbal.mounting
    assert service.inputs.step_context(mounting).camera == camera.settings.camera.model_dump_json()
    calibrated = camera.settings.camera.model_copy(update={"mount_pitch_deg": -10.0})
    camera.settings = camera.settings.model_copy(update={"camera": calibrated})
    assert service.inputs.step_context(mounting).camera == calibrated.model_dump_json()


@pytest.mark.realtime
async def test_gimbal_command_without_a_gimbal_is_refused() -> None:
    service = service_of()
    service.ready, service.driver.link_count = True, 1  # type: ignore[misc]
    steering = asyncio.create_task(service._loop.run())
    reply = await service.command("gimbal pitch=-30")
    assert not reply["success"]
    assert "not responding" in reply["reason"]
    assert service.guidance.behaviour is None
    steering.cancel()
    await asyncio.gather(steering, return_exceptions=True)


async def test_gimbal_of_a_camera_is_searched_and_its_loss_reported() -> None:
    service, now_ns = service_of(camera__on_gimbal="true"), time.monotonic_ns()
    set_state(service, state_at(now_ns, None))
    asked = asyncio.Event()

    async def find() -> bool:
        asked.set()
        return False

    service.driver.find_gimbal = find  # type: ignore[method-assign]
    service._loop._step(now_ns)
    await asked.wait()
    later_ns = now_ns + 1_000_000_000
    set_state(service, state_at(later_ns, looking_down(later_ns)))
    service._loop._step(later_ns)
    assert (service.events[-1].level, "direction known" in service.events[-1].text) == ("info", True)
    lost_ns = later_ns + 10_000_000_000
    set_state(service, state_at(lost_ns, looking_down(later_ns)))
    service._loop._step(lost_ns)
    assert "direction unknown" in service.events[-1].text
    assert "10.0 s old" in service.events[-1].text


def test_camera_view_uses_the_gimbals_attitude() -> None:
    telemetry = CameraTelemetry()
    frame = Frame(np.zeros((480, 640, 3), np.uint8), 1_010_000_000, 1)
    settings = load_settings(os.devnull, {"camera.on_gimbal": "true"}, {})
    for stamp in (1_000_000_000, 1_020_000_000):
        telemetry.attitudes.add(stamp, Attitude(stamp, quaternion_from_euler(0.3, -0.3, 1.0)).wxyz)
    assert _view_at(settings, telemetry)(frame) is None
    assert _pose_at(settings, telemetry)(frame.captured_ns) is None
    for stamp, pitch in ((1_000_000_000, -0.6), (1_020_000_000, -0.8)):
        telemetry.gimbal.add(stamp, GimbalAttitude(stamp, quaternion_from_euler(0.0, pitch, 1.0)).wxyz)
    view = _view_at(settings, telemetry)(frame)
    assert view is not None
    ahead = view.ned_from_optical @ np.array([0.0, 0.0, 1.0])
    assert math.asin(ahead[2]) == pytest.approx(0.7)
    assert math.atan2(ahead[1], ahead[0]) == pytest.approx(1.0)


def test_camera_looking_up_has_no_range_from_ground() -> None:
    for pitch_deg, ground in (("45", False), ("0", True)):
        service, now_ns = service_of(camera__mount_pitch_deg=pitch_deg), time.monotonic_ns()
        set_state(service, state_at(now_ns, None))
        assert step(service, now_ns).ranging.ground, "before the first result every means is assumed"
        see(service, now_ns)
        ranging = step(service, now_ns).ranging
        assert (ranging.depth, ranging.ground) == (False, ground)
        assert "car" in ranging.classes


async def test_landing_on_a_marker_needs_a_camera_down() -> None:
    """Without markers at all it is refused in `test_land_on_marker`."""

    async def reason(pitch_deg: str) -> str:
        service, now_ns = service_of(
            markers__dictionary="4X4_50", markers__size_m="0.5",
            camera__horizontal_fov_deg="80", camera__mount_pitch_deg=pitch_deg,
        ), time.monotonic_ns()  # fmt: skip
        service.ready = True
        set_state(service, state_at(now_ns, None))
        service.inputs.on_result(service.cameras[0], replace(seen(now_ns), markers=()))
        reply = asyncio.create_task(service.command("land-on-marker 7"))
        await asyncio.sleep(0)
        service._loop._step(now_ns)
        refused = await reply
        assert not refused["success"]
        return str(refused["reason"])

    assert "pitch_deg is -20" in await reason("-20")
    assert "mount_pitch_deg" not in await reason("-90")
