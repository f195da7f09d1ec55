"""The chat of a console: `companion ask` as a real process, at a stand-in of the service."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest

from companion.bench.lockstep_flight import plain_settings
from companion.host.scheduling import DEFAULT_NS, SHORTEST_NS, set_scheduler_slice
from companion.language.process import NICENESS, AskProcess
from tests.companion.cli.test_ask import Service, service
from tests.companion.simulation.test_play import descendants
from tests.companion.vehicle.thread_slice import slice_of

pytestmark = pytest.mark.realtime


class Talk:
    """The console's side."""

    def __init__(self, there: Service, **changes: str) -> None:
        given = {key.replace("__", "."): value for key, value in changes.items()}
        self.process = AskProcess(
            plain_settings({"vehicle.name": "vehicle", "zenoh.listen": there.endpoint, **given})
        )
        self._printed = ""

    async def send(self, line: str) -> None:
        await self.process.send(line, self._write)

    async def shown(self, text: str) -> str:
        """Wait until a text is printed; returns everything printed until then."""
        async with asyncio.timeout(60):
            while text not in self._printed:
                await asyncio.sleep(0.01)
        printed, self._printed = self._printed, ""
        return printed

    def _write(self, piece: str) -> None:
        self._printed += piece


@asynccontextmanager
async def talking(**changes: str) -> AsyncIterator[tuple[Service, Talk]]:
    async with service() as there:
        talk = Talk(there, **changes)
        try:
            yield there, talk
        finally:
            await talk.process.close()
            assert not talk.process.running


async def test_plan_is_confirmed_history_is_used_and_cancel_ends_it() -> None:
    before = set(descendants(os.getpid()))  # multiprocessing's resource tracker
    async with talking() as (there, talk):
        there.stopped.set()
        set_scheduler_slice()  # as the service's loop
        await talk.send("circle the red car at ten metres")
        assert "orbit radius=10 track=3" in await talk.shown("[y/N] \n")
        (child,) = set(descendants(os.getpid())) - before
        own = os.getpriority(os.PRIO_PROCESS, 0)
        assert os.getpriority(os.PRIO_PROCESS, child) == min(own + NICENESS, 19)
        assert slice_of(child) != SHORTEST_NS
        set_scheduler_slice(DEFAULT_NS)
        await talk.send("y")
        await talk.shown("done: orbit: ended")
        await talk.send("twice as far")
        assert "orbit radius=20 track=3" in await talk.shown("[y/N] \n")
        await talk.send("cancel")
        await talk.send("y")  # the plan has ended
        await talk.shown("not understood")
        assert there.commands == ["orbit radius=10 track=3"]


async def test_settings_of_the_service_apply_and_it_starts_again() -> None:
    async with talking(language__may="orbit") as (there, talk):
        there.stopped.set()
        for _ in range(2):
            await talk.send("circle the red car")
            await talk.shown("done: orbit: ended")
            await talk.send("quit")
            async with asyncio.timeout(30):
                while talk.process.running:
                    await asyncio.sleep(0.01)
        assert there.commands == ["orbit track=3"] * 2


def kill(pid: int) -> None:
    """Kill a process and wait for its end, without letting the loop notice it."""
    os.kill(pid, signal.SIGKILL)
    with suppress(OSError):  # reaped by a thread
        while "State:\tZ" not in Path(f"/proc/{pid}/status").read_text():
            time.sleep(0.001)


async def test_line_to_an_ended_process_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    echo = tmp_path / "echo"
    echo.write_text("#!/bin/sh\nexec cat\n")
    echo.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(echo))
    process, printed = AskProcess(plain_settings({})), asyncio.Event()
    before = set(descendants(os.getpid()))
    try:
        await process.send("hold", lambda _: printed.set())
        await asyncio.wait_for(printed.wait(), 20)
        (child,) = set(descendants(os.getpid())) - before
        kill(child)
        with pytest.raises(BrokenPipeError, match="'y'"):
            await process.send("y", lambda _: None)
    finally:
        await process.close()
