"""A key sent by SETUP_SIGNING to the simulated autopilots, and an advice of what they do not answer."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle import signing_setup
from companion.vehicle.connection_advice import no_answer_advice
from companion.vehicle.driver import LinkError
from companion.vehicle.framing import Framer
from companion.vehicle.link_url import parse_link_url
from companion.vehicle.signing import NO_KEY, FrameSigner, is_signed_with_a_key
from companion.vehicle.signing_setup import SigningSetup, SigningSetupError, set_up_signing
from companion.vehicle.vehicle_type import ARDUPILOT, PX4
from mavlink_sim.testing import RunningSimulator, free_port, running_simulator

pytestmark = pytest.mark.realtime

KEY, OTHER = bytes(range(32)), bytes(range(1, 33))


@pytest.fixture(scope="module", params=["px4", "ardupilot"])
def simulator(request: pytest.FixtureRequest) -> Iterator[tuple[RunningSimulator, int]]:
    """The simulator, and its MAV_AUTOPILOT."""
    with running_simulator(autopilot=request.param, ready_after=0.0) as running:
        yield running, ARDUPILOT if request.param == "ardupilot" else PX4


def send(port: int, key: bytes | None, present_key: bytes | None = None) -> SigningSetup:
    url = parse_link_url(f"udpin://127.0.0.1:{port}")
    return asyncio.run(set_up_signing(url, key, present_key=present_key))


def test_key_is_sent_changed_and_removed(simulator: tuple[RunningSimulator, int]) -> None:
    running, autopilot = simulator
    ardupilot = autopilot == ARDUPILOT
    # The simulated PX4 takes a key by its ground station's link alone, which stands for USB.
    port = running.onboard_port if ardupilot else running.gcs_port
    assert send(port, KEY) == SigningSetup(1, autopilot, takes_unsigned=not ardupilot)
    if ardupilot:
        with pytest.raises(SigningSetupError, match="present-key-file"):
            send(port, OTHER)
    assert send(port, OTHER, KEY).autopilot == autopilot
    assert send(port, None, OTHER).takes_unsigned


def test_px4_takes_no_key_on_another_port() -> None:
    with running_simulator(ready_after=0.0) as running, pytest.raises(SigningSetupError, match="USB"):
        send(running.onboard_port, KEY)


@contextmanager
def talking(*frames: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Send frames to a port five times a second; yields the port and what comes back."""
    port, received, ended = free_port(), list[bytes](), threading.Event()

    def talk() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
            endpoint.bind(("127.0.0.1", 0))
            endpoint.setblocking(False)
            while not ended.wait(0.2):
                for frame in frames:
                    endpoint.sendto(frame, ("127.0.0.1", port))
                try:
                    while True:
                        received.append(endpoint.recv(2048))
                except (BlockingIOError, ConnectionError):
                    continue

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield port, received
    finally:
        ended.set()
        thread.join()


def packed(message: mavlink.MAVLink_message, component: int = 1) -> bytes:
    return bytes(message.pack(mavlink.MAVLink(None, 1, component)))


def heartbeat(base_mode: int = 0) -> bytes:
    return packed(mavlink.MAVLink_heartbeat_message(2, PX4, base_mode, 0, 3, 3))


def test_no_key_is_sent_to_an_armed_vehicle() -> None:
    with talking(heartbeat(mavlink.MAV_MODE_FLAG_SAFETY_ARMED)) as (port, received):
        with pytest.raises(LinkError, match="armed"):
            send(port, KEY)
        assert received == []


def test_no_key_is_sent_over_a_radio() -> None:
    radio = packed(mavlink.MAVLink_radio_status_message(1, 1, 100, 1, 1, 0, 0), 68)
    with talking(heartbeat(), radio) as (port, received):
        with pytest.raises(SigningSetupError, match="radio"):
            send(port, KEY)
        assert received == []


def test_key_is_sent_to_the_autopilot_alone() -> None:
    with talking(heartbeat()) as (port, received), pytest.raises(SigningSetupError):
        send(port, KEY)
    frames = [frame for data in received for frame in Framer().feed(data, datagram=True)]
    keys = [frame.padded(42) for frame in frames if frame.message_id == mavlink.MAVLINK_MSG_ID_SETUP_SIGNING]
    assert keys
    assert {(key[8], key[9], key[10:]) for key in keys} == {(1, 1, KEY)}


@pytest.mark.parametrize(
    ("autopilot", "parameter"), [(PX4, "MAV_PROTO_VER"), (ARDUPILOT, "SERIALx_PROTOCOL")]
)
def test_mavlink_1_is_named(monkeypatch: pytest.MonkeyPatch, autopilot: int, parameter: str) -> None:
    for name in ("_RADIO_S", "_ATTEMPT_S", "_ASK_S"):
        monkeypatch.setattr(signing_setup, name, 0.2)
    message = mavlink.MAVLink_heartbeat_message(2, autopilot, 0, 0, 3, 3)
    old = bytes(message.pack(mavlink.MAVLink(None, 1, 1), force_mavlink1=True))
    with talking(old) as (port, _), pytest.raises(SigningSetupError, match=f"MAVLink 1.*{parameter}"):
        send(port, KEY)


def test_px4s_key_of_zeros_is_no_key() -> None:
    assert not is_signed_with_a_key(heartbeat())
    assert not is_signed_with_a_key(FrameSigner(NO_KEY).signed(heartbeat()))
    assert is_signed_with_a_key(FrameSigner(KEY).signed(heartbeat()))


@pytest.mark.parametrize(
    ("signs", "answered_ago_s", "names"),
    [(True, None, "signing_key_file"), (False, None, "router"), (True, 20.0, "router"), (True, 0.4, "")],
)
def test_signing_is_blamed_only_where_nothing_was_answered(
    signs: bool, answered_ago_s: float | None, names: str
) -> None:
    advice = no_answer_advice(
        signs=signs, has_key=False, only_heartbeats=False, answered_ago_s=answered_ago_s
    )
    assert names in advice
    assert bool(advice) is bool(names)
    assert ("signing_key_file" in advice) is (names == "signing_key_file")
