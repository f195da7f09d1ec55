"""Vehicles from a process that has everything imported: forks of it, each up in a fraction of the time.

To start Python and to import the simulator takes most of the time until a vehicle is ready. A test run that
starts hundreds pays it once: with the first, `mavlink_sim.testing` starts `python -m mavlink_sim.launcher`,
which imports, and forks a process for each vehicle that is wanted: in everything but its command line what
`python -m mavlink_sim` is. The launcher ends with the program that started it, however that ends, and its
vehicles with it. It takes Linux.

A request is a JSON object after its length, on a stream socket. With the length come the new process's
standard input, its standard output, and the end of a socket for the answers: the process's id, with a
descriptor of the process (pidfd); and its exit code when it has ended.
"""

from __future__ import annotations

import json
import os
import selectors
import signal
import socket
import struct
import sys
from contextlib import suppress
from dataclasses import asdict, dataclass

from vision.loading import uncollected

LENGTH = struct.Struct("!I")
STARTED = struct.Struct("!i")  # the process's id; below zero: an errno, it could not be forked
ENDED = struct.Struct("!i")  # the exit code, as `subprocess` has it


@dataclass(frozen=True, slots=True)
class Request:
    """A process that is wanted.

    Attributes:
        arguments: of `mavlink-sim`.
        folder: to run in.
        environment: all of its variables.
    """

    arguments: list[str]
    folder: str
    environment: dict[str, str]

    def send(self, connection: socket.socket, descriptors: list[int]) -> None:
        """Ask for it; `descriptors` are its standard input, its standard output, and where to answer."""
        body = json.dumps(asdict(self)).encode()
        socket.send_fds(connection, [LENGTH.pack(len(body))], descriptors)
        connection.sendall(body)


@dataclass(frozen=True, slots=True)
class _Child:
    """A process that was forked: `descriptor` is its pidfd, `answers` the socket of whoever wanted it."""

    pid: int
    descriptor: int
    answers: socket.socket

    def tell_start(self) -> None:
        with suppress(BrokenPipeError, ConnectionResetError):  # who asked does not want to know any more
            socket.send_fds(self.answers, [STARTED.pack(self.pid)], [self.descriptor])

    def tell_end(self) -> None:
        """It has ended: take its exit code, and pass that on."""
        _, status = os.waitpid(self.pid, 0)
        with suppress(BrokenPipeError, ConnectionResetError):
            self.answers.sendall(ENDED.pack(os.waitstatus_to_exitcode(status)))
        self.close()

    def end(self) -> None:
        """Ask it to end, suspended or not."""
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.descriptor, signal.SIGTERM)
            signal.pidfd_send_signal(self.descriptor, signal.SIGCONT)

    def close(self) -> None:
        os.close(self.descriptor)
        self.answers.close()


def main(descriptor: int) -> None:
    """Be the launcher with the requests of the socket `descriptor`; and in every fork be the simulator."""
    # A Ctrl-C reaches every process of a terminal; this one ends with the program that started it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with uncollected():
        from mavlink_sim import cli

        cli.load()
    with socket.socket(fileno=descriptor) as requests:
        arguments = _launch(requests)
    if arguments is not None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.argv = ["mavlink-sim", *arguments]
        cli.main()


def _launch(requests: socket.socket) -> list[str] | None:
    """Fork as often as asked. Returns in each fork its arguments, and None once nobody can ask any more."""
    children: list[_Child] = []
    with selectors.DefaultSelector() as selector:
        selector.register(requests, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select():
                if key.data is not None:
                    selector.unregister(key.data.descriptor)
                    children.remove(key.data)
                    key.data.tell_end()
                    continue
                taken = _take(requests)
                if taken is None:
                    for child in children:
                        child.end()
                    return None
                request, standard, answers = taken
                try:
                    pid = os.fork()
                except OSError as error:
                    answers.sendall(STARTED.pack(-(error.errno or 1)))
                    answers.close()
                else:
                    if pid == 0:
                        # What is open here is the launcher's, and not this process's to keep open.
                        for child in children:
                            child.close()
                        answers.close()
                        _become(request, standard)
                        return request.arguments
                    child = _Child(pid, os.pidfd_open(pid), answers)
                    child.tell_start()
                    children.append(child)
                    selector.register(child.descriptor, selectors.EVENT_READ, child)
                for number in standard:
                    os.close(number)


def _take(requests: socket.socket) -> tuple[Request, list[int], socket.socket] | None:
    """The next request, its process's standard input and output, and the socket for the answers.

    None when the other end is closed.
    """
    header, descriptors, _, _ = socket.recv_fds(requests, LENGTH.size, 3)
    if not header:
        return None
    body = bytearray()
    wanted: int = LENGTH.unpack(header)[0]
    while len(body) < wanted:
        part = requests.recv(wanted - len(body))
        if not part:
            return None
        body += part
    *standard, answers = descriptors
    return Request(**json.loads(body)), standard, socket.socket(fileno=answers)


def _become(request: Request, standard: list[int]) -> None:
    """Be the process that is wanted, from its descriptors to its folder."""
    for number, descriptor in enumerate(standard):
        os.dup2(descriptor, number)
        os.close(descriptor)
    os.dup2(1, 2)
    os.chdir(request.folder)
    os.environ.clear()
    os.environ.update(request.environment)


if __name__ == "__main__":
    main(int(sys.argv[1]))
