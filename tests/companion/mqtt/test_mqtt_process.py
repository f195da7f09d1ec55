"""The service with `mqtt.url`: what a station sees, before and after that process is killed."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import aiomqtt
import pytest
import zenoh

from companion.bus.client import settings_for_child
from companion.bus.topics import IMAGE, TRACKS
from companion.host.child_process import EXIT_REFUSED
from companion.mqtt.home_assistant import EVENT_KINDS
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port
from tests.companion.mqtt import mosquitto
from tests.companion.service_process import ServiceProcess, heartbeats, running_service
from vision.extras import install_command

pytestmark = [pytest.mark.realtime, pytest.mark.needs("mosquitto")]

WAIT_S = 30.0
BASE = "companion/vehicle1"


class Station:
    """A client of the broker with all messages that it received, to wait for."""

    def __init__(self, client: aiomqtt.Client) -> None:
        self._client = client
        self.received: list[tuple[str, bytes]] = []

    async def wait(self, topic: str, payload: bytes | None = None) -> bytes:
        """Return the next message of a topic, or the next with that payload."""
        async with asyncio.timeout(WAIT_S):
            async for message in self._client.messages:
                assert isinstance(message.payload, bytes)
                self.received.append((str(message.topic), message.payload))
                if str(message.topic) == topic and payload in (None, message.payload):
                    return message.payload
        raise AssertionError

    async def send(self, text: str, topic: str = "command", *, retain: bool = False) -> None:
        await self._client.publish(f"{BASE}/{topic}", text, retain=retain)


@pytest.fixture
def port() -> int:
    return free_port(socket.SOCK_STREAM)


@contextmanager
def service_and_broker(port: int, flags: list[str], folder: Path) -> Iterator[ServiceProcess]:
    with (
        mosquitto.broker(port, folder),
        heartbeats() as autopilot,
        running_service(autopilot, [*flags, "--mqtt-url", f"mqtt://127.0.0.1:{port}"], cwd=folder) as service,
    ):
        yield service


@pytest.fixture
def service(
    request: pytest.FixtureRequest, port: int, filming: list[str], tmp_path: Path
) -> Iterator[ServiceProcess]:
    """A service of the test's own."""
    with service_and_broker(port, [*filming, *getattr(request, "param", ())], tmp_path) as running:
        yield running


@pytest.fixture(scope="module")
def lasting(
    filming: list[str], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[ServiceProcess, int]]:
    """A service that no test ends, and the port of its broker."""
    port = free_port(socket.SOCK_STREAM)
    with service_and_broker(port, filming, tmp_path_factory.mktemp("lasting")) as running:
        yield running, port


def tracks(kind: str) -> bytes:
    """A message of the service about a cat; this one has no detector."""
    now_ns = time.monotonic_ns()
    place = dict.fromkeys(("latitude_deg", "longitude_deg", "altitude_amsl_m", "error_ellipse", "moving"))
    event = {
        "event": kind,
        "stamp_ns": now_ns,
        "first_ns": now_ns,
        "last_ns": now_ns,
        "track_id": 1,
        "object_id": None,
        "class_name": "cat",
        "confidence": 0.9,
        "xyxy": [0, 0, 8, 8],
    }
    frame = {"vehicle": "vehicle1", "camera": None, "width": 16, "height": 16}
    return json.dumps({**frame, "events": [event | place]}).encode()


def put_until_somebody_listens(session: zenoh.Session, kind: str) -> None:
    publisher = session.declare_publisher(TRACKS.key("vehicle1"))
    deadline_s = time.monotonic() + WAIT_S
    while not publisher.matching_status.matching and time.monotonic() < deadline_s:  # type: ignore[attr-defined]
        time.sleep(0.02)
    publisher.put(tracks(kind))


def put_short_tracks(session: zenoh.Session, count: int) -> None:
    """Publish so many tracks that are new and end at once: two events of each."""
    publisher = session.declare_publisher(
        TRACKS.key("vehicle1"), congestion_control=zenoh.CongestionControl.BLOCK
    )
    each = [json.loads(tracks(kind)) for kind in ("new", "end")]
    for first in range(0, count, 100):
        events = [
            body["events"][0] | {"track_id": number}
            for number in range(first, min(first + 100, count))
            for body in each
        ]
        publisher.put(json.dumps({**each[0], "events": events}))
    publisher.undeclare()  # type: ignore[no-untyped-call]


def pid_of(service: ServiceProcess, module: bytes) -> int:
    children = Path(f"/proc/{service.pid}/task/{service.pid}/children").read_text().split()
    (found,) = (int(pid) for pid in children if module in Path(f"/proc/{pid}/cmdline").read_bytes())
    return found


def with_station(port: int, work: Any) -> None:
    async def run() -> None:
        async with aiomqtt.Client("127.0.0.1", port) as client:
            await client.subscribe("#")
            await work(Station(client))

    asyncio.run(run())


def test_a_station_sees_the_vehicle_its_objects_and_its_end(service: ServiceProcess, port: int) -> None:
    async def work(station: Station) -> None:
        await station.wait(f"{BASE}/available", b"online")
        state = json.loads(await station.wait(f"{BASE}/state"))
        assert (state["connected"], state["mode"], state["armed"]) == (True, "hold", False)
        with service.client() as session:
            await asyncio.to_thread(put_until_somebody_listens, session, "new")
            event = json.loads(await station.wait(f"{BASE}/objects"))
            session.put(TRACKS.key("vehicle1"), tracks("end"))
            ended = json.loads(await station.wait(f"{BASE}/objects"))
        assert (event["event_type"], event["class"], ended["event_type"]) == ("new", "cat", "end")
        jpegs = [payload for topic, payload in station.received if topic == f"{BASE}/snapshot"]
        assert [jpeg[:2] for jpeg in jpegs] == [b"\xff\xd8"]
        # Not allowed: it is answered by nobody, and said by nobody.
        await station.send("takeoff")
        os.kill(pid_of(service, b"companion.mqtt"), signal.SIGKILL)
        killed_s = time.monotonic()
        await station.wait(f"{BASE}/available", b"offline")
        assert time.monotonic() - killed_s < 5.0  # the last will
        await station.wait(f"{BASE}/available", b"online")
        await asyncio.to_thread(service.stop)
        await station.wait(f"{BASE}/available", b"offline")
        assert not any(topic == f"{BASE}/result" for topic, _ in station.received)

    with_station(port, work)
    assert any("mqtt: its process ended" in line for line in service.last_lines())


def test_discovery_names_only_topics_and_values_that_come(lasting: tuple[ServiceProcess, int]) -> None:
    _, port = lasting

    async def work(station: Station) -> None:
        device = json.loads(await station.wait("homeassistant/device/companion_vehicle1/config"))
        state = json.loads(await station.wait(f"{BASE}/state"))
        entities = device["components"].values()
        assert device["availability_topic"] == f"{BASE}/available"
        assert len({entity["unique_id"] for entity in entities}) == len(entities)
        of_state = [entity for entity in entities if entity.get("state_topic") == f"{BASE}/state"]
        assert len(of_state) >= 8
        keys = [re.fullmatch(r"\{\{ value_json\.(\w+) \}\}", entity["value_template"]) for entity in of_state]
        assert {key and key[1] for key in keys} <= set(state)
        (of_objects,) = (entity for entity in entities if entity["platform"] == "event")
        assert of_objects["event_types"] == list(EVENT_KINDS)
        assert "value_template" not in of_objects  # its messages have `event_type` as they are
        others = {entity.get("state_topic") or entity.get("topic") for entity in entities} - {None}
        assert others == {f"{BASE}/state", f"{BASE}/objects", f"{BASE}/snapshot"}

    with_station(port, work)


def test_the_will_of_an_older_connection_does_not_last(lasting: tuple[ServiceProcess, int]) -> None:
    _, port = lasting

    async def work(station: Station) -> None:
        await station.wait(f"{BASE}/available", b"online")
        await station.send("offline", "available", retain=True)
        await station.wait(f"{BASE}/available", b"offline")
        await station.wait(f"{BASE}/available", b"online")

    with_station(port, work)


def test_a_message_of_another_shape_is_said_and_ends_nothing(lasting: tuple[ServiceProcess, int]) -> None:
    service, port = lasting

    async def work(station: Station) -> None:
        await station.wait(f"{BASE}/available", b"online")
        with service.client() as session:
            await asyncio.to_thread(put_until_somebody_listens, session, "new")
            session.put(TRACKS.key("vehicle1"), b'{"camera": null, "events": [{"event": "end"}]}')
            await asyncio.to_thread(service.wait_for_line, "mqtt: tracks: not valid: KeyError")
            session.put(TRACKS.key("vehicle1"), tracks("end"))
            while json.loads(await station.wait(f"{BASE}/objects"))["event_type"] != "end":
                pass

    with_station(port, work)


def test_without_its_extra_it_is_refused_with_the_command(tmp_path: Path) -> None:
    (tmp_path / "aiomqtt.py").write_text("raise ModuleNotFoundError(name='aiomqtt')")
    options = {"mqtt": {}, "cameras": [], "vehicle": "vehicle1", "zenoh": settings_for_child(ZenohSection())}
    ended = subprocess.run(
        [sys.executable, "-m", "companion.mqtt"],
        input=json.dumps(options) + "\n",
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        capture_output=True,
        text=True,
    )
    assert (ended.returncode, ended.stderr) == (EXIT_REFUSED, "")
    assert install_command("aiomqtt") in ended.stdout


@pytest.mark.parametrize("service", [["--mqtt-commands", "true"]], indirect=True)
def test_a_command_is_executed_where_that_is_set(service: ServiceProcess, port: int) -> None:
    async def work(station: Station) -> None:
        await station.wait(f"{BASE}/available", b"online")
        for text in ("stop", "fly away"):
            await station.send(text)
            reply = json.loads(await station.wait(f"{BASE}/result"))
            assert (reply["command"], reply["success"]) == (text, text == "stop"), reply

    with_station(port, work)


def test_nothing_of_images_is_encoded_without_a_new_object(lasting: tuple[ServiceProcess, int]) -> None:
    service, port = lasting

    async def work(station: Station) -> None:
        await station.wait(f"{BASE}/available", b"online")
        with service.client() as session:
            status = session.declare_subscriber("companion/vehicle1/status")
            texts = [(await asyncio.to_thread(status.recv)).payload.to_string() for _ in range(3)]
        images = [json.loads(text)["bus"]["published"][IMAGE.name] for text in texts]
        # The first may come while the image of another test's object is encoded.
        assert images[1] == images[2]

    with_station(port, work)


def test_a_lost_broker_and_a_hanging_webhook_cost_events_alone(
    port: int, filming: list[str], tmp_path: Path
) -> None:
    """What is lost is counted, and the end of a service that is killed is said."""
    lost = 4000
    with ExitStack() as stack:
        hanging = stack.enter_context(socket.create_server(("127.0.0.1", 0)))  # takes requests, answers none
        hook = f"http://127.0.0.1:{hanging.getsockname()[1]}/"
        flags = [*filming, "--mqtt-url", f"mqtt://127.0.0.1:{port}", "--mqtt-webhooks", hook]
        first = ExitStack()
        stack.enter_context(first)
        process = first.enter_context(mosquitto.broker(port, tmp_path))
        autopilot = stack.enter_context(heartbeats())
        service = stack.enter_context(running_service(autopilot, flags, cwd=tmp_path))
        session = stack.enter_context(service.client())
        publisher = pid_of(service, b"companion.mqtt")

        async def while_the_webhook_hangs(station: Station) -> None:
            await station.wait(f"{BASE}/available", b"online")
            await asyncio.to_thread(put_until_somebody_listens, session, "new")
            await station.wait(f"{BASE}/objects")
            client, _ = await asyncio.to_thread(hanging.accept)
            stack.enter_context(client)
            assert (await asyncio.to_thread(client.recv, 4)) == b"POST"
            begun_s = time.monotonic()
            session.put(TRACKS.key("vehicle1"), tracks("end"))
            assert json.loads(await station.wait(f"{BASE}/objects"))["event_type"] == "end"
            assert time.monotonic() - begun_s < 2.0
            await station.wait(f"{BASE}/state")

        with_station(port, while_the_webhook_hangs)

        process.kill()
        service.wait_for_line("retrying")
        put_short_tracks(session, lost // 2)
        service.wait_for_line("it answers too slowly")
        first.close()
        noted = len(service.lines)
        stack.enter_context(mosquitto.broker(port, tmp_path))
        line = service.wait_for_line("events were not sent", 60.0, after=noted)
        assert f"({lost} events" in line  # none waited
        assert pid_of(service, b"companion.mqtt") == publisher

        async def after_it_is_back(station: Station) -> None:
            await station.wait(f"{BASE}/available", b"online")
            await station.wait(f"{BASE}/state")
            await asyncio.to_thread(put_until_somebody_listens, session, "new")
            await station.wait(f"{BASE}/objects")
            service.process.kill()
            killed_s = time.monotonic()
            await station.wait(f"{BASE}/available", b"offline")
            assert time.monotonic() - killed_s < 5.0

        with_station(port, after_it_is_back)


def test_a_broker_that_takes_no_connection_delays_no_end(filming: list[str], tmp_path: Path) -> None:
    with ExitStack() as stack:
        full = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
        port = full.getsockname()[1]
        for _ in range(4):
            client = stack.enter_context(socket.socket())
            client.setblocking(False)
            client.connect_ex(("127.0.0.1", port))
        before = connecting_to(port)
        flags = [*filming, "--mqtt-url", f"mqtt://127.0.0.1:{port}"]
        autopilot = stack.enter_context(heartbeats())
        service = stack.enter_context(running_service(autopilot, flags, cwd=tmp_path))
        deadline_s = time.monotonic() + WAIT_S
        while connecting_to(port) <= before and time.monotonic() < deadline_s:
            time.sleep(0.02)
        service.stop()
        assert not any("mqtt: has not ended" in line for line in service.last_lines())


def connecting_to(port: int) -> int:
    """Return the number of connections to a port that nobody has taken yet."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()]
    return sum(row[2].endswith(f":{port:04X}") and row[3] == "02" for row in rows)  # TCP_SYN_SENT
