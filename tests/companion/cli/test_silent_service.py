"""What the commands say of a service that is there and silent."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path
from typing import Any

import pytest

from companion.bus import topics
from companion.bus.session import Bus
from companion.cli import client
from companion.cli.flags import say_silent
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port
from tests.companion.command_line import companion_here

pytestmark = pytest.mark.realtime

SILENT_S = 0.2


@pytest.mark.parametrize("words", [("send", "orbit"), ("send", "--file", "demo")])
async def test_command_says_once_that_the_service_is_silent(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.bus.client.SILENT_S", SILENT_S)
    said: list[str] = []
    silence_is_said = asyncio.Event()
    loop = asyncio.get_running_loop()

    def say(text: str) -> None:
        said.append(text)
        loop.call_soon_threadsafe(silence_is_said.set)
        say_silent(text)

    monkeypatch.setattr(client, "say_silent", say)

    async def answer_late(_text: str) -> dict[str, Any]:
        await silence_is_said.wait()
        return {"success": True, "reason": "flown"}

    settings = ZenohSection(listen=(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",))
    bus = Bus(settings, "vehicle1", on_event=lambda *_: None, on_command=answer_late)
    await bus.start()
    try:
        bus.publish(topics.STATUS, {"vehicle": {"without_service": "PX4 holds its position"}})
        command = (words[0], "--connect", settings.listen[0], *words[1:])
        done = await asyncio.to_thread(companion_here, *command, cwd=tmp_path)
    finally:
        await bus.close()
    assert done.returncode == 0, done.stderr
    assert len(said) == 1
    assert [line for line in done.stderr.splitlines() if "PX4" in line] == [f"companion: {said[0]}"]
    assert done.stdout.splitlines()[-1] == "done: flown"
