"""Missing streams and their requests: by given stamps, and with a Copter in lockstep."""

from __future__ import annotations

import logging

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.ardupilot_profile import ArduPilotProfile
from companion.vehicle.stream_requests import StreamMonitor, StreamRequests
from companion.vehicle.telemetry_state import TelemetryState
from mavlink_sim import LockstepVehicle
from mavlink_sim.wire.messages import dialect

ATTITUDE, POSITION, MODE, HOME, RANGE = 31, 32, 436, 242, 132
STEP_S = 0.1


def ns(seconds: float) -> int:
    return round(seconds * 1e9)


class Listener:
    """Feeds messages at even rates into a monitor; records its requests."""

    def __init__(self, monitor: StreamMonitor) -> None:
        self.monitor, self.now_s = monitor, 0.0
        self.asked: list[tuple[float, int]] = []

    def run(self, seconds: float, rates_hz: dict[int, float]) -> None:
        for _ in range(round(seconds / STEP_S)):
            before_s, self.now_s = self.now_s, round(self.now_s + STEP_S, 6)
            for message_id, rate_hz in rates_hz.items():
                for _ in range(int(self.now_s * rate_hz + 1e-6) - int(before_s * rate_hz + 1e-6)):
                    self.monitor.received(message_id)
            for message_id in self.monitor.due(ns(self.now_s)):
                self.asked.append((self.now_s, message_id))
                self.monitor.asked(message_id, ns(self.now_s))


def test_stream_above_half_its_rate_is_not_requested() -> None:
    listener = Listener(StreamMonitor({ATTITUDE: 50.0, HOME: 0.5}, 0))
    listener.run(60.0, {ATTITUDE: 26.0, HOME: 0.5})
    assert listener.asked == []
    assert not listener.monitor.missing


def test_stream_below_half_its_rate_is_requested() -> None:
    listener = Listener(StreamMonitor({ATTITUDE: 50.0, POSITION: 30.0}, 0))
    listener.run(10.0, {ATTITUDE: 50.0, POSITION: 30.0})
    listener.run(3.1, {ATTITUDE: 24.0, POSITION: 30.0})
    assert [message_id for _, message_id in listener.asked] == [ATTITUDE]
    assert listener.monitor.missing == (ATTITUDE,)
    listener.run(2.1, {ATTITUDE: 50.0, POSITION: 30.0})
    assert not listener.monitor.missing
    assert len(listener.asked) == 1


def test_pause_doubles_to_eight_seconds_and_resets() -> None:
    listener = Listener(StreamMonitor({POSITION: 30.0}, 0, first_window_s=1.5))
    listener.run(40.0, {})
    times_s = [when_s for when_s, _ in listener.asked]
    assert times_s == [1.5, 3.5, 7.5, 15.5, 23.5, 31.5, 39.5]
    listener.run(4.0, {POSITION: 30.0})
    listener.asked.clear()
    since_s = listener.now_s
    listener.run(8.0, {})
    first, second, *_ = (when_s - since_s for when_s, _ in listener.asked)
    assert first <= 3.0
    assert second - first < 2.1


def test_restart_resets_pauses_and_missing_streams() -> None:
    listener = Listener(StreamMonitor({POSITION: 30.0}, 0))
    listener.run(20.0, {})
    listener.asked.clear()
    listener.monitor.restart(ns(listener.now_s))
    assert not listener.monitor.missing
    listener.run(2.0, {})
    assert [message_id for _, message_id in listener.asked] == [POSITION]


def test_refused_optional_stream_is_not_missing() -> None:
    monitor = StreamMonitor({POSITION: 30.0, MODE: 2.0}, 0, optional=(MODE,))
    assert monitor.due(ns(2.0)) == [POSITION, MODE]
    for message_id in (POSITION, MODE):
        monitor.asked(message_id, ns(2.0))
        monitor.answered(message_id, accepted=False)
    assert monitor.missing == (POSITION,)
    assert monitor.due(ns(30.0)) == [POSITION]
    monitor.restart(ns(30.0))
    assert MODE in monitor.due(ns(32.0))


def test_stream_of_missing_equipment_is_requested_once() -> None:
    monitor = StreamMonitor({POSITION: 30.0, RANGE: 10.0}, 0, once=(RANGE,))
    assert monitor.due(ns(2.0)) == [POSITION, RANGE]
    for message_id in (POSITION, RANGE):
        monitor.asked(message_id, ns(2.0))
        monitor.answered(message_id, accepted=True)
    assert monitor.missing == (POSITION,)
    assert monitor.due(ns(30.0)) == [POSITION]
    monitor.asked(RANGE, ns(30.0))
    monitor.restart(ns(30.0))
    assert RANGE in monitor.due(ns(32.0))


class CopterClient:
    """Requests the streams of a Copter in lockstep, as the drivers do."""

    def __init__(self) -> None:
        self.copter = LockstepVehicle(autopilot="ardupilot", seed=1, ready_after_s=0.0)
        self.profile = ArduPilotProfile()
        self.monitor = StreamMonitor(self.profile.rates_hz, 0, once=self.profile.once)
        self.loses_requests = False

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.copter.step(STEP_S)
            for message in self.copter.receive():
                self.monitor.received(message.get_msgId())
            now_ns = ns(self.copter.vehicle.faults.now_s)
            for message_id in self.monitor.due(now_ns):
                self.monitor.asked(message_id, now_ns)
                if not self.loses_requests:
                    interval_us = round(1e6 / self.profile.rates_hz[message_id])
                    self.copter.send(
                        dialect.MAVLink_command_long_message(
                            1,
                            1,
                            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
                            0,
                            message_id,
                            interval_us,
                            0,
                            0,
                            0,
                            0,
                            0,
                        )
                    )
                    self.monitor.answered(message_id, accepted=True)


def test_copter_sends_all_streams_after_lost_requests() -> None:
    client = CopterClient()
    client.loses_requests = True
    client.run(6.0)
    assert POSITION in client.monitor.missing
    client.loses_requests = False
    client.run(12.0)
    assert not client.monitor.missing


def test_copter_streams_return_after_a_quick_reboot() -> None:
    client = CopterClient()
    client.run(15.0)
    assert not client.monitor.missing
    client.copter.vehicle.faults.begin("reboot 1")
    client.run(15.0)
    assert not client.monitor.missing
    client.copter.receive()
    client.copter.step(1.0)
    counted = [message.get_type() for message in client.copter.receive()]
    assert counted.count("LOCAL_POSITION_NED") >= 25


def test_copter_streams_return_after_being_stopped() -> None:
    client = CopterClient()
    client.run(15.0)
    for rate_hz, start in ((2, 1), (0, 0)):
        client.copter.send(
            dialect.MAVLink_request_data_stream_message(1, 1, mavlink.MAV_DATA_STREAM_ALL, rate_hz, start)
        )
        client.run(6.0)
        assert not client.monitor.missing
        client.copter.receive()
        client.copter.step(1.0)
        counted = [message.get_type() for message in client.copter.receive()]
        assert counted.count("LOCAL_POSITION_NED") >= 25


def test_only_a_newly_missing_stream_is_a_warning(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the start most are missing, and slow ones come last; a stream that stops later is a warning."""

    async def command(*_: float) -> int:
        return 0

    requests = StreamRequests("url", TelemetryState("url", lambda: None), command)
    caplog.set_level(logging.INFO)
    for missing in ((ATTITUDE, HOME), (HOME,), (), (ATTITUDE,), (ATTITUDE, HOME), (HOME,)):
        monkeypatch.setattr(StreamMonitor, "missing", missing)
        requests._update_state()
    levels = [record.levelno for record in caplog.records if "too slow" in record.message]
    assert levels == [logging.INFO, logging.INFO, logging.WARNING, logging.WARNING, logging.INFO]
