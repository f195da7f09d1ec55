"""A command that goes on until it is ended: wrong settings are exit code 2, what may pass is 75; one line."""

from __future__ import annotations

import json
import os
import shlex
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from companion.host.passing import EXIT_PASSING
from mavlink_sim.testing import free_port
from tests.companion.command_line import COLUMNS, companion, companion_here

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


# Each command has a process of its own, which this one forks: the modules are imported once.
FORKS = """
import json, os, sys
import companion.cli.config_check, companion.service, companion.simulation.play
from companion import cli
for line in sys.stdin:
    arguments, folder = json.loads(line)
    child = os.fork()
    if child == 0:
        os.chdir(folder)
        for number, name in enumerate((os.devnull, "stdout", "stderr")):
            os.dup2(os.open(name, os.O_RDWR | os.O_CREAT), number)
        sys.argv = ["companion", *arguments]
        cli.main()
        sys.exit()
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@pytest.fixture(scope="module")
def companion_forked() -> Iterator[Callable[[list[str], Path], subprocess.CompletedProcess[str]]]:
    kept = {key: value for key, value in os.environ.items() if not key.startswith("COMPANION_")}
    forking = subprocess.Popen(
        [sys.executable, "-c", FORKS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=kept | COLUMNS
    )
    assert forking.stdin is not None
    assert forking.stdout is not None
    given, codes = forking.stdin, forking.stdout

    def run(arguments: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
        given.write(json.dumps([arguments, str(folder)]).encode() + b"\n")
        given.flush()
        code = int(codes.readline())
        return subprocess.CompletedProcess(
            arguments, code, (folder / "stdout").read_text(), (folder / "stderr").read_text()
        )

    try:
        yield run
    finally:
        forking.kill()
        forking.communicate()


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
    ("run --source no.mp4 --detector-enabled false --vehicle-url none {free}", WRONG, "no.mp4"),
    *(
        (f"run --source none {flag} {value} {{free}}", WRONG, value)
        for flag, value in (
            ("--vehicle-url", "serial:///dev/ttyS0:12345"),
            ("--vehicle-signing-key-file", "no.key"),
            ("--plugins-modules", "no_such_plugin"),
            ("--zenoh-config-file", "no.json5"),
        )
    ),
]


@pytest.mark.parametrize(("command", "code", "named"), CASES)
def test_passing_failure_and_wrong_settings_differ(
    command: str,
    code: int,
    named: str,
    ports: Ports,
    companion_forked: Callable[[list[str], Path], subprocess.CompletedProcess[str]],
    tmp_path: Path,
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
    arguments = command.format(**words).split()
    if command.startswith(AT_ONCE):
        done = companion_here(*arguments, cwd=tmp_path)
    else:
        done = companion_forked(arguments, tmp_path)
    assert done.returncode == code, done.stderr
    assert done.stdout == "" or arguments[0] != "run"
    lines = done.stderr.splitlines()
    assert [line for line in lines if line.startswith("companion: ")] == lines[-1:]
    assert named.format(**words) in lines[-1]
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("words", ["init", "signing send --key-file key"])
def test_closed_stream_is_no_terminal(words: str, tmp_path: Path) -> None:
    companion("signing", "new", "key", cwd=tmp_path)
    program = f"exec {shlex.quote(sys.executable)} -m companion.cli {words} <&-"
    done = subprocess.run(
        ["sh", "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode in (1, 2)
    assert "Traceback" not in done.stderr
    assert done.stderr.startswith("companion: ")


def test_closed_standard_input_is_a_wrong_setting(tmp_path: Path) -> None:
    """It can never be opened again."""
    command = f'exec "{sys.executable}" -m companion.cli run --source - --vehicle-url none <&-'
    done = subprocess.run(
        ["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == WRONG
    assert "input is closed" in done.stderr
