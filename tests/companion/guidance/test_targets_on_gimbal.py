"""Targets of a gimbal camera use the gimbal's attitude at the capture time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance.objects.from_detections import (
    HistoryError,
    StateHistory,
    mount_at,
    targets_from_detections,
)
from companion.guidance.objects.from_markers import looks_down
from companion.guidance.objects.target import RangeSource
from companion.vehicle.gimbal import GimbalState, YawFrame
from companion.vehicle.state import VehicleState
from vision.attitude import quaternion_from_euler
from vision.camera_model import CameraModel, CameraMount
from vision.detections import DetectionRecord

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1, on_gimbal=True)
T0, STEP_NS = 5_000_000_000, 20_000_000
MIDDLE: DetectionRecord = {
    "class_id": 0,
    "class_name": "car",
    "confidence": 0.8,
    "xyxy": [CAMERA.cx - 7.5, CAMERA.cy - 7.5, CAMERA.cx + 8.5, CAMERA.cy + 8.5],
    "center": [CAMERA.cx, CAMERA.cy],
    "depth_m": None,
    "nearest_camera_m": None,
}


def history_of(
    frame: YawFrame,
    *,
    yaw_rate: float = 0.6,
    pitch_rate: float = 0.4,
    gimbal_every: int = 1,
    steps: int = 60,
    lean: float = 0.3,
) -> StateHistory:
    """History of a vehicle that tilts and turns, and a gimbal that pitches."""
    history = StateHistory()
    for step in range(steps):
        stamp = T0 + step * STEP_NS
        heading, pitch = yaw_rate * step * 0.02, -0.2 - pitch_rate * step * 0.02
        yaw = heading if frame is YawFrame.NORTH else 0.0
        at = step - step % gimbal_every
        behind = pitch_rate * (step - at) * 0.02, yaw_rate * (step - at) * 0.02
        history.add(
            VehicleState(
                attitude_ns=stamp,
                position_ns=stamp,
                attitude=quaternion_from_euler(lean, -lean, heading),
                position_ned_m=(0.0, 0.0, -8.0),
                home_position_ned_m=(0.0, 0.0, 0.0),
                gimbal=GimbalState(
                    attitude_ns=T0 + at * STEP_NS,
                    attitude=quaternion_from_euler(
                        0.0, pitch + behind[0], yaw - (behind[1] if frame is YawFrame.NORTH else 0.0)
                    ),
                    yaw_frame=frame,
                ),
            )
        )
    return history


@pytest.mark.parametrize("frame", list(YawFrame))
@pytest.mark.parametrize("gimbal_every", [1, 10])
@given(step=st.floats(0.0, 49.0))
def test_direction_uses_the_gimbal_attitude_at_capture(
    frame: YawFrame, gimbal_every: int, step: float
) -> None:
    """Also at 5 Hz of gimbal attitude: between two samples it moves linearly."""
    history = history_of(frame, gimbal_every=gimbal_every)
    captured_ns = T0 + round(step * STEP_NS)
    (target,) = targets_from_detections([MIDDLE], captured_ns, CAMERA, MOUNT, history)
    assert target.elevation_rad == pytest.approx(-0.2 - 0.4 * step * 0.02, abs=2e-3)
    assert target.bearing_rad == pytest.approx(0.6 * step * 0.02, abs=4e-3)


@pytest.mark.parametrize("frame", list(YawFrame))
@given(step=st.floats(0.0, 49.0), right_m=st.floats(-2.0, 2.0), below_m=st.floats(-1.0, 1.0))
def test_nearest_point_uses_the_gimbal_attitude_at_capture(
    frame: YawFrame, step: float, right_m: float, below_m: float
) -> None:
    point = np.array([right_m, below_m, 8.0])
    captured_ns = T0 + round(step * STEP_NS)
    box = MIDDLE.copy()
    box.update({"nearest_camera_m": point.tolist(), "depth_m": 8.0})
    history = history_of(frame)
    (target,) = targets_from_detections([box], captured_ns, CAMERA, MOUNT, history)
    # By hand: the lens 0.1 m ahead of a leaning body, the camera pitched and turned by the gimbal alone.
    pitch, yaw = -0.2 - 0.4 * step * 0.02, 0.6 * step * 0.02
    forward = 8.0 * math.cos(pitch) + below_m * math.sin(pitch)
    down = below_m * math.cos(pitch) - 8.0 * math.sin(pitch)
    lens = history.at(captured_ns).ned_from_body @ MOUNT.position_frd_m
    assert target.position_ned_m is not None
    assert target.position_ned_m[2] == pytest.approx(-8.0 + lens[2] + down, abs=0.02)
    from_lens = np.array(target.position_ned_m[:2]) - lens[:2]
    assert math.hypot(*from_lens) == pytest.approx(math.hypot(forward, right_m), abs=0.02)
    assert math.atan2(from_lens[1], from_lens[0]) == pytest.approx(yaw, abs=5e-3)
    assert (target.depth_m, target.range_source) == (8.0, RangeSource.DEPTH)


def test_missing_gimbal_attitude_raises_with_the_reason() -> None:
    history = StateHistory()
    level = quaternion_from_euler(0.0, 0.0, 0.0)
    state = VehicleState(
        attitude_ns=T0,
        position_ns=T0,
        attitude=level,
        position_ned_m=(0.0, 0.0, -8.0),
        home_position_ned_m=(0.0, 0.0, 0.0),
    )
    history.add(state)
    with pytest.raises(HistoryError, match=r"no attitude .*gimbal"):
        targets_from_detections([MIDDLE], T0, CAMERA, MOUNT, history)
    history = history_of(YawFrame.NORTH, gimbal_every=60)
    late_ns = T0 + 30 * STEP_NS
    with pytest.raises(HistoryError, match=r"0\.60 s newer .* attitude .*gimbal"):
        targets_from_detections([MIDDLE], late_ns, CAMERA, MOUNT, history)
    # A body-mounted camera does not need it.
    assert targets_from_detections([MIDDLE], late_ns, CAMERA, CameraMount(), history)


def test_changed_yaw_frame_is_not_interpolated() -> None:
    history = history_of(YawFrame.NOSE, steps=10)
    stamp = T0 + 10 * STEP_NS
    heading = 0.6 * 10 * 0.02
    history.add(
        VehicleState(
            attitude_ns=stamp,
            position_ns=stamp,
            attitude=quaternion_from_euler(0.0, 0.0, heading),
            position_ned_m=(0.0, 0.0, -8.0),
            home_position_ned_m=(0.0, 0.0, 0.0),
            gimbal=GimbalState(
                attitude_ns=stamp,
                attitude=quaternion_from_euler(0.0, -0.28, heading),
                yaw_frame=YawFrame.NORTH,
            ),
        )
    )
    for back_ns in (0, 4_000_000, 16_000_000, STEP_NS):
        (target,) = targets_from_detections([MIDDLE], stamp - back_ns, CAMERA, MOUNT, history)
        assert target.bearing_rad == pytest.approx(heading, abs=0.02)


@pytest.mark.parametrize(("pitch_deg", "down"), [(-90.0, True), (-75.0, True), (-40.0, False), (0.0, False)])
def test_gimbal_camera_looks_down_with_the_gimbal(pitch_deg: float, down: bool) -> None:
    history = StateHistory()
    attitude = quaternion_from_euler(0.0, math.radians(pitch_deg), 1.0)
    history.add(VehicleState(gimbal=GimbalState(attitude_ns=T0, attitude=attitude)))
    assert looks_down(CAMERA, mount_at(MOUNT, history, T0)) is down
