"""The query `settings`: values with ranges, changes of all or none, in the real service too."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import zenoh
from jsonschema import Draft202012Validator

from companion.bus.bodies.service import LiveSettingBody
from companion.bus.client import SettingsRefusedError, listen, set_settings
from companion.bus.schema import schema_of
from companion.bus.topics import settings_key
from companion.host.peer_data import PeerDataError
from companion.perception.messages import Ready
from companion.service import Service
from companion.service.live_settings import CHANGES_AT_ONCE
from companion.settings.live import NARROWER
from companion.settings.reading import load_settings
from companion.vehicle.state import VehicleState, with_fields
from mavlink_sim.testing import QUICK_FLIGHT, running_simulator
from tests.companion.bus.message_check import check_message, closed
from tests.companion.command_line import companion_here
from tests.companion.service_process import ServiceProcess, heartbeats, running_service

LOADED = Ready("a.mp4", "m", ("person", "car", "boat"), "float32", "torch", min_confidence=0.05)


class Bench:
    """A service that is not run, whose vehicle and loaded models are set here."""

    def __init__(self) -> None:
        self.service = Service(load_settings(os.devnull, {"cameras.down.source.uri": "none"}, {}))
        self.set_vehicle(armed=False)
        self.first, self.down = (camera.supervisor for camera in self.service.cameras)
        self.first._ready = LOADED

    def set_vehicle(self, *, armed: bool, age_s: float = 0.0) -> None:
        heartbeat_ns = time.monotonic_ns() - round(age_s * 1e9)
        state = with_fields(VehicleState(), armed=armed, heartbeat_ns=heartbeat_ns)
        self.service._live._driver = Mock(state=state)

    async def set(self, values: Any) -> dict[str, Any]:
        return dict(await self.service._live.answer(json.dumps(values).encode()))

    @property
    def events(self) -> list[str]:
        return [event.text for event in self.service.events if "setting" in event.text]


@pytest.fixture
def bench() -> Bench:
    return Bench()


async def test_empty_query_answers_values_with_ranges(bench: Bench) -> None:
    answer: dict[str, Any] = dict(await bench.service._live.answer(b""))
    detectors = {f"cameras.down.{key}" for key in NARROWER if key.startswith("detector.")}
    assert answer.keys() == NARROWER.keys() | detectors
    validator = Draft202012Validator(closed(schema_of(LiveSettingBody)))
    for body in json.loads(json.dumps(answer)).values():
        validator.validate(body)
    assert answer["guidance.max_altitude_m"] | {"expected": ""} == {
        "value": 50.0,
        "file": 50.0,
        "expected": "",
        "minimum": 0,
        "maximum": 5000,
        "narrower": "smaller",
    }
    assert bench.events == []


async def test_change_reaches_guidance_status_config_and_events(bench: Bench) -> None:
    service = bench.service
    answer = await bench.set({"guidance.max_altitude_m": 20, "guidance.min_altitude_m": 2.5})
    assert [answer[f"guidance.{end}_altitude_m"]["value"] for end in ("max", "min")] == [20.0, 2.5]
    limits = service.inputs.limits
    assert limits is not None
    assert (limits.min_altitude_m, limits.max_altitude_m, limits.max_distance_m) == (2.5, 20.0, 200.0)
    status = service.status()
    check_message("status", status)
    assert status["changed_settings"] == [
        {"key": "guidance.max_altitude_m", "value": 20.0, "file": 50.0},
        {"key": "guidance.min_altitude_m", "value": 2.5, "file": 1.0},
    ]
    config = await service._queries.handlers(service.cameras)["config"]()
    assert config["guidance"]["max_altitude_m"] == 20.0
    assert [text.partition(": ")[2] for text in bench.events] == [
        "guidance.max_altitude_m = 20.0, was 50.0",
        "guidance.min_altitude_m = 2.5, was 1.0",
    ]
    await bench.set({"guidance.max_altitude_m": 20.0})
    assert len(bench.events) == 2  # nothing has changed


@pytest.mark.parametrize(
    ("armed", "age_s", "accepted"),
    [(False, 0.0, True), (True, 0.0, False), (False, 60.0, False), (True, 60.0, False)],
    ids=["disarmed", "armed", "unknown", "unknown, was armed"],
)
async def test_unknown_state_counts_as_armed(bench: Bench, armed: bool, age_s: float, accepted: bool) -> None:
    bench.set_vehicle(armed=armed, age_s=age_s)
    await bench.set({"guidance.max_altitude_m": 20.0})
    if accepted:
        await bench.set({"guidance.max_altitude_m": 60.0})
        return
    with pytest.raises(PeerDataError, match=r"guidance\.max_altitude_m: 30 is wider than 20"):
        await bench.set({"guidance.max_altitude_m": 30.0})


async def test_without_a_vehicle_nothing_is_widened() -> None:
    service = Service(load_settings(os.devnull, {}, {}))
    with pytest.raises(PeerDataError):
        await service._live.answer(b'{"guidance.max_altitude_m": 51}')


async def test_refused_detector_changes_nothing_else(bench: Bench) -> None:
    for key, value in (
        ("detector.classes", ["cat"]),
        ("detector.confidence", 0.01),
        ("cameras.down.detector.confidence", 0.5),  # has no model
    ):
        with pytest.raises(PeerDataError) as refused:
            await bench.set({"guidance.max_altitude_m": 20, "detector.classes": ["car"], key: value})
        assert str(refused.value).startswith(key.removesuffix("confidence").removesuffix("classes"))
    assert bench.service.status()["changed_settings"] == []
    assert bench.service.inputs.limits is None
    assert bench.first._detecting is bench.down._detecting is None
    await bench.set({"detector.classes": ["Car"]})
    detecting = bench.first._detecting
    assert detecting is not None
    assert (detecting.confidence, detecting.classes) == (0.25, ("Car",))


@pytest.mark.parametrize(
    "payload",
    [
        b"[]",
        b"20",
        b"null",
        b"{",
        b"\xff\xfe",
        b'{"guidance.max_altitude_m": NaN}',
        b'{"guidance.max_altitude_m": 1e999}',
        b'{"guidance.max_altitude_m": 99999999999999999999999}',
        b'{"guidance.max_altitude_m": ' + b"[" * 100 + b"]" * 100 + b"}",
        b'{"guidance": {"max_altitude_m": 20}}',
        b'{"guidance.fence_include": ""}',
        b'{"vehicle.url": "none"}',
        b'{"detector.classes": "car"}',
        json.dumps({"detector.classes": ["c"] * 1500}).encode(),
        json.dumps({f"k{index}": index for index in range(700)}).encode(),
    ],
)
async def test_hostile_payload_is_refused_in_a_short_line(bench: Bench, payload: bytes) -> None:
    began_s = time.thread_time()
    with pytest.raises(PeerDataError) as refused:
        await bench.service._live.answer(payload)
    assert len(str(refused.value)) < 8000
    assert time.thread_time() - began_s < 0.1
    assert bench.service.status()["changed_settings"] == []


async def test_flood_of_changes_is_refused(bench: Bench) -> None:
    for number in range(CHANGES_AT_ONCE):
        await bench.set({"guidance.max_altitude_m": 20 + number})
    with pytest.raises(PeerDataError):
        await bench.set({"guidance.max_altitude_m": 10})
    assert await bench.service._live.answer(b"")
    assert len(bench.events) == CHANGES_AT_ONCE


# --- the real service


@pytest.fixture
def service(tmp_path: Path, seeing: list[str]) -> Iterator[ServiceProcess]:
    flags = [*seeing, "--confidence", "0", "--tracker-enabled", "false"]
    with heartbeats() as port, running_service(port, flags, cwd=tmp_path) as service:
        yield service


def reason_of(session: zenoh.Session, payload: bytes) -> str:
    (reply,) = session.get(settings_key("vehicle1"), payload=payload, timeout=10.0)
    assert reply.err is not None
    return str(json.loads(reply.err.payload.to_string())["reason"])


@pytest.mark.realtime
def test_settings_of_a_running_service(service: ServiceProcess, tmp_path: Path) -> None:
    names: set[str] = set()
    with service.client() as session:
        listener = listen(session, "detections", lambda _, text: names.update(_names(text)))
        before = set_settings(session, "vehicle1")
        assert before["detector.confidence"]["value"] == 0.0
        for payload in (b"x" * 20_000, b'{"detector.classes": ["cat"]}', b"[1]", b'{"zenoh.mode": "peer"}'):
            assert reason_of(session, payload).startswith("settings: ")
        assert set_settings(session, "vehicle1") == before
        deadline_s = time.monotonic() + 30.0
        while len(names) < 2:
            assert time.monotonic() < deadline_s, names
            time.sleep(0.05)
        (kept, *_) = sorted(names)
        set_settings(session, "vehicle1", {"detector.classes": [kept]})
        while names != {kept}:
            assert time.monotonic() < deadline_s, names
            names.clear()
            time.sleep(0.5)
        listener.undeclare()  # type: ignore[no-untyped-call]
    where = ("--zenoh-listen", service.endpoint)
    done = companion_here(
        "send",
        "--set",
        "guidance.max_altitude_m=20",
        "--set",
        "detector.confidence=0.5",
        *where,
        cwd=tmp_path,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        "guidance.max_altitude_m = 20.0 (file: 50.0)",
        "detector.confidence = 0.5 (file: 0.0)",
    ]
    for text, code in (("guidance.max_altitude_m=0.5", 1), ("guidance.brake_s=1", 2), ("hold", 2)):
        refused = companion_here("send", "--set", text, *where, cwd=tmp_path)
        assert (refused.returncode, refused.stdout) == (code, "")
    both = companion_here("send", "hold", "--set", "guidance.max_altitude_m=20", *where, cwd=tmp_path)
    assert both.returncode == 2
    service.wait_for_line("setting changed: guidance.max_altitude_m = 20.0, was 50.0", 10.0)


def _names(text: str) -> set[str]:
    return {each["class_name"] for each in json.loads(text)["detections"]}


@pytest.mark.realtime
def test_lower_altitude_is_held_in_flight_and_widened_after_landing(
    tmp_path: Path, filming: list[str]
) -> None:
    with (
        running_simulator(parameters=QUICK_FLIGHT) as simulator,
        running_service(simulator.onboard_port, filming, cwd=tmp_path) as service,
        service.client() as session,
    ):
        heights: list[float] = []
        listener = listen(session, "vehicle", lambda _, text: heights.append(_height_m(text)))
        service.take_off(3.0)
        with ThreadPoolExecutor(1) as operator:
            climbing = operator.submit(service.command, "goto north=2 east=0 altitude=20")
            while heights[-1] < 4.0 and not climbing.done():
                time.sleep(0.02)
            set_settings(session, "vehicle1", {"guidance.max_altitude_m": 10})
            with pytest.raises(SettingsRefusedError, match="11 is wider than 10"):
                set_settings(session, "vehicle1", {"guidance.max_altitude_m": 11})
            assert not climbing.result()["success"]  # held below its goal
        # The error of its estimated velocity moves a vehicle that a limit holds, also one of the file.
        assert 9.0 < max(heights) < 12.0
        assert not service.command("goto north=5 east=0 altitude=14")["success"]
        set_settings(session, "vehicle1", {"guidance.max_altitude_m": 4})  # below the vehicle
        service.command("goto north=4 east=0 altitude=3")
        lowered = len(heights)
        assert service.command("land")["success"]
        assert max(heights[:lowered]) < 12.0
        assert max(heights[lowered:]) < 4.6
        deadline_s = time.monotonic() + 20.0
        while True:
            try:
                now = set_settings(session, "vehicle1", {"guidance.max_altitude_m": 60})
                break
            except SettingsRefusedError:  # its disarming is not reported yet
                assert time.monotonic() < deadline_s
                time.sleep(0.6)
        assert now["guidance.max_altitude_m"]["value"] == 60.0
        listener.undeclare()  # type: ignore[no-untyped-call]


def _height_m(text: str) -> float:
    altitude_m = json.loads(text).get("altitude_m")
    return -math.inf if altitude_m is None else float(altitude_m)
