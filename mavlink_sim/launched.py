"""`mavlink-sim` in a process of its own: forked by this program's launcher; started, where that cannot be."""

from __future__ import annotations

import atexit
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from typing import TextIO

from mavlink_sim.launcher import ENDED, STARTED, Request

LAUNCHER_ENDS_S = 5.0


class LaunchedProcess:
    """A process that the launcher has forked, as `subprocess.Popen` is one that was started.

    Attributes:
        stdin, stdout: the other ends of its standard input and output; standard error goes where output goes.
        returncode: its exit code, or less than nothing the signal that ended it; None until that is known.
    """

    def __init__(
        self, pid: int, descriptor: int, answers: socket.socket, stdin: TextIO, stdout: TextIO
    ) -> None:
        self.pid = pid
        self.stdin, self.stdout = stdin, stdout
        self.returncode: int | None = None
        self._descriptor = descriptor
        self._answers = answers

    def poll(self) -> int | None:
        """The exit code; None while it runs."""
        return self._code_within(0.0)

    def wait(self, timeout: float | None = None) -> int:
        """The exit code, once it has ended.

        Raises:
            subprocess.TimeoutExpired: it runs on after `timeout` seconds.
            ChildProcessError: the launcher has ended before it, and nobody knows.
        """
        code = self._code_within(timeout)
        if code is None:
            assert timeout is not None
            raise subprocess.TimeoutExpired("mavlink-sim", timeout)
        return code

    def _code_within(self, timeout_s: float | None) -> int | None:
        if self.returncode is None and _readable(self._answers.fileno(), timeout_s):
            # It stays there to be read: another thread may be waiting for it too.
            answer = self._answers.recv(ENDED.size, socket.MSG_PEEK)
            if answer:
                self.returncode = ENDED.unpack(answer)[0]
            elif _readable(self._descriptor, timeout_s):
                raise ChildProcessError(
                    f"mavlink-sim (process {self.pid}) has ended; how, only its launcher knew, which is gone"
                )
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Nothing if it has ended."""
        if self.returncode is None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._descriptor, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def __enter__(self) -> LaunchedProcess:
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the pipes, and wait for its end."""
        self.stdout.close()
        with suppress(BrokenPipeError):
            self.stdin.close()
        try:
            self.wait()
        finally:
            os.close(self._descriptor)
            self._answers.close()


def _readable(descriptor: int, timeout_s: float | None) -> bool:
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return bool(poll.poll(None if timeout_s is None else timeout_s * 1e3))


class _Launcher:
    """A launcher of this process, with Python set up as the environment says now."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._made_for = _surroundings()
        self._requests, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "mavlink_sim.launcher", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )

    @property
    def serves(self) -> bool:
        return self._made_for == _surroundings() and self._process.poll() is None

    def start(self, arguments: Sequence[str]) -> LaunchedProcess:
        """A new process with these arguments of `mavlink-sim`, in this one's folder and environment."""
        request = Request(list(arguments), os.getcwd(), dict(os.environ))
        their_input, our_input = os.pipe()
        our_output, their_output = os.pipe()
        with ExitStack() as ours:
            stdin = ours.enter_context(open(our_input, "w"))
            stdout = ours.enter_context(open(our_output))
            answers, theirs = socket.socketpair()
            ours.enter_context(answers)
            try:
                with theirs, self._lock:
                    request.send(self._requests, [their_input, their_output, theirs.fileno()])
            finally:
                os.close(their_input)
                os.close(their_output)
            answer, descriptors, _, _ = socket.recv_fds(answers, STARTED.size, 1)
            if not answer:
                raise OSError(f"the launcher of mavlink-sim ended with code {self._process.wait()}")
            pid: int = STARTED.unpack(answer)[0]
            if pid < 0:
                raise OSError(-pid, f"a process for mavlink-sim cannot be forked: {os.strerror(-pid)}")
            ours.pop_all()
        return LaunchedProcess(pid, descriptors[0], answers, stdin, stdout)

    def close(self) -> None:
        """Let it end, and what it has forked."""
        self._requests.close()
        if self._made_for[0] == os.getpid():
            self._process.wait(LAUNCHER_ENDS_S)


def _surroundings() -> tuple[object, ...]:
    """What a launcher has taken with it when it started."""
    python = {name: value for name, value in os.environ.items() if name.startswith("PYTHON")}
    return os.getpid(), sys.executable, python


_launchers: list[_Launcher] = []  # the newest last; one that is not asked any more may have vehicles that fly
_choosing = threading.Lock()


def _close_launchers() -> None:
    for launcher in _launchers:
        launcher.close()


def _launcher() -> _Launcher:
    with _choosing:
        if not _launchers:
            atexit.register(_close_launchers)
        if not _launchers or not _launchers[-1].serves:
            _launchers.append(_Launcher())
        return _launchers[-1]


def _can_launch() -> bool:
    try:
        os.close(os.pidfd_open(os.getpid()))
    except (AttributeError, OSError):  # no Linux, an old one, or one that keeps it to itself
        return False
    return True


def launched(arguments: Sequence[str]) -> LaunchedProcess | subprocess.Popen[str]:
    """Start `mavlink-sim` with these arguments; its standard input and output are text pipes."""
    if _can_launch():
        return _launcher().start(arguments)
    return subprocess.Popen(
        [sys.executable, "-m", "mavlink_sim", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
