"""Levelled images of video and preview: from the attitudes that the worker receives."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.bench.lockstep_flight import plain_settings
from companion.perception.assembly import ATTITUDES_S, CameraTelemetry, build_levelling
from vision.attitude import quaternion_from_euler
from vision.frame import Frame

CAPTURED_NS = 50_000_000_000
ROLL_RAD = math.radians(15.0)


def tilted_line(width: int = 320, height: int = 240) -> NDArray[np.uint8]:
    """Grey, with a white line through the centre as a vehicle rolled by `ROLL_RAD` sees the horizon."""
    image = np.full((height, width, 3), 60, np.uint8)
    x = width / 2
    drop = round(x * math.tan(ROLL_RAD))
    ends = (0, height // 2 + drop), (width - 1, height // 2 - drop)
    cv2.line(image, *ends, (255, 255, 255), 3)
    return image


def telemetry_of(roll_rad: float, *stamps_ns: int) -> CameraTelemetry:
    telemetry = CameraTelemetry()
    for stamp_ns in stamps_ns:
        telemetry.attitudes.add(stamp_ns, quaternion_from_euler(roll_rad, 0.0, 1.0))
    return telemetry


def slope_deg(image: NDArray[np.uint8]) -> float:
    rows, columns = np.nonzero(image[:, :, 0] > 200)
    return math.degrees(math.atan(np.polyfit(columns, rows, 1)[0]))


@pytest.mark.parametrize("changes", [{}, {"camera.rolling_shutter_ms": "30"}])
def test_image_is_levelled_by_the_attitude_at_capture(changes: dict[str, str]) -> None:
    telemetry = telemetry_of(ROLL_RAD, CAPTURED_NS - 50_000_000, CAPTURED_NS + 50_000_000)
    level = build_levelling(plain_settings(changes), telemetry)
    image = tilted_line()
    assert slope_deg(image) == pytest.approx(-15.0, abs=0.5)
    levelled = level(Frame(image, CAPTURED_NS, 0), image)
    assert levelled is not None
    assert levelled.shape == image.shape
    assert slope_deg(levelled) == pytest.approx(0.0, abs=0.5)


def test_image_without_an_attitude_at_capture_is_not_levelled() -> None:
    settings, image = plain_settings(), tilted_line()
    frame = Frame(image, CAPTURED_NS, 0)
    assert build_levelling(settings, CameraTelemetry())(frame, image) is None
    late = telemetry_of(ROLL_RAD, CAPTURED_NS - 900_000_000, CAPTURED_NS - 500_000_000)
    assert build_levelling(settings, late)(frame, image) is None


def test_frame_that_waited_for_the_encoder_is_levelled() -> None:
    step_ns = 100_000_000
    stamps = range(CAPTURED_NS - step_ns, CAPTURED_NS + round((ATTITUDES_S - 1.0) * 1e9), step_ns)
    level = build_levelling(plain_settings(), telemetry_of(ROLL_RAD, *stamps))
    assert level(Frame(tilted_line(), CAPTURED_NS, 0), tilted_line()) is not None
