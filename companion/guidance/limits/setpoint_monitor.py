"""Setpoint monitor: detect that the vehicle does not follow our setpoints, so something else steers it.

A ground station can move or stop a vehicle in OFFBOARD (GUIDED) without a change of mode: ArduPilot accepts
DO_REPOSITION and DO_PAUSE_CONTINUE there, and both autopilots accept setpoints of any sender. ArduPilot's
fence stops it too. Only the motion shows this.

The measured velocity is compared with those of two vehicles that follow: the fastest has the sent velocity,
the slowest approaches it with the time constant `SLOWEST_S`. Anything between the two follows, also relative
to the setpoint of `DELAY_S` before. The residual is the distance from that range, so a step, a reversal or a
delay of the setpoint leaves none. A badly tuned vehicle oscillates about the setpoint; that is a residual,
but it keeps accelerating towards the setpoint. So a residual counts only if it lasts without that
acceleration.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import LandedState, Vector3, VehicleState

# Time constant of the slowest vehicle that counts as following. PX4 in its SIH simulation takes 0.5 to 1 s
# for 90 % of a step.
SLOWEST_S = 2.0
# Telemetry, transport, the autopilot's shaping of a setpoint and its tilt: with 0.2 s of additional delay.
DELAY_S = 0.5
# (residual m/s, lasting s). The later ones are for slow setpoints. Set by flights in lockstep, in wind up to
# 3 m/s with gusts. Formations are the hardest: of 40 vehicles, 11 exceeded 0.5 m/s for 1 s, 4 of them
# 0.8 m/s, 1 of these 1 m/s and 1.2 m/s, none 1.3 m/s.
RULES = ((1.5, 1.0), (1.0, 2.5), (0.5, 6.0))
# Minimum residual relative to the commanded speed: a vehicle that flies in the right direction but slower
# (wind, a speed limit of the autopilot) follows.
RELATIVE = 0.7
# A vehicle that follows gains at least 1/RESPONSE_S m/s in the direction of the error per m/s and second of
# it. Errors whose directions cancel by more than half are oscillation.
RESPONSE_S = 8.0
STEADY = 0.5
# Speed towards a position setpoint per metre left (PX4: MPC_XY_P 0.95; Copter: PSC_POSXY_P 1).
POSITION_GAIN_PER_S = 0.95
# Autopilots may add the speed of a moving position setpoint: filter time constant, and jump threshold.
FEED_FORWARD_S, JUMP_MPS = 0.5, 15.0
# After a longer gap in the measurements the comparison restarts.
MAX_GAP_S = 0.5
# A landing vehicle slower than this may be on the ground: the autopilot reports it seconds later.
CONTACT_MPS = 0.3
NOT_IN_AIR = (LandedState.ON_GROUND, LandedState.TAKING_OFF, LandedState.LANDING)
REASON = "vehicle does not follow setpoints (autopilot fence, another commander, or wind)"
ZERO: Vector3 = (0.0, 0.0, 0.0)


@dataclass(slots=True)
class _Lasting:
    """A residual above a rule's threshold.

    Attributes:
        since_ns, velocity_mps: when it began, and the velocity then.
        error_m, error_length_m: integrals of the velocity error since then, and of its magnitude.
    """

    since_ns: int
    velocity_mps: Vector3
    error_m: Vector3 = ZERO
    error_length_m: float = 0.0

    def answered(self, velocity: Vector3) -> bool:
        """Whether the vehicle oscillates about the setpoint or has accelerated towards it."""
        size_m = math.hypot(*self.error_m)
        if size_m < STEADY * self.error_length_m:
            return True
        gained = _minus(velocity, self.velocity_mps)
        towards = sum(g * e for g, e in zip(gained, self.error_m, strict=True)) / max(size_m, 1e-9)
        return towards >= size_m / RESPONSE_S


class SetpointMonitor:
    """Compares sent setpoints with the vehicle's motion.

    Attributes:
        residual_mps: distance of the newest measured velocity from that of a vehicle that follows.
        commanded_mps: the speed that the residual is compared with.
    """

    def __init__(self) -> None:
        self.residual_mps = self.commanded_mps = 0.0
        self._stamp_ns: int | None = None
        self._reset_count = 0
        self._goal: Vector3 | None = None
        self._slow = self._feed_forward = ZERO
        self._recent: deque[tuple[int, Vector3]] = deque()
        self._lasting: list[_Lasting | None] = [None] * len(RULES)

    def update(self, sent: Setpoint | None, state: VehicleState, *, landing: bool = False) -> str | None:
        """Process the newest measurement, if there is a new one.

        Args:
            sent: our setpoint that the vehicle flies, local NED; None: none.
            state: position and velocity with their stamp, `position_ns`.
            landing: the setpoints lead to the ground.

        Returns:
            Why the vehicle counts as steered by something else; None: it follows, or that is unknown.
        """
        velocity, stamp_ns = state.velocity_ned_mps, state.position_ns
        if sent is None or velocity is None or state.landed in NOT_IN_AIR or state.position_valid is False:
            self._clear()
            self._stamp_ns = None
            return None
        if stamp_ns == self._stamp_ns:
            return None
        dt_s = math.inf if self._stamp_ns is None else (stamp_ns - self._stamp_ns) / 1e9
        continuous = 0.0 < dt_s <= MAX_GAP_S and state.reset_count == self._reset_count
        self._stamp_ns, self._reset_count = stamp_ns, state.reset_count
        if not continuous:
            self._clear()
            self._slow, self._feed_forward, self._goal = velocity, ZERO, sent.position_ned_m
            self._recent.clear()
            return None
        settled = self._settled(sent, state, dt_s)
        self._slow = _filtered(self._slow, settled[0], dt_s / SLOWEST_S)
        self._recent.append((stamp_ns, settled[0]))
        while stamp_ns - self._recent[0][0] > DELAY_S * 1e9:
            self._recent.popleft()
        if landing and -CONTACT_MPS < velocity[2] < settled[0][2]:
            if math.hypot(*velocity) < CONTACT_MPS:
                self._clear()
                return None
            velocity = (velocity[0], velocity[1], settled[0][2])
        goals = (*settled, self._recent[0][1])
        self.residual_mps, goal = min((_distance(velocity, self._slow, one), one) for one in goals)
        self.commanded_mps = max(math.hypot(*settled[0]), math.hypot(*self._slow))
        if not self._judge(stamp_ns, velocity, _minus(goal, velocity), dt_s):
            return None
        return f"{REASON}: {math.hypot(*goal):.1f} m/s commanded, {math.hypot(*velocity):.1f} m/s flown"

    def _settled(self, sent: Setpoint, state: VehicleState, dt_s: float) -> tuple[Vector3, ...]:
        """Velocities a vehicle that follows may settle to; the first without feed-forward."""
        goal, before = sent.position_ned_m, self._goal
        self._goal = goal
        if sent.velocity_ned_mps is not None:
            return (sent.velocity_ned_mps,)
        if goal is None or state.position_ned_m is None:
            return (ZERO,)
        moved = ZERO if before is None else _scaled(_minus(goal, before), 1.0 / dt_s)
        if math.hypot(*moved) > JUMP_MPS:
            moved = ZERO
        self._feed_forward = _filtered(self._feed_forward, moved, dt_s / FEED_FORWARD_S)
        towards = _scaled(_minus(goal, state.position_ned_m), POSITION_GAIN_PER_S)
        return (towards, _minus(towards, _scaled(self._feed_forward, -1.0)))

    def _judge(self, stamp_ns: int, velocity: Vector3, error: Vector3, dt_s: float) -> bool:
        """Whether a rule's residual has lasted without a response of the vehicle."""
        ignored = False
        for index, (threshold_mps, lasting_s) in enumerate(RULES):
            lasting = self._lasting[index]
            if self.residual_mps < max(threshold_mps, RELATIVE * self.commanded_mps):
                self._lasting[index] = None
                continue
            if lasting is None:
                self._lasting[index] = _Lasting(stamp_ns, velocity)
                continue
            lasting.error_m = _minus(lasting.error_m, _scaled(error, -dt_s))
            lasting.error_length_m += math.hypot(*error) * dt_s
            if stamp_ns - lasting.since_ns >= lasting_s * 1e9:
                ignored |= not lasting.answered(velocity)
                self._lasting[index] = _Lasting(stamp_ns, velocity)
        return ignored

    def _clear(self) -> None:
        self.residual_mps = self.commanded_mps = 0.0
        self._lasting = [None] * len(RULES)


def _minus(a: Vector3, b: Vector3) -> Vector3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _scaled(a: Vector3, by: float) -> Vector3:
    return (a[0] * by, a[1] * by, a[2] * by)


def _filtered(value: Vector3, towards: Vector3, steps: float) -> Vector3:
    """A first-order filter step over a number of time constants."""
    return _minus(value, _scaled(_minus(value, towards), 1.0 - math.exp(-steps)))


def _distance(point: Vector3, a: Vector3, b: Vector3) -> float:
    """Distance of a point from the line segment between two others."""
    along, off = _minus(b, a), _minus(point, a)
    length_2 = sum(value * value for value in along)
    share = sum(x * y for x, y in zip(along, off, strict=True)) / length_2 if length_2 > 0.0 else 0.0
    return math.dist(off, _scaled(along, min(1.0, max(0.0, share))))
