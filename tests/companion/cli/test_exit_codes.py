"""A command that goes on until it is ended: wrong settings are exit code 2, what may pass is 75; one line."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from companion.host.passing import EXIT_PASSING
from mavlink_sim.testing import free_port
from tests.companion.command_line import companion, companion_here

pytestmark = pytest.mark.realtime

WRONG = 2


@dataclass(frozen=True)
class Ports:
    """Ports of loopback in use, and free ones."""

    tcp: int
    udp: int
    free: int


@pytest.fixture(scope="module")
def ports() -> Iterator[Ports]:
    with ExitStack() as stack:
        taken = []
        for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
            endpoint = stack.enter_context(socket.socket(socket.AF_INET, kind))
            endpoint.bind(("127.0.0.1", 0))
            taken.append(endpoint)
        taken[0].listen()
        tcp, udp = (endpoint.getsockname()[1] for endpoint in taken)
        yield Ports(tcp, udp, free_port(socket.SOCK_STREAM))


# Refused before the command changes its process: in this one.
AT_ONCE = ("view village.png", "view --dashboard-listen nonsense")
# Command line, exit code, and what its last line names.
CASES = [
    ("run --source none --zenoh-listen tcp/127.0.0.1:{tcp}", EXIT_PASSING, "{tcp}"),
    ("run --source none --metrics-listen 127.0.0.1:{tcp} {free}", EXIT_PASSING, "{tcp}"),
    ("view village.png --zenoh-listen tcp/127.0.0.1:{tcp}", WRONG, "village.png"),
    ("view {here} --zenoh-listen tcp/127.0.0.1:{tcp}", EXIT_PASSING, "{tcp}"),
    ("play --zenoh-listen tcp/127.0.0.1:{tcp}", EXIT_PASSING, "{tcp}"),
    ("play --metrics-listen 127.0.0.1:{tcp} {free}", EXIT_PASSING, "{tcp}"),
    ("play --vehicle-url udpin://127.0.0.1:{udp} {free}", EXIT_PASSING, "{udp}"),
    ("play --vehicle-url tcp://127.0.0.1:{udp} {free}", WRONG, "udpin"),
    ("play --scene nowhere {free}", WRONG, "nowhere"),
    ("play --detector-model nothing.pt {free}", WRONG, "nothing.pt"),
    ("demo --vehicle-url udpin://127.0.0.1:{udp}", EXIT_PASSING, "{udp}"),
    ("demo --vehicle-url serial:///dev/ttyACM0:57600", WRONG, "udpin"),
    ("view --dashboard-listen 127.0.0.1:{tcp}", EXIT_PASSING, "{tcp}"),
    ("view --dashboard-listen nonsense", WRONG, "HOST:PORT"),
    ("run --source - --detector-kind none-such {free}", WRONG, "none-such"),
]


@pytest.mark.parametrize(("command", "code", "named"), CASES)
def test_passing_failure_and_wrong_settings_differ(
    command: str, code: int, named: str, ports: Ports, tmp_path: Path
) -> None:
    if "metrics" in command:
        pytest.importorskip("prometheus_client", reason="prometheus_client is an optional extra")
    (tmp_path / "photos").mkdir()
    words = {
        "tcp": ports.tcp,
        "udp": ports.udp,
        "here": tmp_path / "photos",
        "free": f"--zenoh-listen tcp/127.0.0.1:{ports.free} --dashboard-listen=",
    }
    run = companion_here if command.startswith(AT_ONCE) else companion
    done = run(*command.format(**words).split(), cwd=tmp_path)
    assert done.returncode == code, done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("companion: ")
    assert named.format(**words) in last
    assert "Traceback" not in done.stderr


def test_closed_standard_input_is_a_wrong_setting(tmp_path: Path) -> None:
    """It can never be opened again."""
    command = f'exec "{sys.executable}" -m companion.cli run --source - --vehicle-url none <&-'
    done = subprocess.run(
        ["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == WRONG
    assert "input is closed" in done.stderr
