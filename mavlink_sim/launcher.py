"""A process that has imported the simulator and forks one process per vehicle, which is faster than a start.

Starting Python and importing the simulator is most of the time until a vehicle is ready. A test run that
starts hundreds pays it once: `mavlink_sim.launching` starts `python -m mavlink_sim.launcher`, which imports
and forks a process for each request. That acts as `python -m mavlink_sim`, with the folder, environment,
standard input and output of the requester; what Python or a library reads of them at its start is the
launcher's, as are umask, limits and niceness. Linux only.

The launcher ends with the program that started it, and a vehicle with its launcher.

A request is one packet with a JSON object and three descriptors: the new process's standard input and output,
and a socket for the answers. Those are the process's id, with a descriptor of it (pidfd), and its exit code
when it has ended.
"""

from __future__ import annotations

import ctypes
import json
import os
import selectors
import signal
import socket
import sys
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass

from mavlink_sim.launching import ENDED, LARGEST_REQUEST, SHUTDOWN_TIMEOUT_S, STARTED, Request
from vision.gc_pause import gc_paused

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_GONE = (BrokenPipeError, ConnectionResetError)
_ENDS_OF_A_GROUP = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True, slots=True)
class _Child:
    """A forked process: `descriptor` is its pidfd, `answers` the socket of the requester."""

    pid: int
    descriptor: int
    answers: socket.socket

    def report_start(self) -> None:
        with suppress(OSError):  # the requester is gone, or sees the end of the answers
            socket.send_fds(self.answers, [STARTED.pack(self.pid)], [self.descriptor])

    def on_exit(self) -> None:
        """Collect the exit code of the ended process, and send it to the requester."""
        _, status = os.waitpid(self.pid, 0)
        with suppress(*_GONE):
            self.answers.sendall(ENDED.pack(os.waitstatus_to_exitcode(status)))
        self.close()

    def send(self, number: int) -> None:
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.descriptor, number)

    def close(self) -> None:
        os.close(self.descriptor)
        self.answers.close()


def main(requests: int, program: int) -> None:
    """Run the launcher; in every fork run the simulator.

    Args:
        requests: the descriptor of the request socket.
        program: a pidfd of the program that sends requests.
    """
    # Signals to a terminal or process group are ignored; the launcher ends its vehicles when the program
    # ends.
    for number in _ENDS_OF_A_GROUP:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # if ignored, there would be no exit codes
    with gc_paused():
        from mavlink_sim.cli import main as cli

        cli.load()
    with socket.socket(fileno=requests) as connection, selectors.DefaultSelector() as selector:
        arguments = _Launcher(connection, program, selector).run()
    if arguments is not None:
        sys.argv = ["mavlink-sim", *arguments]
        cli.main()


class _Launcher:
    """Forks one process per request."""

    def __init__(self, requests: socket.socket, program: int, selector: selectors.BaseSelector) -> None:
        self._requests = requests
        self._selector = selector
        self._children: list[_Child] = []
        self._pid = os.getpid()
        # A fork of the program may keep the other end of the socket open after the program has ended.
        self._program = program
        selector.register(requests, selectors.EVENT_READ)
        selector.register(self._program, selectors.EVENT_READ)

    def run(self) -> list[str] | None:
        """Serve requests. Returns in each fork its arguments, in the launcher None at the end."""
        try:
            while True:
                for key, _ in self._selector.select():
                    if key.data is not None:
                        self._on_exit(key.data)
                    elif key.fileobj == self._program:
                        return None
                    else:
                        packet, descriptors, _, _ = socket.recv_fds(self._requests, LARGEST_REQUEST, 3)
                        if not packet:
                            return None
                        arguments = self._serve(packet, descriptors)
                        if arguments is not None:
                            return arguments
        finally:
            if os.getpid() == self._pid:
                self._end_all()

    def _serve(self, packet: bytes, descriptors: list[int]) -> list[str] | None:
        """Fork for a request. Returns its arguments in the fork, None in the launcher.

        After an invalid request the requester sees the end of the answers.
        """
        try:
            request = Request(**json.loads(packet))
            standard_input, standard_output, answers = descriptors
            pid = self._fork(answers)
        except (OSError, TypeError, ValueError):
            traceback.print_exc()
            pid = None
        if pid == 0:
            self._become(request, standard_input, standard_output)
            return request.arguments
        for descriptor in descriptors:
            os.close(descriptor)
        return None

    def _fork(self, answers: int) -> int | None:
        """0 in the new process; in the launcher its id, None if there is none."""
        connection = socket.socket(fileno=os.dup(answers))
        try:
            pid = os.fork()
        except OSError as error:
            with connection, suppress(*_GONE):
                connection.sendall(STARTED.pack(-(error.errno or 1)))
            return None
        if pid == 0:
            connection.close()
            os.close(answers)
            return 0
        try:
            child = _Child(pid, os.pidfd_open(pid), connection)
        except OSError:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            connection.close()
            raise
        self._children.append(child)
        self._selector.register(child.descriptor, selectors.EVENT_READ, child)
        child.report_start()
        return pid

    def _become(self, request: Request, standard_input: int, standard_output: int) -> None:
        """Become the requested process: close everything of the launcher."""
        for child in self._children:
            child.close()
        os.close(self._program)
        for number, descriptor in enumerate((standard_input, standard_output)):
            os.dup2(descriptor, number)
            os.close(descriptor)
        os.dup2(1, 2)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != self._pid:  # the launcher ended before prctl
            os._exit(1)
        os.chdir(request.folder)
        if not sys.flags.safe_path:
            sys.path[0] = request.folder
        os.environ.clear()
        os.environ.update(request.environment)

    def _on_exit(self, child: _Child) -> None:
        self._selector.unregister(child.descriptor)
        self._children.remove(child)
        child.on_exit()

    def _end_all(self) -> None:
        for child in self._children:
            child.send(signal.SIGTERM)
            child.send(signal.SIGCONT)  # it may be suspended
        self._selector.unregister(self._requests)
        self._selector.unregister(self._program)
        until_s = time.monotonic() + SHUTDOWN_TIMEOUT_S
        while self._children and (left_s := until_s - time.monotonic()) > 0.0:
            for key, _ in self._selector.select(left_s):
                self._on_exit(key.data)
        for child in [*self._children]:
            child.send(signal.SIGKILL)
            self._on_exit(child)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
