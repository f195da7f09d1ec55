"""A camera as QGroundControl asks for it: its order, its timers and its repetitions, in simulated time.

From its sources, which were read and not run. A message that was lost is asked for again: camera information
by MAV_CMD_REQUEST_MESSAGE and 521 in turn, after 3 s without an acknowledgement; the rest likewise.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station import camera as camera_module
from companion.ground_station.component import Message
from tests.companion.ground_station.station_harness import CAMERA_ID, CameraHarness, S, command_long, received

DELAY_S, LOSS = 0.03, 0.3
ACK_TIMEOUT_S, GONE_S = 3.0, 5.0
# Message → old command, time after the camera information, and whether it needs a video stream.
LATER = {
    "CAMERA_SETTINGS": (mavlink.MAV_CMD_REQUEST_CAMERA_SETTINGS, 0.5),
    "VIDEO_STREAM_INFORMATION": (mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, 1.0),
    "CAMERA_CAPTURE_STATUS": (mavlink.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS, 1.5),
    "STORAGE_INFORMATION": (mavlink.MAV_CMD_REQUEST_STORAGE_INFORMATION, 2.0),
    "VIDEO_STREAM_STATUS": (mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS, 2.0),
}
ALL = {"CAMERA_INFORMATION", *LATER}
# At a telemetry radio's usual quality everything is there within this time.
COMPLETE_S = 10.0


class Clock(Protocol):
    """Time and calls, seconds."""

    @property
    def now_s(self) -> float: ...

    def after(self, seconds: float, call: Callable[[], None]) -> None: ...


class Timeline:
    """Calls in simulated time, seconds."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._calls: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0

    def after(self, seconds: float, call: Callable[[], None]) -> None:
        self._count += 1
        heapq.heappush(self._calls, (self.now_s + seconds, self._count, call))

    def run_until(self, end: Callable[[], bool], limit_s: float) -> None:
        while self._calls and not end():
            at_s, _, call = heapq.heappop(self._calls)
            if at_s > limit_s:
                self.now_s = limit_s
                return
            self.now_s = at_s
            call()


class Station:
    """What QGroundControl does about one camera. `known`: what it has of it."""

    def __init__(self, timeline: Clock, send: Callable[[Message], None]) -> None:
        self._timeline, self._send = timeline, send
        self.known: set[str] = set()
        self.acks_without_message = 0
        self._present = False
        self._heartbeat_s = 0.0
        self._pending: dict[str, int] = {}  # message → its newest attempt
        self._beat()

    def receive(self, message: Message) -> None:
        name = message.get_type()
        if name == "HEARTBEAT":
            self._heartbeat_s = self._timeline.now_s
            if not self._present:
                self._present = True
                self._ask("CAMERA_INFORMATION", mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION)
        elif self._present and name in ALL:
            if name == "CAMERA_INFORMATION" and name not in self.known:
                for other, (command, after_s) in LATER.items():
                    self._timeline.after(after_s, lambda o=other, c=command: self._ask(o, c))  # type: ignore[misc]
            if name == "CAMERA_INFORMATION" or "CAMERA_INFORMATION" in self.known:
                self.known.add(name)

    def _beat(self) -> None:
        self._send(received(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)))
        if self._present and self._timeline.now_s - self._heartbeat_s > GONE_S:
            self._present = False
            self.known.clear()
            self._pending.clear()
        self._timeline.after(1.0, self._beat)

    def _ask(self, name: str, command: int, attempt: int = 0) -> None:
        if name in self.known or not self._present or self._pending.get(name, -1) >= attempt or attempt == 10:
            return
        self._pending[name] = attempt
        if attempt % 2 == 0:
            self._send(command_long(512, getattr(mavlink, f"MAVLINK_MSG_ID_{name}")))
        else:
            self._send(command_long(command, 0 if "STREAM" in name or "STORAGE" in name else 1))
        pause_s = 2.0 ** (attempt // 2 + 1) if attempt % 2 else 0.1
        self._timeline.after(ACK_TIMEOUT_S + pause_s, lambda: self._ask(name, command, attempt + 1))


class Scenario:
    """A camera and a station with a link that loses messages. `cut`: it loses all."""

    def __init__(self, directory: Path, seed: int, *, loss: float = LOSS, camera_first: bool = True) -> None:
        self.timeline, self.cut = Timeline(), False
        self._random, self._loss = random.Random(seed), loss
        self.harness = CameraHarness(directory)
        self.harness.camera._heartbeat_ns = None
        self.station: Any = None
        later_s = 7.3
        self._camera_s = 0.0 if camera_first else later_s
        self.timeline.after(self._camera_s, self._tick)
        self.timeline.after(later_s if camera_first else 0.0, self._start_station)
        self.begun_s = later_s

    def run(self, limit_s: float = 60.0) -> float:
        """Run until the station knows everything; returns the seconds since both were there."""
        start_s = max(self.timeline.now_s, self.begun_s)
        self.timeline.run_until(self.is_complete, start_s + limit_s)
        return self.timeline.now_s - start_s if self.is_complete() else limit_s

    def is_complete(self) -> bool:
        return self.station is not None and self.station.known == ALL

    def knows_nothing(self) -> bool:
        return not self.station.known

    def _start_station(self) -> None:
        self.station = Station(self.timeline, self._to_camera)

    def _tick(self) -> None:
        self._clock()
        for message in self.harness.due():
            self._to_station(message)
        self.timeline.after(0.05, self._tick)

    def _clock(self) -> None:
        self.harness.now_ns = 100 * S + round(self.timeline.now_s * S)

    def _is_lost(self) -> bool:
        return self.cut or self._random.random() < self._loss

    def _to_camera(self, message: Message) -> None:
        def deliver() -> None:
            self._clock()
            if message.get_type() == "HEARTBEAT":
                self.harness.camera.handle(message, self.harness.now_ns)
            for answer in self.harness.ask(message):
                self._to_station(answer)

        if self.timeline.now_s >= self._camera_s and not self._is_lost():
            self.timeline.after(DELAY_S, deliver)

    def _to_station(self, message: Message) -> None:
        if self.station is not None and not self._is_lost():
            assert message.get_srcComponent() == CAMERA_ID
            self.timeline.after(DELAY_S, lambda: self.station.receive(message))


@pytest.mark.parametrize("camera_first", [True, False])
def test_station_knows_everything_in_its_own_order(tmp_path: Path, camera_first: bool) -> None:
    scenario = Scenario(tmp_path, 1, loss=0.0, camera_first=camera_first)
    assert scenario.run() < 3.5


@pytest.mark.parametrize("camera_first", [True, False])
def test_a_third_of_the_messages_lost_delays_by_seconds(tmp_path: Path, camera_first: bool) -> None:
    times_s = [Scenario(tmp_path, seed, camera_first=camera_first).run() for seed in range(200)]
    assert max(times_s) < COMPLETE_S


@pytest.mark.parametrize("camera_first", [True, False])
def test_requests_alone_need_longer(
    tmp_path: Path, camera_first: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the pauses of the station: why a new one gets everything unasked."""
    monkeypatch.setattr(camera_module, "_ANNOUNCED_AFTER_S", ())
    times_s = [Scenario(tmp_path, seed, camera_first=camera_first).run() for seed in range(50)]
    assert sum(time_s >= COMPLETE_S for time_s in times_s) > 5


def test_station_finds_the_camera_again_after_a_silence(tmp_path: Path) -> None:
    scenarios = [Scenario(tmp_path, seed) for seed in range(50)]
    for scenario in scenarios:
        scenario.run()
        scenario.cut = True
        scenario.timeline.run_until(scenario.knows_nothing, scenario.timeline.now_s + 10.0)
        assert scenario.knows_nothing()
        scenario.cut = False
    assert max(scenario.run() for scenario in scenarios) < COMPLETE_S
