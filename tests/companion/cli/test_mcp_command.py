"""`companion mcp` by the SDK's own client: standard input and output, HTTP, bad input, a simulated flight."""

from __future__ import annotations

import asyncio
import os
import socket
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from companion.bench.lockstep_flight import plain_settings
from companion.cli import app
from companion.cli.mcp import _access, _serve
from mavlink_sim.testing import free_port, running_simulator
from tests.companion.cli.test_ask import service, shown
from tests.companion.service_process import TWICE, running_service

TOKEN = "0123456789abcdef0123456789abcdef"


def process(endpoint: str, vehicle: str, *flags: str) -> Any:
    """The server, and its client, which starts it."""
    # The SDK is imported by the functions that need it: it takes a second of every worker's collection.
    from mcp.client import Client
    from mcp.client.stdio import StdioServerParameters, stdio_client

    arguments = ["-m", "companion.cli", "mcp", "--connect", endpoint, "--vehicle-name", vehicle, *flags]
    environment = {"PYTHONPATH": os.pathsep.join(sys.path)}
    server = StdioServerParameters(command=sys.executable, args=arguments, env=environment)
    # by default the standard error of the first import, which may be that of a test's CliRunner
    return Client(stdio_client(server, errlog=sys.stderr))


@pytest.fixture
def token_file(tmp_path: Path) -> Path:
    path = tmp_path / "token"
    path.write_text(TOKEN)
    path.chmod(0o600)
    return path


async def test_process_answers_and_ends_what_it_flies_with_its_client() -> None:
    async with service() as there:
        async with process(there.endpoint, "vehicle", "--allow", "orbit") as client:
            names = [tool.name for tool in (await client.list_tools()).tools]
            assert {"seen", "orbit", "land"} <= set(names)
            seen = (await client.call_tool("seen", {})).structured_content["objects"]
            assert [(each["class_name"], each["colour"]) for each in seen] == [
                ("car", "red"),
                ("car", "blue"),
            ]
            refused = await client.call_tool("land", {})
            assert (refused.is_error, refused.structured_content["success"]) == (True, False)
            flying = asyncio.create_task(client.call_tool("orbit", {"track": 3}))
            await asyncio.wait_for(there.flying.wait(), 20)
            assert there.commands == ["orbit track=3"]
        await asyncio.wait_for(there.stopped.wait(), 20)
        await asyncio.gather(flying, return_exceptions=True)
        assert set(there.commands) == {"orbit track=3", "stop"}


@pytest.mark.parametrize("mode", ["auto", "legacy"])
async def test_http_serves_programs_with_the_token(
    mode: str, token_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import httpx2
    from mcp.client import Client
    from mcp.client.streamable_http import streamable_http_client

    listen = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    url = f"http://{listen}/mcp"
    async with service() as there:
        settings = plain_settings({"vehicle.name": "vehicle", "zenoh.connect": there.endpoint})
        serving = asyncio.create_task(_serve(settings, ["takeoff"], listen, _access(listen, token_file)))
        await shown(url, capsys)
        bearer = {"authorization": f"Bearer {TOKEN}"}
        async with httpx2.AsyncClient() as http:
            for headers, status in (
                ({}, 401),
                ({"authorization": f"Bearer {TOKEN}x"}, 401),
                (bearer | {"origin": "http://evil.example"}, 403),
                (bearer | {"host": "evil.example"}, 403),
                (bearer | {"sec-fetch-site": "cross-site"}, 403),
            ):
                assert (await http.post(url, json={}, headers=headers)).status_code == status
        async with (
            httpx2.AsyncClient(headers=bearer) as http,
            Client(streamable_http_client(url, http_client=http), mode=mode) as client,
        ):
            reply = await client.call_tool("takeoff", {"altitude": 5})
            assert (reply.is_error, reply.structured_content["command"]) == (False, "takeoff altitude=5")
            assert (await client.call_tool("land", {})).is_error
        assert there.commands == ["takeoff altitude=5"]
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--allow", "fly"), "--allow: unknown command 'fly'"),
        (("--allow", "takeoff,mission"), "mission"),
        (("--listen", "127.0.0.1:8089"), "--token-file"),
        (("--listen", "0.0.0.0:8089", "--token-file", "token"), "of this computer"),
        (("--listen", "8089", "--token-file", "token"), "HOST:PORT"),
        (("--listen", "127.0.0.1:8089", "--token-file", "missing"), "--token-file missing"),
        ((), "companion run"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    flags: tuple[str, ...], words: str, token_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(token_file.parent)
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    result = CliRunner().invoke(app, ["mcp", "--connect", endpoint, *flags])
    assert result.exit_code == 2
    assert len(result.stderr.strip().splitlines()) == 1
    assert words in result.stderr


def test_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mcp.server", None)
    result = CliRunner().invoke(app, ["mcp"])
    assert result.exit_code == 2
    assert "[language]" in result.stderr


@pytest.mark.realtime
async def test_simulated_vehicle_is_left_to_its_pilot(tmp_path: Path) -> None:
    with (
        running_simulator(**TWICE) as simulator,
        running_service(simulator.onboard_port, ["--source", "none"], cwd=tmp_path) as flown,
    ):
        allowed = ("--allow", "takeoff,goto,orbit")
        async with process(flown.endpoint, "vehicle1", *allowed) as client:

            async def call(name: str, **arguments: Any) -> dict[str, Any]:
                content: dict[str, Any] = (await client.call_tool(name, arguments)).structured_content
                return content

            until_s = time.monotonic() + 20.0
            while not (reply := await call("takeoff", altitude=3))["success"] and time.monotonic() < until_s:
                assert " needs " in reply["reason"]  # an estimate that is not there yet
            assert reply["success"], reply
            assert (await call("state"))["height_above_home_m"] > 2.0
            again = (await call("takeoff", altitude=3))["reason"]
            assert again.startswith("takeoff needs ")
            assert "the ground" in again
            going = asyncio.create_task(call("goto", forward=90, right=0))
            async with asyncio.timeout(20):
                while not (await call("state"))["in_command"]:
                    await asyncio.sleep(0.1)
            assert (await call("stop"))["success"] is True
            assert (await going)["success"] is False
            async with asyncio.timeout(20):
                while (await call("state"))["in_command"]:
                    await asyncio.sleep(0.1)
            assert "--allow stop" in (await call("stop"))["reason"]
            # An endless one is answered when it is flown.
            assert (await call("orbit"))["success"] is True
            assert (await call("stop"))["success"] is True
            assert (await call("orbit"))["success"] is True
            simulator.fault("pilot_takeover mode=POSCTL")
            async with asyncio.timeout(20):
                while (await call("state"))["mode"] != "position":
                    await asyncio.sleep(0.1)
            assert "pilot took" in (await call("orbit"))["reason"]
            assert (await call("stop"))["success"] is False
            assert (await call("state"))["mode"] == "position"
            operator = asyncio.to_thread(flown.command, "hold")
            assert (await operator)["success"] is True
            assert (await call("stop"))["success"] is False
            assert (await call("orbit"))["success"] is True
