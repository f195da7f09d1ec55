"""H.264 for players that want it, where GStreamer is: a child on the system's Python serves it."""

from __future__ import annotations

import asyncio
import json
import shutil
import time
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import Callable, Iterable
from contextlib import AsyncExitStack, suppress
from urllib.parse import quote

from companion.ground_station import h264_child
from companion.host.child_process import supervised

SYSTEM_PYTHON = "/usr/bin/python3"
"""Debian's gi is built for it alone."""
UNTAKEN_S = 10.0
"""A child that takes no image for this long is killed, and started again."""
# A longer time between two images counts as this: the process may have been stopped, and has written nothing.
_LONGEST_GAP_S = 1.0
_NAME = "H.264"
_END_S = 1.0  # it has nothing to finish, and the end of this process must not wait for it


class H264Server:
    """Serves streams to players until closed, as `VideoServer`; without GStreamer it says why not, once.

    Args:
        host, port: that it listens on. streams: their names. token: part of the paths; None: none is needed.
        on_wanted: called with a stream's name when its first player comes, and when the last has gone.
        say: called with a line for the operator.

    Attributes:
        port: once ready. paths: stream: the path of its address. is_ready: the streams can be played.
    """

    def __init__(
        self,
        host: str,
        port: int,
        streams: Iterable[str],
        *,
        token: str | None,
        on_wanted: Callable[[str, bool], None],
        say: Callable[[str], None],
        python: str = SYSTEM_PYTHON,
    ) -> None:
        end = "" if token is None else f"/{quote(token, safe='')}"
        self.paths = {stream: f"/{stream}{end}" for stream in streams}
        self.host, self.port = host, port
        self._on_wanted, self._say, self._python = on_wanted, say, python
        self.is_ready = False
        self._wanted: set[str] = set()
        self._pushed_s = self._untaken_s = 0.0
        self._process: Process | None = None
        self._stack = AsyncExitStack()

    async def start(self) -> None:
        """Start the child, which is started again after a crash."""
        if shutil.which(self._python) is None:
            self._say(f"no H.264: no {self._python}")
            return
        await self._stack.enter_async_context(
            supervised(_NAME, self._start, self._on_line, on_end=self._on_end, end_s=_END_S)
        )

    async def close(self) -> None:
        """End the child."""
        await self._stack.aclose()

    def push(self, stream: str, jpeg: bytes, _stamp_ns: int) -> None:
        """Send an image to the stream's players; dropped while the child has not taken the one before."""
        if stream not in self._wanted or (process := self._process) is None:
            return
        assert process.stdin is not None
        now_s = time.monotonic()
        gap_s, self._pushed_s = now_s - self._pushed_s, now_s
        if not process.stdin.transport.get_write_buffer_size():
            self._untaken_s = 0.0
            number = list(self.paths).index(stream)
            process.stdin.write(h264_child.HEADER.pack(number, len(jpeg)) + jpeg)
            return
        self._untaken_s += min(gap_s, _LONGEST_GAP_S)
        if self._untaken_s > UNTAKEN_S:
            self._say(f"{_NAME}: no sign of life for {UNTAKEN_S:g} s")
            self._process = None  # once
            with suppress(ProcessLookupError):
                process.kill()

    async def _start(self) -> tuple[Process, Callable[[], None]]:
        process = await asyncio.create_subprocess_exec(
            *(self._python, "-I", h264_child.__file__),
            stdin=PIPE,
            stdout=PIPE,
            stderr=DEVNULL,  # encoders write there about nothing; the child prints its own errors
            process_group=0,  # Ctrl-C is for the parent
        )
        assert process.stdin is not None
        options = {"host": self.host, "port": self.port, "paths": self.paths}
        process.stdin.write(json.dumps(options).encode() + b"\n")  # not an argument: others can read those
        self._process, self._untaken_s = process, 0.0
        return process, process.stdin.close

    def _on_line(self, line: str) -> None:
        kind, *words = line.removeprefix(f"{_NAME}: ").split(" ")
        if kind == "ready":
            self.port = int(words[0])
            self.is_ready = True
        elif kind == "wanted":
            self._set_wanted(words[0], words[1] == "1")
        else:
            self._say(line)

    def _on_end(self, _why: str, _again: bool) -> None:
        self.is_ready = False
        for stream in list(self._wanted):
            self._set_wanted(stream, False)

    def _set_wanted(self, stream: str, wanted: bool) -> None:
        (self._wanted.add if wanted else self._wanted.discard)(stream)
        self._on_wanted(stream, wanted)
