"""`mavlink-sim` in its own process: forked by this program's launcher, or started without one."""

from __future__ import annotations

import atexit
import errno
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from typing import TextIO

LARGEST_REQUEST = 1 << 17  # less than every socket's buffer
STARTED = struct.Struct("!i")  # the process's id; negative: an errno of the fork
ENDED = struct.Struct("!i")  # the exit code, as in `subprocess`
# Time for vehicles to end after SIGTERM: a camera may take 5 s.
SHUTDOWN_TIMEOUT_S = 7.0
# The time to end its vehicles, with a margin.
LAUNCHER_ENDS_S = SHUTDOWN_TIMEOUT_S + 2.0


@dataclass(frozen=True, slots=True)
class Request:
    """A request for a process.

    Attributes:
        arguments: of `mavlink-sim`.
        folder: to run in.
        environment: all of its environment variables.
    """

    arguments: list[str]
    folder: str
    environment: dict[str, str]

    def send(self, connection: socket.socket, descriptors: list[int]) -> None:
        """Send it; `descriptors` are the standard input, the standard output, and the socket for answers.

        Raises:
            OSError: the launcher is gone, or the request does not fit into a packet (EMSGSIZE).
        """
        packet = json.dumps(asdict(self)).encode()
        if len(packet) > LARGEST_REQUEST:
            raise OSError(
                errno.EMSGSIZE, f"request of {len(packet)} bytes is too long, the limit is {LARGEST_REQUEST}"
            )
        socket.send_fds(connection, [packet], descriptors)


class LaunchedProcess:
    """A process forked by the launcher, with the part of `subprocess.Popen` that tests use.

    Attributes:
        stdin, stdout: pipes to its standard input and output; standard error is merged into output.
        returncode: its exit code, or the negative signal that ended it; None until that is known. If its
            launcher ended first: -SIGTERM, the signal that then ends it.
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
        """
        code = self._code_within(timeout)
        if code is None:
            assert timeout is not None
            raise subprocess.TimeoutExpired("mavlink-sim", timeout)
        return code

    def _code_within(self, timeout_s: float | None) -> int | None:
        until_s = None if timeout_s is None else time.monotonic() + timeout_s
        if self.returncode is None and _readable(self._answers.fileno(), until_s):
            # Not removed: another thread may be waiting for it too.
            answer = self._answers.recv(ENDED.size, socket.MSG_PEEK)
            if answer:
                self.returncode = ENDED.unpack(answer)[0]
            elif _readable(self._descriptor, until_s):
                self.returncode = -signal.SIGTERM
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal; no effect if it has ended."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._descriptor, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def __enter__(self) -> LaunchedProcess:
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the pipes and wait for its end; after an exception kill it first."""
        if exception[0] is not None:
            self.kill()
        with ExitStack() as stack:
            stack.callback(self._answers.close)
            stack.callback(os.close, self._descriptor)
            stack.callback(self.wait)
            stack.callback(self._close_input)
            stack.callback(self.stdout.close)

    def _close_input(self) -> None:
        with suppress(BrokenPipeError):  # unwritten input is lost
            self.stdin.close()


def _readable(descriptor: int, until_s: float | None) -> bool:
    """Wait until it can be read, at most until a monotonic time (None: no limit)."""
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return bool(poll.poll(None if until_s is None else max(until_s - time.monotonic(), 0.0) * 1e3))


class _LauncherOfOurs:
    """A launcher started by this program, with the current environment of Python."""

    def __init__(self) -> None:
        self._owner = os.getpid()
        self._python = _python()
        self._requests, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        program = os.pidfd_open(os.getpid())
        # Block Ctrl-C until the launcher ignores it.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            for end in (self._requests, theirs):
                end.settimeout(None)  # independent of the default timeout of sockets
            passed = [theirs.fileno(), program]
            self._process = subprocess.Popen(
                [sys.executable, "-m", "mavlink_sim.launcher", *map(str, passed)],
                pass_fds=passed,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()
            os.close(program)

    @property
    def lives(self) -> bool:
        return self._owner == os.getpid() and self._process.poll() is None

    @property
    def serves(self) -> bool:
        """Whether its vehicles are the same as one started now."""
        return self._python == _python() and self.lives

    def start(self, arguments: Sequence[str]) -> LaunchedProcess:
        """Start a process with these arguments of `mavlink-sim`, in this one's folder and environment.

        Raises:
            OSError: it could not be started.
        """
        request = Request(list(arguments), os.getcwd(), dict(os.environ))
        with ExitStack() as ours, ExitStack() as theirs:
            their_input, our_input = os.pipe()
            theirs.callback(os.close, their_input)
            stdin = ours.enter_context(open(our_input, "w"))
            our_output, their_output = os.pipe()
            theirs.callback(os.close, their_output)
            stdout = ours.enter_context(open(our_output))
            answers, their_answers = socket.socketpair()
            ours.enter_context(answers).settimeout(None)
            theirs.enter_context(their_answers).settimeout(None)
            try:
                request.send(self._requests, [their_input, their_output, their_answers.fileno()])
            except (BrokenPipeError, ConnectionResetError):
                raise self._ended() from None
            theirs.close()
            answer, descriptors, _, _ = socket.recv_fds(answers, STARTED.size, 1)
            if not answer:
                raise self._ended()
            pid: int = STARTED.unpack(answer)[0]
            if pid < 0:
                raise OSError(-pid, f"cannot fork a process for mavlink-sim: {os.strerror(-pid)}")
            if not descriptors:
                os.kill(pid, signal.SIGKILL)
                raise OSError(errno.EMFILE, "no file descriptor left for a process of mavlink-sim")
            os.set_inheritable(descriptors[0], False)
            ours.pop_all()
        return LaunchedProcess(pid, descriptors[0], answers, stdin, stdout)

    def _ended(self) -> OSError:
        """The error of a missing answer."""
        try:
            return OSError(f"the launcher of mavlink-sim ended with code {self._process.wait(1.0)}")
        except subprocess.TimeoutExpired:
            return OSError("the launcher of mavlink-sim could not fork; see its standard error")

    def close(self) -> None:
        """End it and its vehicles. No effect in a fork of the program."""
        if self._owner != os.getpid():
            return
        with suppress(OSError):  # not connected: it has ended
            self._requests.shutdown(socket.SHUT_RDWR)
        self._requests.close()
        try:
            self._process.wait(LAUNCHER_ENDS_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _python() -> dict[str, str]:
    """The environment variables that a launcher reads at its start."""
    return {name: value for name, value in os.environ.items() if name.startswith("PYTHON")}


_launchers: list[_LauncherOfOurs] = []
_choosing = threading.Lock()


def _close_launchers() -> None:
    for launcher in _launchers:
        launcher.close()


def _launcher() -> _LauncherOfOurs:
    with _choosing:
        if not _launchers:
            atexit.register(_close_launchers)
        for launcher in [*_launchers]:
            if launcher.serves:
                return launcher
            if not launcher.lives:  # one that is alive may have running vehicles
                launcher.close()
                _launchers.remove(launcher)
        _launchers.append(_LauncherOfOurs())
        return _launchers[-1]


def can_launch() -> bool:
    """Whether a launcher is possible: on Linux, if pidfd_open is permitted."""
    try:
        os.close(os.pidfd_open(os.getpid()))
    except (AttributeError, OSError):
        return False
    return True


def start_simulator(arguments: Sequence[str]) -> LaunchedProcess | subprocess.Popen[str]:
    """Start `mavlink-sim` with these arguments; its standard input and output are text pipes.

    Raises:
        OSError: it cannot be started.
    """
    if can_launch():
        try:
            return _launcher().start(arguments)
        except OSError as error:
            if error.errno != errno.EMSGSIZE:  # the environment is too large for a packet
                raise
    return subprocess.Popen(
        [sys.executable, "-m", "mavlink_sim", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
