"""Signing, the default driver, and a second service, on the autopilot at COMPANION_SITL_URL."""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zenoh

from companion.bus.topics import command_key
from companion.vehicle.link_url import parse_link_url
from mavlink_sim.testing import free_port
from tests.companion.service_process import ServiceProcess, running_service
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import (
    PX4,
    READY_S,
    RESTART,
    AutopilotLink,
    Flight,
    bring_down,
    needs_px4,
    set_for_test,
    signing_time,
)

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
# udpin://HOST:PORT to which the autopilot's second link sends, for a second service.
SECOND = "COMPANION_SITL_SECOND_URL"
KEY, PX4_KEY = bytes(range(1, 33)), "mavlink/mavlink-signing-key.bin"
NAMED_S, SIGNED_S = 15.0, 10.0
REFUSED = "another service commands this vehicle ("


def test_default_driver_flies_the_autopilot(link: AutopilotLink, services: Services) -> None:
    bring_down(link)
    flight = services.flight(None)
    link.until(lambda: flight.status, 10.0, "a status")
    assert flight.status["vehicle"]["driver"] == "pymavlink"
    link.until(lambda: link.ready, READY_S, "ready to be armed")
    flight.take_off(2.0)
    flight.fly("land")


def restart(link: AutopilotLink) -> None:
    """By the command of COMPANION_SITL_RESTART."""
    boots = link.boots
    subprocess.run(os.environ[RESTART], shell=True, check=True)
    link.until(lambda: link.boots > boots, 60.0, "restarted")
    link.until(lambda: link.ready, READY_S, "ready to be armed")


@pytest.fixture
def signing(flight: Flight, parameters: dict[str, float]) -> Iterator[AutopilotLink]:
    """The autopilot signs what it sends, and takes nothing unsigned."""
    link = flight.link
    if link.autopilot == PX4:
        needs_px4(link, (1, 17), "signing (MAV_SIGN_CFG, and a folder for its key)")
        # It takes SETUP_SIGNING over USB alone, and reads its key when it starts.
        if RESTART not in os.environ:
            pytest.skip(f"{RESTART} names no command")
        try:
            link.write_file(PX4_KEY, KEY + struct.pack("<Q", signing_time()))
            restart(link)
            parameters |= set_for_test(link, {"MAV_SIGN_CFG": 2.0})
            link.sign_with(KEY)
            yield link
            bring_down(link)
        finally:
            for name, value in parameters.items():
                link.set_parameter(name, value)
            link.write_file(PX4_KEY, b"")
            link.sign_with(None)
            restart(link)
        return  # it goes on to sign, with a key of zeros, and takes what is unsigned
    link.set_up_signing(KEY)
    yield link
    bring_down(link)
    link.set_up_signing(None)
    link.until(lambda: not link.signed, SIGNED_S, "unsigned")


def test_a_signing_autopilot_needs_a_service_with_its_key(
    signing: AutopilotLink, flight: Flight, services: Services, tmp_path: Path
) -> None:
    link = signing
    link.until(lambda: link.signed, SIGNED_S, "signed")
    reply = flight.command("takeoff 2")
    assert not reply["success"]
    assert "vehicle.signing_key_file" in reply["reason"]
    assert not link.armed
    key = tmp_path / "signing.key"
    key.write_bytes(KEY)
    key.chmod(0o600)
    with_key = services.flight(flight.driver, "--vehicle-signing-key-file", str(key))
    since_s = time.monotonic()
    link.until(lambda: link.ready, READY_S, "ready to be armed")
    with_key.take_off(2.0)
    with_key.note("signed link", took_off_after_s=time.monotonic() - since_s)
    with_key.fly("land")


class Beside:
    """The vehicle's first service, and a way to start a second one at its other link."""

    def __init__(self, first: Flight, flags: list[str], port: int, folder: Path, stack: ExitStack) -> None:
        self.first, self._flags, self._port = first, flags, port
        self._folder, self._stack = folder, stack

    def start(self, name: str, *more: str) -> ServiceProcess:
        """Start it, on the network of the first one."""
        endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        flags = [*self._flags, "--vehicle-name", name, "--zenoh-listen", endpoint]
        flags += ["--zenoh-connect", self.first.service.endpoint, *more]
        service = running_service(self._port, flags, cwd=self._folder, endpoint=endpoint)
        return self._stack.enter_context(service)

    def answers(self, name: str, text: str) -> list[dict[str, Any]]:
        """What each service of that name answers."""
        with self.first.service.client() as session:
            replies = session.get(
                command_key(name),
                payload=text,
                timeout=60.0,
                consolidation=zenoh.ConsolidationMode.NONE,  # or one answer would stand for both
            )
            return [json.loads(reply.ok.payload.to_string()) for reply in replies if reply.ok]

    def named(self) -> set[str]:
        """By which ways the first one knows of another."""
        return {one["via"] for one in self.first.status["vehicle"]["other_commanders"]}


@pytest.fixture
def beside(flight: Flight, services: Services, tmp_path: Path) -> Iterator[Beside]:
    """A first service that has run for long enough to be the first."""
    if SECOND not in os.environ:
        pytest.skip(f"{SECOND} names no second link of the autopilot")
    (tmp_path / "frame.ppm").write_bytes(b"P6 4 4 255\n" + bytes(48))
    port = parse_link_url(os.environ[SECOND]).address[1]
    link = flight.link
    link.until(lambda: flight.status and flight.status["uptime_s"] > 4.0, 20.0, "running for 4 s")
    with ExitStack() as stack:
        yield Beside(flight, services.flags(flight.driver), port, tmp_path, stack)
    link.until(lambda: not flight.status["vehicle"]["other_commanders"], NAMED_S, "alone again")


def test_two_services_of_one_name_are_reported_and_one_refuses(beside: Beside) -> None:
    first, link = beside.first, beside.first.link
    second = beside.start("vehicle1")
    named_s = link.until(lambda: beside.named() == {"mavlink", "zenoh"}, NAMED_S, "named both ways")
    second.wait_for_line(f"another service commands this vehicle: {link.system_id}/191 by mavlink", NAMED_S)
    second.wait_for_line("by zenoh, not in command", NAMED_S)
    answers = beside.answers("vehicle1", "takeoff 3")
    assert sorted(REFUSED in answer["reason"] for answer in answers) == [False, True], answers
    second.wait_for_line(REFUSED, 5.0)
    first.note("second service of the same name", named_after_s=named_s)


def test_a_second_service_of_another_name_refuses(beside: Beside) -> None:
    first, link = beside.first, beside.first.link
    second = beside.start("vehicle2")
    named_s = link.until(lambda: beside.named() == {"mavlink"}, NAMED_S, "named")
    second.wait_for_line(f"another service commands this vehicle: {link.system_id}/191 by mavlink", NAMED_S)
    (answer,) = beside.answers("vehicle2", "takeoff 3")
    assert not answer["success"]
    assert f"{link.system_id}/191 by mavlink, " in answer["reason"]
    assert ", not in" in answer["reason"]
    assert not link.armed
    first.take_off(3.0)
    first.fly("hold")
    until_s = time.monotonic() + NAMED_S
    while (
        f"{link.system_id}/191 by mavlink, in command"
        not in (answer := beside.answers("vehicle2", "hold")[0])["reason"]
    ):
        assert REFUSED in answer["reason"]
        assert time.monotonic() < until_s, answer
        link.after(0.5)
    first.fly("land")
    first.note("second service of another name", named_after_s=named_s)


def test_a_second_service_flies_where_that_is_allowed(beside: Beside) -> None:
    link = beside.first.link
    second = beside.start("vehicle2", "--vehicle-allow-other-commander", "true")
    second.wait_for_line(f"another service commands this vehicle: {link.system_id}/191 by mavlink", NAMED_S)
    until_s = time.monotonic() + READY_S
    while not (answer := beside.answers("vehicle2", "takeoff 3")[0])["success"]:
        assert REFUSED not in answer["reason"]
        assert time.monotonic() < until_s, answer
        link.after(1.0)
    assert link.armed
    (answer,) = beside.answers("vehicle2", "land")
    assert answer["success"], answer
