"""Fault injection in real time: the sockets, the console and the zenoh key of one vehicle."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Protocol

from mavlink_sim.faults.console import FaultConsole
from mavlink_sim.faults.schedule import Faults
from mavlink_sim.faults.zenoh_control import FaultControl
from mavlink_sim.wire.endpoint import UdpEndpoint
from mavlink_sim.wire.faulty_socket import FaultySocket


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
        self,
        sockets: Mapping[str, FaultySocket],
        console: FaultConsole | None,
        control: FaultControl | None,
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
