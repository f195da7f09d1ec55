"""Detects setpoints of another program by the setpoint that the autopilot reports to follow.

PX4 (v1.14 to v1.18) and Copter (4.7) accept setpoints of every sender, and report the newest in
POSITION_TARGET_LOCAL_NED, axis by axis as it was received. One that was not sent here lately is another
program's. The autopilot reports at its own rate: of a program that sends 50 setpoints a second beside our 50,
about every third report shows one; of one that sends 10, every tenth; of one that sends 2, every 80th.

These are no sign of another program, and are not judged:

* What PX4 reduces to its own limits of speed, also at the beginning of a take-off.
* What is followed in another mode. A mode may be reported up to a second after its beginning, so a setpoint
  counts only if the autopilot still reports OFFBOARD (GUIDED) afterwards.
* A velocity of an ArduPilot whose fence or proximity sensors are enabled: it may alter ours.
* What is reported while our setpoints may not arrive: Copter then stops after GUID_TIMEOUT.
"""

from __future__ import annotations

import math
from collections import deque

from companion.vehicle.commander import ForeignSetpoint
from companion.vehicle.state import FlightMode, LandedState, VehicleState, with_fields
from companion.vehicle.telemetry import Fields

NAME = "POSITION_TARGET_LOCAL_NED"
# A setpoint may be reported so long after it was sent.
KEPT_S = 3.0
# OFFBOARD and our stream, without a longer gap, must have lasted so long: before, another mode's may show.
SETTLED_S, GAP_S = 1.0, 0.5
# A TIMESYNC request of the last second was answered. It is sent every 0.5 s.
ANSWERED_S = 0.9
# So many setpoints of another program within this time are one.
FOREIGN, WINDOW_S = 3, 120.0
# PX4 reports the numbers that were sent; Copter has converted them to centimetres and back.
TOLERANCE = 0.01
# Slower than this a velocity is no reduced one, except of a climb.
REDUCED_MPS = 0.5
_POSITION_BITS, _VELOCITY_BITS = (1, 2, 4), (8, 16, 32)  # POSITION_TARGET_TYPEMASK

Axis = tuple[str, float]  # unit (metres or m/s) and value
Axes = tuple[Axis, Axis, Axis]  # north, east, down


class SetpointEcho:
    """Compares the reported setpoint with those that were sent. Stamps are CLOCK_MONOTONIC nanoseconds."""

    def __init__(self) -> None:
        self._sent: deque[tuple[int, Axes]] = deque()  # each setpoint once, with its last sending
        self._since_ns: int | None = None
        self._unconfirmed: deque[tuple[int, Axes, Axes]] = deque(maxlen=FOREIGN)
        self._foreign: deque[tuple[int, Axes, Axes]] = deque(maxlen=FOREIGN)

    def sent(self, fields: Fields, now_ns: int) -> None:
        """Note the fields of a SET_POSITION_TARGET_LOCAL_NED of ours."""
        axes = axes_of(fields)
        if axes is None:
            return
        if self._sent and now_ns - self._sent[-1][0] > GAP_S * 1e9:
            self._begin_again()
        while self._sent and now_ns - self._sent[0][0] > KEPT_S * 1e9:
            self._sent.popleft()
        if self._sent and self._sent[-1][1] == axes:
            self._sent.pop()
        self._sent.append((now_ns, axes))

    def received(self, fields: Fields, state: VehicleState, now_ns: int, answered_ns: int) -> None:
        """Compare a POSITION_TARGET_LOCAL_NED.

        Args:
            answered_ns: when the newest answered TIMESYNC request was sent.
        """
        followed = axes_of(fields)
        if not self._is_settled(state, now_ns) or followed is None or now_ns - answered_ns > ANSWERED_S * 1e9:
            return
        if state.alters_velocities and any(unit == "m/s" for unit, _ in followed):
            return
        if not any(_may_be(sent, followed) for _, sent in reversed(self._sent)):
            self._unconfirmed.append((now_ns, self._sent[-1][1], followed))

    def confirm(self, state: VehicleState, now_ns: int) -> VehicleState:
        """Judge what was compared until now: this state has a new report of the mode.

        Returns:
            The state, with the newest setpoint of another program while enough of them were received.
        """
        if not self._is_settled(state, now_ns):
            return state
        self._foreign.extend(self._unconfirmed)
        self._unconfirmed.clear()
        if len(self._foreign) < FOREIGN or now_ns - self._foreign[0][0] > WINDOW_S * 1e9:
            return state
        _, sent, followed = self._foreign[-1]
        found = ForeignSetpoint(now_ns, self._foreign[0][0], _words(sent), _words(followed))
        return with_fields(state, foreign_setpoint=found)

    def _is_settled(self, state: VehicleState, now_ns: int) -> bool:
        """Whether it has flown our setpoints for some time; if not, what was compared before is dropped."""
        flying = state.mode is FlightMode.OFFBOARD and state.armed and state.landed is LandedState.IN_AIR
        if not flying or not self._sent or now_ns - self._sent[-1][0] > GAP_S * 1e9:
            self._begin_again()
            return False
        if self._since_ns is None:
            self._since_ns = now_ns
        return now_ns - self._since_ns >= SETTLED_S * 1e9

    def _begin_again(self) -> None:
        self._since_ns = None
        self._unconfirmed.clear()
        self._foreign.clear()


def axes_of(fields: Fields) -> Axes | None:
    """Return what each axis is controlled by, its position before its velocity; None: one by neither."""
    mask, found = fields["type_mask"], []
    for names, bits in zip(
        (("x", "vx"), ("y", "vy"), ("z", "vz")), zip(_POSITION_BITS, _VELOCITY_BITS, strict=True), strict=True
    ):
        for unit, name, bit in zip(("m", "m/s"), names, bits, strict=True):
            value = fields[name]
            if not mask & bit and value is not None and math.isfinite(value):
                found.append((unit, value))
                break
    return (found[0], found[1], found[2]) if len(found) == 3 else None


def _may_be(sent: Axes, followed: Axes) -> bool:
    """Whether the autopilot may report this when it follows a setpoint."""
    if any(ours[0] != its[0] for ours, its in zip(sent, followed, strict=True)):
        return False
    if all(abs(ours[1] - its[1]) <= TOLERANCE for ours, its in zip(sent, followed, strict=True)):
        return True
    if any(unit != "m/s" for unit, _ in sent):
        return False
    (north, east, down), (its_north, its_east, its_down) = (
        tuple(value for _, value in axes) for axes in (sent, followed)
    )
    speed, its_speed = math.hypot(north, east), math.hypot(its_north, its_east)
    same = abs(north - its_north) <= TOLERANCE and abs(east - its_east) <= TOLERANCE
    aside = abs(north * its_east - east * its_north) <= TOLERANCE * speed
    ahead = north * its_north + east * its_east > 0.0
    reduced = aside and ahead and REDUCED_MPS <= its_speed <= speed
    if not same and not reduced:
        return False
    if abs(down - its_down) <= TOLERANCE:
        return True
    return down <= its_down <= 0.0 or REDUCED_MPS <= its_down <= down


def _words(axes: Axes) -> str:
    return ", ".join(
        f"{name} {value:.2f} {unit}"
        for name, (unit, value) in zip(("north", "east", "down"), axes, strict=True)
    )
