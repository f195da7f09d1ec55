"""An operator selects a car in a station's video, with the simulated vehicle and its rendered camera."""

from __future__ import annotations

import json
import math
import runpy
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink
from zenoh import Session

from companion.bus.client import listen, send_command
from companion.bus.topics import COMMAND_STATE, DETECTIONS, TRANSFORMS, VEHICLE
from companion.host.clock import unix_offset_ns
from tests.companion.ground_station.operator_station import OperatorStation, operator_station
from tests.companion.simulation.test_play import playing

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240)]

SCENE = """
[ground]
kinds = ["grass", "concrete"]
tile_texels = 256
texel_m = 0.05
[camera]
width = 400
height = 300
rate_hz = 10
[[objects]]
class = "car"
appearance = 5
path = { waypoints_m = [[14.0, -4.0], [14.0, 4.0]], speed_mps = 1.0, repeat = "back_and_forth" }
"""
FOLLOWED_M = 5.0
WATCHED_S = 5.0
"""Longer than following takes to begin; a vehicle that holds stays within `HELD_M`."""
HELD_M = 1.0
TOLERANCE_PX = 1.0
MAX_NEWER = 2
"""Frames published between that of a box and its arrival: the limit in time is in test_tracking."""
SAME_TIME_US = 5000
"""Between the time of TARGET_RELATIVE, by the computer's clock, and a frame's; frames are 100 ms apart."""
TARGET_TOLERANCE_M = 0.1
ACTIVE = mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE


class Bus:
    """What the service publishes.

    Attributes:
        frames: by number. positions: of the vehicle at a frame's capture, local NED, by its number.
        commands: (command, state) in their order.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self.frames: dict[int, dict[str, Any]] = {}
        self.positions: dict[int, tuple[float, float, float]] = {}
        self.commands: list[tuple[str, str]] = []
        self.vehicle: dict[str, Any] = {}
        self._kept = [
            listen(session, DETECTIONS.name, self._on_frame),
            listen(session, TRANSFORMS.name, self._on_transforms),
            listen(session, COMMAND_STATE.name, self._on_command),
            listen(session, VEHICLE.name, self._on_vehicle),
        ]

    def _on_frame(self, _key: str, text: str) -> None:
        body = json.loads(text)
        self.frames[body["sequence"]] = body

    def _on_transforms(self, _key: str, text: str) -> None:
        body = json.loads(text)
        ned_from_body = body["transforms"][0]
        self.positions[body["sequence"]] = tuple(ned_from_body["translation_m"])

    def _on_command(self, _key: str, text: str) -> None:
        body = json.loads(text)
        self.commands.append((body["command"], body["state"]))

    def _on_vehicle(self, _key: str, text: str) -> None:
        self.vehicle = json.loads(text)

    def fly(self, text: str) -> None:
        """As an operator at the console, again while something is missing that comes by itself."""
        until_s = time.monotonic() + 30.0
        while not (reply := send_command(self._session, "vehicle1", text))["success"]:
            assert time.monotonic() < until_s, reply
            time.sleep(0.2)

    def newest_car(self) -> tuple[dict[str, Any], dict[str, Any]] | None:
        """The newest frame, and the confirmed car in it."""
        frame = self.frames[max(self.frames)] if self.frames else None
        cars = [] if frame is None else [each for each in frame["detections"] if each["class_name"] == "car"]
        confirmed = [each for each in cars if each["track_state"] == "confirmed"]
        return (frame, confirmed[0]) if frame is not None and confirmed else None


def draw_rectangle(station: OperatorStation, bus: Bus) -> int:
    """Around the car, a little larger; returns its track."""
    station.until(bus.newest_car, 30.0, "a confirmed car")
    found = bus.newest_car()
    assert found is not None
    frame, car = found
    left, top, right, bottom = car["xyxy"]
    width, height = frame["width"], frame["height"]
    begin = (max(left - 3, 0) / width, max(top - 2, 0) / height)
    end = (min(right + 3, width) / width, min(bottom + 2, height) / height)
    results = station.command(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, *begin, *end)
    assert results[-1] == mavlink.MAV_RESULT_ACCEPTED, (results, station.texts())
    return int(car["track_id"])


def check_status(
    statuses: Sequence[tuple[int, Any]], frames: Sequence[dict[str, Any]], track_id: int
) -> tuple[list[float], list[int]]:
    """Assert that every active status has a frame's box.

    Returns their ages at the station, milliseconds, and how many newer frames were published by then.
    """
    ages_ms, newer = [], []
    for received_ns, status in statuses:
        if status.tracking_status != ACTIVE:
            continue
        sent = (status.rec_top_x, status.rec_top_y, status.rec_bottom_x, status.rec_bottom_y)
        matching = [
            frame["captured_ns"]
            for frame in frames
            for each in frame["detections"]
            if each["track_id"] == track_id
            and _off_px(sent, each["xyxy"], (frame["width"], frame["height"])) <= TOLERANCE_PX
            and frame["published_ns"] < received_ns
        ]
        assert matching, sent
        captured_ns = max(matching)
        ages_ms.append((received_ns - captured_ns) / 1e6)
        published = [frame for frame in frames if frame["published_ns"] < received_ns]
        newer.append(sum(frame["captured_ns"] > captured_ns for frame in published))
    return ages_ms, newer


def target_errors_m(station: OperatorStation, bus: Bus, track_id: int) -> list[tuple[float, float]]:
    """Compare each TARGET_RELATIVE with its object in the frame of its time, and the vehicle's position then.

    Returns:
        Horizontal and vertical differences, metres.
    """
    unix_us = unix_offset_ns() // 1000
    errors_m = []
    frames = sorted(bus.frames.values(), key=lambda frame: int(frame["captured_ns"]))
    for time_us, (north_m, east_m, down_m) in tuple(station.targets):
        frame = min(frames, key=lambda each: abs(each["captured_ns"] // 1000 + unix_us - time_us))
        assert abs(frame["captured_ns"] // 1000 + unix_us - time_us) < SAME_TIME_US
        (seen,) = [each for each in frame["detections"] if each["track_id"] == track_id]
        if frame["sequence"] not in bus.positions:
            continue  # published before this program listened
        north, east, down = (
            there - here
            for there, here in zip(seen["position_ned_m"], bus.positions[frame["sequence"]], strict=True)
        )
        errors_m.append((math.hypot(north_m - north, east_m - east), abs(down_m - down)))
    return errors_m


def error_figures(errors_m: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Median and largest of `target_errors_m`, millimetres."""
    across, down = ([1000 * each for each in of] for of in zip(*errors_m, strict=True))
    return {
        "across_mm": median(across),
        "across_max_mm": max(across),
        "down_mm": median(down),
        "down_max_mm": max(down),
    }


def _off_px(sent: Sequence[float], xyxy: Sequence[float], size: tuple[int, int]) -> float:
    return max(abs(one * scale - other) for one, other, scale in zip(sent, xyxy, size * 2, strict=True))


def objects_of(station: OperatorStation, since: int) -> list[dict[str, Any]]:
    """What the example reads."""
    example = runpy.run_path(str(Path(__file__).parents[3] / "examples" / "decode_objects.py"))
    tunnels = [message for _, message in station.of("TUNNEL", since)]
    payloads = [bytes(message.payload[: message.payload_length]) for message in tunnels]
    return [each for payload in payloads for each in example["decode"](payload)]


def north_east(bus: Bus) -> tuple[float, float]:
    north, east, _ = bus.vehicle["position_ned_m"]
    return north, east


@pytest.mark.parametrize("follows", [True, False], ids=["follows", "selects"])
def test_rectangle_of_a_station_is_followed_if_allowed(tmp_path: Path, *, follows: bool) -> None:
    scene = tmp_path / "car.toml"
    scene.write_text(SCENE)
    with operator_station() as (station, url):
        flags = ["--scene", str(scene), "--ground-station-url", url, "--guidance-obstacles", "off"]
        flags += ["--ground-station-track-follows", str(follows).lower()]
        flags += ["--ground-station-target-relative", str(follows).lower()]
        with playing(tmp_path, *flags) as running, running.client() as session:
            bus = Bus(session)
            bus.fly("takeoff 4")
            bus.fly("goto 0 0 altitude=4 heading=0")
            begun, begun_s, here = len(station.messages), time.monotonic(), north_east(bus)
            track_id = draw_rectangle(station, bus)
            flown = f"follow track={track_id}"
            if follows:
                station.until(lambda: (flown, "in_progress") in bus.commands, 10.0, "following")
                station.until(lambda: math.dist(here, north_east(bus)) > FOLLOWED_M, 30.0, "following far")
            time.sleep(WATCHED_S)
            assert follows or math.dist(here, north_east(bus)) < HELD_M
            watched_s = time.monotonic() - begun_s
            statuses = station.of("CAMERA_TRACKING_IMAGE_STATUS", begun)
            newest = max(bus.frames)
            station.until(lambda: max(bus.frames) > newest + 5, 10.0, "sending frames")
            ages_ms, newer = check_status(statuses, list(bus.frames.values()), track_id)
            print(f"{len(statuses)} statuses, {len(ages_ms)} active in {watched_s:.1f} s")
            print(f"age: median {median(ages_ms):.0f} ms, at most {max(ages_ms):.0f} ms, {max(newer)} frames")
            assert len(ages_ms) > 2 * watched_s
            assert median(newer) <= MAX_NEWER
            assert any(command.startswith("follow") for command, _ in bus.commands) == follows
            errors_m = target_errors_m(station, bus, track_id)
            assert bool(errors_m) == follows
            if errors_m:
                print(f"{len(errors_m)} TARGET_RELATIVE: {error_figures(errors_m)}")
            assert all(max(each) < TARGET_TOLERANCE_M for each in errors_m)
            selected = [each for each in objects_of(station, begun) if each["selected"]]
            assert {(each["class"], each["track"]) for each in selected} == {("car", track_id)}
            before = len(bus.commands)
            assert station.command(mavlink.MAV_CMD_CAMERA_STOP_TRACKING)[-1] == mavlink.MAV_RESULT_ACCEPTED
            assert (("hold", "in_progress") in bus.commands[before:]) == follows
            stopped = len(station.messages)
            station.until(lambda: station.of("CAMERA_TRACKING_IMAGE_STATUS", stopped), 5.0, "idle")
            assert {
                each.tracking_status for _, each in station.of("CAMERA_TRACKING_IMAGE_STATUS", stopped)
            } == {0}
