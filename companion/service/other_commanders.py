"""Detects other services that command this vehicle, and decides whether this one may engage.

Two services on one vehicle both stream setpoints, and it follows them alternately. Another service is
detected by its HEARTBEAT, which the autopilot forwards from its other links (`vehicle/commander.py`), and by
its `status` under the same name on the network. The one with the longer uptime may engage; the other refuses.

Any program that commands the vehicle is also detected by its effect: an acknowledgement, to our address, of a
command that we did not send; setpoints that the autopilot follows beside ours (`setpoint_echo`); on PX4 also
OFFBOARD, which it leaves without setpoints, while we send none. Not where its parameters let it stay there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from companion.bus.bodies.service import OtherCommanderBody
from companion.guidance.interface import CommandInput
from companion.guidance.limits.battery import needs_charge
from companion.host.peer_data import PeerDataError, parse_object
from companion.settings.vehicle import COMPONENT_IDS, VehicleSection
from companion.vehicle.gimbal import Address, address_text
from companion.vehicle.setpoint_loss import SetpointLossEffect, SetpointLossOutcome
from companion.vehicle.state import FlightMode, VehicleState

FOREIGN_COMMAND = "commands with our own address"
FOREIGN_OFFBOARD = "setpoints in OFFBOARD"
FOREIGN_SETPOINTS = "setpoints beside ours"
# Heartbeats and `status` are sent once a second.
GONE_AFTER_S = 3.5
# Uptimes are whole seconds, and delayed: of two services started this close together neither is the first.
SAME_START_S = 2.0
# PX4 leaves OFFBOARD after COM_OF_LOSS_T without setpoints, 1 s by default. It counts after this time, or the
# margin beyond a longer COM_OF_LOSS_T.
FOREIGN_OFFBOARD_S, LOSS_MARGIN_S = 5.0, 2.0
# Services known by their status.
MOST_SERVICES = 16


@dataclass(frozen=True, slots=True)
class _Other:
    """One other service, as detected by one means.

    Attributes:
        via: "mavlink" or "zenoh". identity: its MAVLink address, or `service` of its `status`.
        started_ns: CLOCK_MONOTONIC, from its uptime.
        effect: what it does to the vehicle, as text; empty: not known.
    """

    via: str
    identity: str
    received_ns: int
    started_ns: int
    in_command: bool
    effect: str = ""

    @property
    def text(self) -> str:
        """Description for the operator."""
        state = "in command" if self.in_command else "not in command"
        return f"{self.identity} by {self.via}, {state}{self.effect and f': {self.effect}'}"


class OtherCommanders:
    """Monitors other services. Stamps are CLOCK_MONOTONIC nanoseconds.

    Args:
        settings: name of the vehicle, and whether to engage despite other services.
        service: the identity in our own `status`. started_ns: when we started.
        on_event: called with (level, text) for the operator.
    """

    def __init__(
        self, settings: VehicleSection, service: str, started_ns: int, on_event: Callable[[str, str], None]
    ) -> None:
        self._vehicle, self._allowed = settings.name, settings.allow_other_commander
        self._service, self._started_ns, self._on_event = service, started_ns, on_event
        self._by_status: dict[str, _Other] = {}
        self._reported: dict[tuple[str, str], _Other] = {}
        self._address: Address = (settings.system_id, COMPONENT_IDS[0])
        self._shared = False
        self._offboard_since_ns: int | None = None
        self._foreign_after_s = FOREIGN_OFFBOARD_S
        self._exact_echo = False

    def uptime_s(self, now_ns: int) -> float:
        """Uptime of this service, seconds."""
        return (now_ns - self._started_ns) / 1e9

    def on_status(self, payload: bytes, now_ns: int) -> None:
        """Process a `status` message of any service, including our own.

        Raises:
            PeerDataError: it is not a status of a companion service.
        """
        message = parse_object(payload)
        try:
            name, service = message["vehicle"]["name"], str(message["service"])
            started_ns = now_ns - round(float(message["uptime_s"]) * 1e9)
            in_command = bool(message["pilot"]["in_command"])
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise PeerDataError(f"not the status of a service: {type(error).__name__}: {error}") from None
        known = service in self._by_status or len(self._by_status) < MOST_SERVICES
        if name == self._vehicle and service != self._service and known and len(service) <= 64:
            self._by_status[service] = _Other("zenoh", service, now_ns, started_ns, in_command)

    def present(self, state: VehicleState, now_ns: int) -> list[_Other]:
        """Return the services received within `GONE_AFTER_S`."""
        self._by_status = {
            key: other for key, other in self._by_status.items() if _is_recent(other.received_ns, now_ns)
        }
        by_heartbeat = [
            _Other(
                "mavlink",
                f"{commander.address[0]}/{commander.address[1]}",
                commander.received_ns,
                commander.received_ns - round(commander.uptime_s * 1e9),
                commander.in_command,
            )
            for commander in state.other_commanders
            if _is_recent(commander.received_ns, now_ns)
        ]
        return [*by_heartbeat, *self._by_status.values(), *self._by_effect(state, now_ns)]

    def _by_effect(self, state: VehicleState, now_ns: int) -> list[_Other]:
        """Return what only the vehicle shows."""
        found = []
        commanded_ns, since_ns = state.foreign_command_ns, self._offboard_since_ns
        if commanded_ns and _is_recent(commanded_ns, now_ns):
            found.append(_Other("mavlink", FOREIGN_COMMAND, commanded_ns, commanded_ns, True))
        if since_ns is not None and now_ns - since_ns >= self._foreign_after_s * 1e9:
            found.append(_Other("mavlink", FOREIGN_OFFBOARD, now_ns, since_ns, True))
        beside = state.foreign_setpoint
        if self._exact_echo and beside is not None and _is_recent(beside.stamp_ns, now_ns):
            effect = f"the autopilot follows {beside.followed} beside our {beside.sent}"
            found.append(_Other("mavlink", FOREIGN_SETPOINTS, beside.stamp_ns, beside.since_ns, True, effect))
        return found

    def shares_address(self, state: VehicleState, now_ns: int) -> bool:
        """Whether another program has sent lately with our MAVLink address."""
        return state.address_shared_ns > 0 and _is_recent(state.address_shared_ns, now_ns)

    def watch(
        self,
        state: VehicleState,
        now_ns: int,
        setpoint_loss: SetpointLossOutcome,
        *,
        in_command: bool = False,
        exact_echo: bool = False,
    ) -> None:
        """Report services that have appeared or disappeared, once each; call it once a second.

        Args:
            setpoint_loss: what the autopilot does without setpoints.
            in_command: whether we are in command.
            exact_echo: whether the autopilot reports the setpoint that it follows as it was sent.
        """
        self._watch_address(state, now_ns)
        self._exact_echo = exact_echo
        self._foreign_after_s = max(FOREIGN_OFFBOARD_S, (setpoint_loss.after_s or 0.0) + LOSS_MARGIN_S)
        flies_setpoints = state.autopilot == "PX4" and state.mode is FlightMode.OFFBOARD and state.armed
        if setpoint_loss.effect is SetpointLossEffect.FLY_ON:  # it stays in OFFBOARD without setpoints
            flies_setpoints = False
        if in_command or not flies_setpoints or not state.connected(now_ns):
            self._offboard_since_ns = None
        elif self._offboard_since_ns is None:
            self._offboard_since_ns = now_ns
        present = {(other.via, other.identity): other for other in self.present(state, now_ns)}
        for key, other in present.items():
            if key not in self._reported:
                self._on_event("error", f"another service commands this vehicle: {other.text}")
        for key, other in self._reported.items():
            if key not in present:
                self._on_event("info", f"other service gone: {other.identity} by {other.via}")
        self._reported = present

    def _watch_address(self, state: VehicleState, now_ns: int) -> None:
        """Report a change of our MAVLink address, and another program that sends with it."""
        before, self._address = self._address, state.own_address
        if self._address != before:
            taken, now = address_text(before), address_text(self._address)
            self._on_event("warning", f"our MAVLink address is {now}: another program has {taken}")
        was_shared, self._shared = self._shared, self.shares_address(state, now_ns)
        if self._shared and not was_shared:
            own = address_text(self._address)
            self._on_event("error", f"another program sends with our MAVLink address {own}; end one of them")

    def check_requirements(
        self, command: CommandInput, state: VehicleState, *, in_command: bool, now_ns: int
    ) -> str | None:
        """Return why a command may not start, or None.

        Commands that end a flight are always allowed, and all commands while this service is in command.
        """
        if self._allowed or in_command or command.behaviour is None or not needs_charge(command.behaviour):
            return None
        for other in self.present(state, now_ns):
            later = self._started_ns > other.started_ns - SAME_START_S * 1e9
            if other.in_command or later:
                return (
                    f"another service commands this vehicle ({other.text}): end one of them, "
                    "or set vehicle.allow_other_commander = true here"
                )
        return None

    def status(self, state: VehicleState, now_ns: int) -> list[OtherCommanderBody]:
        """Return the present services as fields of `status`."""
        return [
            {
                "via": other.via,
                "identity": other.identity,
                "uptime_s": round((now_ns - other.started_ns) / 1e9, 1),
                "in_command": other.in_command,
            }
            for other in self.present(state, now_ns)
        ]


def _is_recent(received_ns: int, now_ns: int) -> bool:
    return now_ns - received_ns <= GONE_AFTER_S * 1e9
