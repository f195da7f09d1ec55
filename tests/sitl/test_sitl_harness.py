"""The harness of the tests against an autopilot, without one."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from companion.vehicle.link_url import parse_link_url
from mavlink_sim.testing import free_port
from mavlink_sim.wire.messages import dialect
from tests.sitl import sitl_harness
from tests.sitl.sitl_harness import ARDUPILOT, HOLD, PX4, AutopilotLink, needs_px4

pytestmark = pytest.mark.realtime
TAKEOFF = 4 << 16 | 2 << 24


@pytest.fixture
def link() -> Iterator[AutopilotLink]:
    opened = AutopilotLink(parse_link_url(f"udpin://127.0.0.1:{free_port()}"))
    yield opened
    opened.close()


def heartbeat(custom_mode: int) -> bytes:
    """Of a PX4 with system id 1."""
    message = dialect.MAVLink_heartbeat_message(2, PX4, 1, custom_mode, 3, 3)
    return bytes(message.pack(dialect.MAVLink(None, 1, 1)))


def version(number: int) -> bytes:
    """AUTOPILOT_VERSION of a PX4."""
    zeros = [0] * 8
    message = dialect.MAVLink_autopilot_version_message(0, number, 0, 0, 0, zeros, zeros, zeros, 0, 0, 0)
    return bytes(message.pack(dialect.MAVLink(None, 1, 1)))


class Sender:
    """Sends heartbeats from an address of its own."""

    def __init__(self, link: AutopilotLink) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(link.address)
        self.address = self._socket.getsockname()

    def heartbeat(self, custom_mode: int) -> None:
        self._socket.send(heartbeat(custom_mode))

    def version(self, number: int) -> None:
        self._socket.send(version(number))

    def receive(self) -> bytes:
        """The next datagram from the link."""
        self._socket.settimeout(5.0)
        return self._socket.recv(1000)

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def senders(link: AutopilotLink) -> Iterator[tuple[Sender, Sender]]:
    first, second = Sender(link), Sender(link)
    yield first, second
    first.close()
    second.close()


def test_a_second_autopilot_at_the_port_is_dropped_and_named(
    link: AutopilotLink, senders: tuple[Sender, Sender]
) -> None:
    first, second = senders
    first.heartbeat(HOLD[PX4])
    link.until(lambda: link.modes, 5.0, "a mode")
    second.heartbeat(TAKEOFF)
    link.until(lambda: link.other_senders, 5.0, "another sender")
    assert link.other_senders == {second.address}
    assert [mode for _, mode in link.modes] == [HOLD[PX4]]


def test_a_restarted_autopilot_may_have_another_address(
    link: AutopilotLink, senders: tuple[Sender, Sender], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sitl_harness, "SILENT_S", 0.0)
    first, second = senders
    first.heartbeat(HOLD[PX4])
    link.until(lambda: link.modes, 5.0, "a mode")
    second.heartbeat(TAKEOFF)
    link.until(lambda: len(link.modes) == 2, 5.0, "the second mode")
    assert not link.other_senders


def test_a_tcp_autopilot_that_restarts_is_connected_again() -> None:
    listening = socket.create_server(("127.0.0.1", free_port(socket.SOCK_STREAM)))
    address = listening.getsockname()
    link = AutopilotLink(parse_link_url(f"tcp://127.0.0.1:{address[1]}"))
    try:
        first, _ = listening.accept()
        first.sendall(heartbeat(HOLD[PX4]))
        link.until(lambda: link.modes, 5.0, "a mode")
        listening.close()
        first.close()
        link.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))  # to nobody
        listening = socket.create_server(address)
        listening.settimeout(5.0)
        second, _ = listening.accept()
        second.settimeout(5.0)
        second.sendall(heartbeat(TAKEOFF))
        link.until(lambda: len(link.modes) == 2, 5.0, "the second mode")
        link.set_mode(HOLD[PX4])
        assert second.recv(1000)[7:10] == (76).to_bytes(3, "little")  # COMMAND_LONG
        second.close()
    finally:
        link.close()
        listening.close()


def test_a_deaf_uplink_passes_on_telemetry_alone(link: AutopilotLink, senders: tuple[Sender, Sender]) -> None:
    autopilot, _ = senders
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as service:
        service.bind(("127.0.0.1", link.service_port))
        service.settimeout(5.0)
        link.uplink_deaf = True
        autopilot.heartbeat(HOLD[PX4])
        data, near = service.recvfrom(1000)
        assert data == heartbeat(HOLD[PX4])
        command = dialect.MAVLink_command_long_message(1, 1, 512, 0, 242, 0, 0, 0, 0, 0, 0)
        service.sendto(command.pack(dialect.MAVLink(None, 1, 191)), near)
        link.until(lambda: link.commands, 5.0, "recorded")
        link.uplink_deaf = False
        service.sendto(b"received", near)
        assert autopilot.receive() == b"received"


def test_a_test_is_skipped_for_an_older_px4_with_the_reason(
    link: AutopilotLink, senders: tuple[Sender, Sender]
) -> None:
    sender, _ = senders
    sender.heartbeat(HOLD[PX4])
    link.until(lambda: link.autopilot == PX4, 5.0, "received")
    sender.version(0x010E04FF)
    link.read_version()
    assert (link.version, link.name) == ((1, 14), "PX4 1.14")
    needs_px4(link, (1, 14), "nothing")
    with pytest.raises(pytest.skip.Exception, match=r"PX4 1\.14: signing .*PX4 1\.17"):
        needs_px4(link, (1, 17), "signing")
    link.autopilot = ARDUPILOT
    needs_px4(link, (1, 17), "signing")
