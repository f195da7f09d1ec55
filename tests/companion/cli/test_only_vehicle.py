"""Which vehicle a client command is for where no name was given."""

from __future__ import annotations

import json
import signal
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from subprocess import PIPE, Popen, TimeoutExpired

import pytest
import zenoh

from companion.bus.session import zenoh_config
from companion.bus.topics import command_key
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port
from tests.companion.command_line import companion_here
from tests.companion.dashboard.serving import EventStream, dashboard_command
from tests.companion.dashboard.test_bridge import publishing

pytestmark = pytest.mark.realtime


@contextmanager
def services(*names: str) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """A node, and services of vehicles connected to it; yields its endpoint, and what they were sent."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    received: list[tuple[str, str]] = []

    def answer(query: zenoh.Query) -> None:
        assert query.payload is not None
        received.append((str(query.key_expr).split("/")[1], query.payload.to_string()))
        with query:
            query.reply(query.key_expr, json.dumps({"command": "", "success": True, "reason": "done"}))

    with ExitStack() as stack:
        for number, name in enumerate(names):
            other = (None, name, endpoint) if number else (endpoint, name, None)
            service, _ = stack.enter_context(publishing(*other))
            service.session.declare_queryable(command_key(name), answer)
        yield endpoint, received


@pytest.mark.parametrize("words", [("send", "hold"), ("ask", "stop")])
def test_command_reaches_the_only_vehicle_and_names_it(words: tuple[str, str], tmp_path: Path) -> None:
    with services("hawk") as (endpoint, received):
        done = companion_here(*words, "--connect", endpoint, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert received == [("hawk", words[1])]
    assert "'hawk'" in done.stderr


def test_vehicle_of_the_default_name_is_not_announced(tmp_path: Path) -> None:
    with services("vehicle1") as (endpoint, received):
        done = companion_here("send", "hold", "--connect", endpoint, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert received == [("vehicle1", "hold")]


@pytest.mark.parametrize(
    "words", [("send", "hold"), ("ask", "stop"), ("mcp",), ("log", "record", "recordings")]
)
def test_of_several_vehicles_one_must_be_named(words: tuple[str, ...], tmp_path: Path) -> None:
    if words[0] == "mcp":
        pytest.importorskip("mcp")
    with services("vehicle1", "hawk") as (endpoint, received):
        done = companion_here(*words, "--connect", endpoint, cwd=tmp_path)  # before it serves or records
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "hawk, vehicle1" in line
    assert "--vehicle-name" in line
    assert received == []


@pytest.mark.parametrize("layer", ["flag", "file"])
def test_given_name_is_never_replaced(layer: str, tmp_path: Path) -> None:
    (tmp_path / "companion.toml").write_text('[vehicle]\nname = "vehicle1"\n' if layer == "file" else "")
    flag = ("--vehicle-name", "vehicle1") if layer == "flag" else ("--config", "companion.toml")
    with services("hawk") as (endpoint, received):
        done = companion_here("send", "hold", "--connect", endpoint, *flag, cwd=tmp_path)
    assert done.returncode == 2
    assert "'vehicle1'" in done.stderr
    assert received == []


@pytest.mark.parametrize("words", [("send", "hold"), ("ask", "stop")])
def test_given_name_chooses_among_several(words: tuple[str, str], tmp_path: Path) -> None:
    with services("hawk", "vehicle1") as (endpoint, received):
        done = companion_here(*words, "--connect", endpoint, "--vehicle-name", "vehicle1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert received == [("vehicle1", words[1])]


@pytest.mark.parametrize(
    ("key", "flags", "names"),
    [
        ("labels", ("--vehicle-name", "hawk"), {"hawk"}),
        ("labels", (), {"hawk", "owl"}),
        ("companion/owl/labels", ("--vehicle-name", "hawk"), {"owl"}),
    ],
)
def test_echo_prints_the_messages_of_a_given_vehicle(
    key: str, flags: tuple[str, ...], names: set[str], tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "companion.cli", "echo", key, "--limit", "6", *flags, "--connect"]
    with (
        publishing(name="owl") as (node, endpoint),
        Popen([*command, endpoint], cwd=tmp_path, stdout=PIPE, text=True) as process,
    ):
        try:
            until_s = time.monotonic() + 30.0
            while process.poll() is None and time.monotonic() < until_s:
                for name in ("hawk", "owl"):
                    node.publish(f"companion/{name}/labels", "none")
                with suppress(TimeoutExpired):
                    process.wait(0.02)
        finally:
            process.kill()
        printed, _ = process.communicate()
    assert {line.split("/")[1] for line in printed.splitlines()} == names


def test_without_a_vehicle_the_default_name_is_missed(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    with zenoh.open(zenoh_config(ZenohSection(listen=(endpoint,)))):
        done = companion_here("send", "hold", "--connect", endpoint, cwd=tmp_path)
    assert done.returncode == 2
    assert "'vehicle1'" in done.stderr
    assert "vehicle.name" in done.stderr


async def test_page_opens_with_the_only_vehicle(tmp_path: Path) -> None:
    with services("hawk") as (endpoint, _), dashboard_command(endpoint, tmp_path) as address:
        stream = await EventStream.open(int(address.rstrip("/").rpartition(":")[2]))
        news = await stream.next()
        stream.close()
    assert news is not None
    assert news["vehicle_name"] == "hawk"


def test_recorder_records_the_only_vehicle(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    with services("hawk") as (endpoint, _):
        command = [
            sys.executable,
            "-m",
            "companion.cli",
            "log",
            "record",
            "recordings",
            "--connect",
            endpoint,
        ]
        with Popen(command, cwd=tmp_path, stderr=PIPE, text=True) as process:
            try:
                assert process.stderr is not None
                assert "'hawk'" in process.stderr.readline()
                assert "recordings/hawk_" in process.stderr.readline()
                process.send_signal(signal.SIGINT)
                process.communicate(timeout=20)
            finally:
                process.kill()
    assert process.returncode == 0
