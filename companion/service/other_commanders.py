"""Who else commands this vehicle, and whether this service may begin to.

Two services on one vehicle both stream setpoints, and it flies by turns to what each of them wants. Another
one shows by its HEARTBEAT, which the autopilot forwards from its other links (`vehicle/commander.py`), and by
its `status` under the same name on the network. The one that has run longer may engage; the other refuses.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from companion.guidance.interface import CommandInput
from companion.guidance.limits.battery import needs_charge
from companion.settings.vehicle import VehicleSection
from companion.vehicle.state import VehicleState

# Heartbeats and `status` come once a second.
GONE_AFTER_S = 3.5
# Uptimes come in whole seconds, and late: of two started so close together neither is the first.
SAME_START_S = 2.0
# Of a `status` that is read, and of services by their status: more are no service of ours.
LARGEST_STATUS_BYTES, MOST_SERVICES = 64 * 1024, 16


@dataclass(frozen=True, slots=True)
class _Other:
    """One other service, by one of the ways to know of it.

    Attributes:
        via: "mavlink" or "zenoh". identity: its MAVLink address, or what its `status` calls it.
        started_ns: CLOCK_MONOTONIC, as its uptime says.
    """

    via: str
    identity: str
    received_ns: int
    started_ns: int
    in_command: bool

    @property
    def words(self) -> str:
        """Who it is, for people."""
        doing = "in command" if self.in_command else "not in command"
        return f"{self.identity} by {self.via}, {doing}"


class OtherCommanders:
    """Watches for other services. Stamps are CLOCK_MONOTONIC nanoseconds.

    Args:
        settings: name of the vehicle, and whether to engage in spite of them.
        service: the identity in our own `status`. started_ns: when we started.
        on_event: called with (level, text) for what a person should know.
    """

    def __init__(
        self, settings: VehicleSection, service: str, started_ns: int, on_event: Callable[[str, str], None]
    ) -> None:
        self._vehicle, self._allowed = settings.name, settings.allow_other_commander
        self._service, self._started_ns, self._on_event = service, started_ns, on_event
        self._by_status: dict[str, _Other] = {}
        self._told: dict[tuple[str, str], _Other] = {}

    def uptime_s(self, now_ns: int) -> float:
        """For how long this service has run, seconds."""
        return (now_ns - self._started_ns) / 1e9

    def on_status(self, payload: bytes, now_ns: int) -> None:
        """Anybody's `status`, our own too."""
        if len(payload) > LARGEST_STATUS_BYTES:
            return
        try:
            message = json.loads(payload)
            name, service = message["vehicle"]["name"], str(message["service"])
            started_ns = now_ns - round(float(message["uptime_s"]) * 1e9)
            in_command = bool(message["pilot"]["in_command"])
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
            return  # not of a service like ours
        known = service in self._by_status or len(self._by_status) < MOST_SERVICES
        if name == self._vehicle and service != self._service and known and len(service) <= 64:
            self._by_status[service] = _Other("zenoh", service, now_ns, started_ns, in_command)

    def present(self, state: VehicleState, now_ns: int) -> list[_Other]:
        """Those of which there was news within `GONE_AFTER_S`."""
        self._by_status = {
            key: one for key, one in self._by_status.items() if _is_new(one.received_ns, now_ns)
        }
        by_heartbeat = [
            _Other(
                "mavlink",
                f"{one.address[0]}/{one.address[1]}",
                one.received_ns,
                one.received_ns - round(one.uptime_s * 1e9),
                one.in_command,
            )
            for one in state.other_commanders
            if _is_new(one.received_ns, now_ns)
        ]
        return [*by_heartbeat, *self._by_status.values()]

    def watch(self, state: VehicleState, now_ns: int) -> None:
        """Say once who has come, and once who has gone."""
        present = {(one.via, one.identity): one for one in self.present(state, now_ns)}
        for key, one in present.items():
            if key not in self._told:
                self._on_event("error", f"another service commands this vehicle: {one.words}")
        for key, one in self._told.items():
            if key not in present:
                self._on_event("info", f"the other service has gone: {one.identity} by {one.via}")
        self._told = present

    def check_requirements(
        self, command: CommandInput, state: VehicleState, *, in_command: bool, now_ns: int
    ) -> str | None:
        """Why this command may not begin; None: it may. What ends a flight always may, and what goes on."""
        if self._allowed or in_command or command.behaviour is None or not needs_charge(command.behaviour):
            return None
        for one in self.present(state, now_ns):
            later = self._started_ns > one.started_ns - SAME_START_S * 1e9
            if one.in_command or later:
                return (
                    f"another service commands this vehicle ({one.words}): end one of them, "
                    "or set vehicle.allow_other_commander = true here"
                )
        return None

    def status(self, state: VehicleState, now_ns: int) -> list[dict[str, Any]]:
        """For `status`."""
        return [
            {
                "via": one.via,
                "identity": one.identity,
                "uptime_s": round((now_ns - one.started_ns) / 1e9, 1),
                "in_command": one.in_command,
            }
            for one in self.present(state, now_ns)
        ]


def _is_new(received_ns: int, now_ns: int) -> bool:
    return now_ns - received_ns <= GONE_AFTER_S * 1e9
