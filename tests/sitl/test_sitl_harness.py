"""The harness of the tests against an autopilot, without one."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from companion.vehicle.link_url import parse_link_url
from mavlink_sim.testing import free_port
from mavlink_sim.wire.messages import dialect
from tests.sitl import sitl_harness
from tests.sitl.sitl_harness import HOLD, PX4, AutopilotLink

pytestmark = pytest.mark.realtime
TAKEOFF = 4 << 16 | 2 << 24


@pytest.fixture
def link() -> Iterator[AutopilotLink]:
    opened = AutopilotLink(parse_link_url(f"udpin://127.0.0.1:{free_port()}"))
    yield opened
    opened.close()


class Sender:
    """Heartbeats of a PX4 with system id 1, from an address of its own."""

    def __init__(self, link: AutopilotLink) -> None:
        self._codec = dialect.MAVLink(None, 1, 1)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(link.address)
        self.address = self._socket.getsockname()

    def heartbeat(self, custom_mode: int) -> None:
        message = dialect.MAVLink_heartbeat_message(2, PX4, 1, custom_mode, 3, 3)
        self._socket.send(bytes(message.pack(self._codec)))

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
