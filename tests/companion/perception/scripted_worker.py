"""A perception worker without a process: what it does is set by the test."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Any, Self

import pytest

from companion.perception.messages import Heartbeat, Message, Ready, StartFailed
from companion.settings import Settings

LOADING_S, HEARTBEAT_S = 2.0, 0.5


class ScriptedWorker:
    """Stands in for `PerceptionProcess`.

    Attributes:
        fails: why a worker cannot start; None: it runs until it is killed. started: all workers so far.
    """

    fails: StartFailed | None = None
    started: list[ScriptedWorker]

    def __init__(self) -> None:
        self.pid = 1000 + len(self.started)
        self.killed = asyncio.Event()
        self.is_ready = False

    @classmethod
    def install(cls, monkeypatch: pytest.MonkeyPatch) -> type[ScriptedWorker]:
        """Let supervisors start workers of a class of its own, which is returned."""
        scripted = type("Scripted", (cls,), {"started": []})
        monkeypatch.setattr("companion.perception.supervisor.PerceptionProcess", scripted)
        return scripted

    @classmethod
    async def spawn(cls, _settings: Settings, *_begin: Any) -> Self:
        worker = cls()
        cls.started.append(worker)
        return worker

    async def read(self) -> Message | None:
        with suppress(TimeoutError):
            async with asyncio.timeout(HEARTBEAT_S if self.is_ready else LOADING_S):
                await self.killed.wait()
            return None
        if self.is_ready:
            return Heartbeat(0)
        if self.fails is not None:
            self.killed.set()
            return self.fails
        self.is_ready = True
        return Ready("scripted", None, (), None)

    def kill(self) -> None:
        self.killed.set()

    terminate = ask_to_stop = kill

    async def wait_ended(self, _timeout_s: float) -> bool:
        return self.killed.is_set()

    async def wait(self) -> str:
        return f"process {self.pid} was killed by SIGKILL"

    def close(self) -> None:
        """Nothing is open."""

    def watch(self, _watched: object) -> None:
        """Nothing is previewed."""
