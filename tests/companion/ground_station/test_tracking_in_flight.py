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
from companion.bus.topics import COMMAND_STATE, DETECTIONS, VEHICLE
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
ACTIVE = mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE


class Bus:
    """What the service publishes. `frames`: by number. `commands`: (command, state) in their order."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.frames: dict[int, dict[str, Any]] = {}
        self.commands: list[tuple[str, str]] = []
        self.vehicle: dict[str, Any] = {}
        self._kept = [
            listen(session, DETECTIONS.name, self._on_frame),
            listen(session, COMMAND_STATE.name, self._on_command),
            listen(session, VEHICLE.name, self._on_vehicle),
        ]

    def _on_frame(self, _key: str, text: str) -> None:
        body = json.loads(text)
        self.frames[body["sequence"]] = body

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
