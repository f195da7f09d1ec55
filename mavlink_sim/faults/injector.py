"""Fault injection in real time: the sockets, the console and the zenoh key of one vehicle.

* console: a line of the grammar each, answered by one or more lines. It is polled, and not read while the
  program is in a terminal's background, where reading would stop the process.
* zenoh: a queryable at `mavlink_sim/<system id>/fault` that takes the grammar as payload or as parameter
  (`mavlink_sim/1/fault?fault=link_delay 0.2`). The reply is JSON:
  `{"ok": true, "text": "fault 1 link_delay 0.2", "active": ["1 link_delay 0.2: since 12.3 s"]}`.
  Queries come on zenoh's threads and are queued until polled. The session listens at the given endpoint only,
  connects to no other and has no multicast scouting.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import selectors
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any, Protocol

from mavlink_sim.faults.schedule import Faults, Outcome
from mavlink_sim.wire.endpoint import UdpEndpoint
from mavlink_sim.wire.faulty_socket import FaultySocket

logger = logging.getLogger(__name__)

LONGEST_COMMAND_BYTES = 4096
MAX_WAITING = 100


class ControlError(OSError):
    """The control endpoint cannot be opened. The message is one line for the user."""


def fault_key(system_id: int) -> str:
    """The key of a vehicle's faults."""
    return f"mavlink_sim/{system_id}/fault"


class FaultControl:
    """The queryable of one vehicle.

    Args:
        endpoint: where zenoh listens, for example `tcp/127.0.0.1:7447`.

    Raises:
        ControlError: zenoh is not installed, or cannot listen there.
    """

    def __init__(self, endpoint: str, system_id: int, faults: Faults) -> None:
        try:
            import zenoh  # imported on demand: it is slow
        except ImportError as error:
            raise ControlError("--control needs zenoh: pip install eclipse-zenoh") from error
        self._faults = faults
        self._waiting: queue.Queue[Any] = queue.Queue(MAX_WAITING)
        self._endpoint = endpoint
        try:
            self._session = _shared_session(endpoint)
        except zenoh.ZError as error:
            reason = str(error).splitlines()[0]
            raise ControlError(f"--control {endpoint}: zenoh cannot listen there: {reason}") from error
        self.key = fault_key(system_id)
        self._queryable = self._session.declare_queryable(self.key, self._query)

    def _query(self, query: Any) -> None:
        """Called on a thread of zenoh."""
        try:
            self._waiting.put_nowait(query)
        except queue.Full:
            logger.warning("%s: more than %d queries are queued; one is dropped", self.key, MAX_WAITING)

    def poll(self) -> None:
        """Execute and answer the queued queries."""
        while True:
            try:
                query = self._waiting.get_nowait()
            except queue.Empty:
                return
            self._answer(query)

    def _answer(self, query: Any) -> None:
        payload = query.payload
        accepted = payload is not None and len(payload) <= LONGEST_COMMAND_BYTES
        text = payload.to_bytes().decode(errors="replace") if accepted else ""
        if not text:
            text = query.parameters.get("fault", "")
        outcome = self._faults.command(text)
        active = [line for line in self._faults.listing() if line != "no faults"]
        reply = {"ok": outcome.ok, "text": outcome.text, "active": active}
        query.reply(self.key, json.dumps(reply).encode(), encoding="application/json")

    def close(self) -> None:
        """Stop answering; the last vehicle in this process closes the session."""
        self._queryable.undeclare()
        session, users = _sessions[self._endpoint]
        if users > 1:
            _sessions[self._endpoint] = (session, users - 1)
            return
        del _sessions[self._endpoint]
        session.close()


# The vehicles of one process share the session of an endpoint: (session, how many use it).
_sessions: dict[str, tuple[Any, int]] = {}


def _shared_session(endpoint: str) -> Any:
    """A session that listens only at the endpoint. Raises zenoh.ZError."""
    import zenoh

    session, users = _sessions.get(endpoint, (None, 0))
    if session is None:
        settings = {
            "mode": "peer",
            "listen/endpoints": [endpoint],
            "connect/endpoints": [],
            "scouting/multicast/enabled": False,
        }
        config = zenoh.Config()
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        session = zenoh.open(config)
    _sessions[endpoint] = (session, users + 1)
    return session


LONGEST_LINE_BYTES = 4096


class FaultConsole:
    """Passes lines from a descriptor (a terminal, a pipe, a file) to a vehicle's faults.

    Args:
        descriptor: to read; usually 0.
        command: executes one line.
        report: prints one line of an answer.
    """

    def __init__(
        self, descriptor: int, command: Callable[[str], Outcome], report: Callable[[str], None]
    ) -> None:
        self._descriptor = descriptor
        self._command = command
        self._report = report
        self._partial = b""
        self._open = True
        self._selector = selectors.DefaultSelector()
        self._always_ready = False
        try:
            self._selector.register(descriptor, selectors.EVENT_READ)
        except PermissionError:
            self._always_ready = True  # a regular file: readable without polling

    def poll(self) -> None:
        """Execute the lines received since the last call."""
        if not self._open or not (self._always_ready or self._selector.select(0)):
            return
        if in_background(self._descriptor):
            return
        try:
            data = os.read(self._descriptor, LONGEST_LINE_BYTES)
        except BlockingIOError:
            return
        except OSError:  # the terminal was closed
            data = b""
        if not data:
            self._open = False
        lines = (self._partial + data).split(b"\n")
        self._partial = lines.pop()[:LONGEST_LINE_BYTES]
        if not self._open and self._partial:
            lines.append(self._partial)
        for line in lines:
            text = line.decode(errors="replace").strip()
            if text and not text.startswith("#"):
                self._answer(self._command(text))

    def _answer(self, outcome: Outcome) -> None:
        for line in outcome.text.splitlines():
            self._report(line if outcome.ok else f"not done: {line}")

    def close(self) -> None:
        """Stop reading. The descriptor stays open: its owner closes it."""
        self._open = False
        self._selector.close()


def in_background(descriptor: int) -> bool:
    """Whether the descriptor is a terminal whose foreground belongs to another program."""
    with contextlib.suppress(OSError):
        return os.tcgetpgrp(descriptor) != os.getpgrp()
    return False


class FaultOptions(Protocol):
    """The options of a simulation about faults."""

    @property
    def faults(self) -> tuple[str, ...]: ...
    @property
    def console(self) -> bool | None: ...
    @property
    def control(self) -> str | None: ...


class FaultInjector:
    """Fault injection for the loop of a simulation; see `fault_injector`."""

    def __init__(
        self, sockets: Mapping[str, FaultySocket], console: FaultConsole | None, control: FaultControl | None
    ) -> None:
        self._sockets = sockets
        self._console = console
        self._control = control

    def poll(self) -> None:
        """Execute commands of the console and of zenoh; call it once per loop."""
        if self._console is not None:
            self._console.poll()
        if self._control is not None:
            self._control.poll()

    def delivered(self) -> list[str]:
        """Send due datagrams, once per step. Returns the links on which delayed datagrams have arrived."""
        arrived = []
        for name, socket in self._sockets.items():
            socket.pump()
            if socket.has_arrivals:
                arrived.append(name)
        return arrived


@contextmanager
def fault_injector(
    faults: Faults,
    system_id: int,
    endpoints: Mapping[str, UdpEndpoint],
    options: FaultOptions,
    report: Callable[[str], None],
) -> Iterator[FaultInjector]:
    """Insert the links' stages before the sockets, begin the faults, open console and zenoh control.

    Raises:
        FaultError: an invalid fault.
        ControlError: the control endpoint cannot be opened.
    """
    sockets = {}
    for name, endpoint in endpoints.items():
        sockets[name] = FaultySocket(endpoint.socket, faults.stage(name), lambda: faults.now_s)
        endpoint.socket = sockets[name]
    for line in options.faults:
        faults.begin(line)
    with ExitStack() as stack:
        console = control = None
        if options.control is not None:
            control = FaultControl(options.control, system_id, faults)
            stack.callback(control.close)
        if options.console or (options.console is None and _is_terminal()):
            console = FaultConsole(0, faults.command, report)
            stack.callback(console.close)
        yield FaultInjector(sockets, console, control)


def _is_terminal() -> bool:
    return sys.stdin is not None and sys.stdin.isatty()
