"""Land on a marker: find it, hold above it, descend in a narrowing cone, and touch down on its pad.

Down to the final height the descent is guided by marker detections. The rest is blind: the marker no longer
fits into the image, and the autopilot's own landing goes straight down. If the marker is lost or missed
before that, the vehicle climbs and tries again, up to `attempts` times. Alternatively the autopilot flies its
precision landing with LANDING_TARGET messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from enum import StrEnum
from typing import Annotated, ClassVar

from companion.guidance.behaviour import (
    Behaviour,
    BehaviourContext,
    BehaviourOutput,
    ModeRequest,
    Outcome,
    Requirement,
)
from companion.guidance.behaviours.marker_search import MarkerSearch
from companion.guidance.command import BuildContext, Command, EnumArgument, GrammarError, Number, behaviour
from companion.guidance.motion import correction, position_and_yaw, towards
from companion.guidance.objects.closing_check import Approached
from companion.guidance.objects.tracked_object import Subject, TrackedObject
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, Vector3

# A pad is found when it was seen at most this long ago.
SIGHT_FRESH_S = 0.6
# Unseen for the first time, the descent pauses; for the second, it is aborted.
WAIT_AFTER_S, LOST_AFTER_S = 0.4, 2.2
# From higher than this the pad's position is used for longer without detections.
LOW_M, LOST_HIGH_AFTER_S = 3.5, 5.0
# The cone: allowed horizontal distance from the pad's centre, metres, on the ground and per metre of height.
CONE_M, CONE_PER_M = 0.10, 0.20
# Gain of the horizontal distance to the pad, 1/s, and of the velocity error: like an MPC_XY_VEL_P_ACC of 5,
# the maximum of PX4. Tuned in lockstep in gusts, with an acceleration limit of 5 m/s².
GAIN_PER_S, VELOCITY_ERROR_GAIN = 1.6, 1.75
DESCENT_MPS, SLOWEST_DESCENT_MPS, DESCENT_PER_M = 0.8, 0.2, 0.3
# Unseen, the vehicle climbs slowly: from higher up the image covers more.
RISE_MPS = 0.3
# Gain of the height error, 1/s, and its limit: gusts displace the vehicle vertically, too.
HEIGHT_GAIN_PER_S, HEIGHT_LEASH_M = 1.2, 0.5
# Blind below this: a marker of a pad's size no longer fits into the image.
FINAL_M = 0.45
# Tolerance for starting the blind part: distance, plus speed times the lookahead.
FINAL_ERROR_M, FINAL_LOOKAHEAD_S = 0.12, 0.35
# In gusts that is not reached: the tolerance grows to its double over this waiting time.
PATIENCE_S = 6.0
# Detected this far off and still this high during the blind part, the landing is aborted.
MISSED_M, MISSED_HEIGHT_M = 0.3, 0.45
CLIMB_MPS, CLIMB_M = 1.0, 2.5
TOUCHDOWN_MPS = 0.7
BASE_TIMEOUT_S, BLIND_TIMEOUT_S, LANDING_TIMEOUT_S, DELEGATED_TIMEOUT_S = 60.0, 5.0, 30.0, 150.0
# Farther from the pad than this, the autopilot has fallen back to a normal landing.
ON_PAD_M = 1.0


class _Phase(StrEnum):
    SEARCH = "searching for"
    DESCEND = "descending to"
    FINAL = "landing on"
    CLIMB = "climbing to search again for"
    DELEGATED = "autopilot landing on"


@behaviour("land-on-marker", "find a marker below, descend onto it in a narrowing cone, land and disarm")
class LandOnMarker(Command):
    renamed: ClassVar[Mapping[str, str]] = {"pad": "target"}
    identifier: Annotated[float, Number("id", "", 0.0, 1023.0, "id of the pad's marker")]
    method: Annotated[
        str,
        EnumArgument(
            "method", ("offboard", "autopilot"), "flown by setpoints, or by the autopilot with LANDING_TARGET"
        ),
    ] = "offboard"
    target: Annotated[str, EnumArgument("target", ("static", "moving"), "whether the pad moves")] = "static"
    attempts: Annotated[float, Number("attempts", "", 1.0, 10.0, "descents before giving up")] = 3.0
    search_m: Annotated[float, Number("search", "m", 0.0, 50.0, "radius of the search")] = 5.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 5.0, "horizontal, at most")] = 1.5

    def __post_init__(self) -> None:
        super().__post_init__()
        for key, value in (("id", self.identifier), ("attempts", self.attempts)):
            if value != int(value):
                raise GrammarError(f"land-on-marker: {key} must be a whole number, got {value:g}")
        if self.method == "autopilot" and self.target == "moving":
            raise GrammarError(
                "land-on-marker: method=autopilot needs target=static; a moving pad needs method=offboard"
            )

    def build(self, context: BuildContext) -> Behaviour:
        return LandOnMarkerBehaviour(
            int(self.identifier),
            by_autopilot=self.method == "autopilot",
            moving=self.target == "moving",
            attempts=int(self.attempts),
            search_m=self.search_m,
            speed_mps=self.speed_mps,
        )


class LandOnMarkerBehaviour(Behaviour):
    """Lands on the pad of one marker, and ends when the autopilot has disarmed.

    Args:
        identifier: of the marker; others on the same pad are used too.
        by_autopilot: the autopilot flies its precision landing with our LANDING_TARGET messages.
        moving: the pad may move slowly in a line; the blind part is flown with its velocity.
        attempts: descents before giving up.
        search_m: radius of the search.
        speed_mps: horizontal, at most.
    """

    name = "land-on-marker"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR, Requirement.MARKER})

    def __init__(
        self,
        identifier: int,
        *,
        by_autopilot: bool = False,
        moving: bool = False,
        attempts: int = 3,
        search_m: float = 5.0,
        speed_mps: float = 1.5,
    ) -> None:
        self._identifier, self._marker = identifier, Subject(marker_id=identifier)
        self._by_autopilot, self._moving = by_autopilot, moving
        self._attempts, self._search_m, self._speed_mps = attempts, search_m, speed_mps
        self._pad: TrackedObject | None = None
        self._target: LandingTarget | None = None
        self._phase = _Phase.SEARCH
        self._search: MarkerSearch | None = None
        self._started_down_m = self._goal_down_m = 0.0
        self._failures: list[str] = []
        self._begun_ns = 0
        self._blind_since_ns: int | None = None
        self._waiting_s = self._blocked_s = 0.0
        self._wanted_down_m = 0.0
        self._until_ns: float = math.inf
        self._touching = False
        self._height_m = math.nan

    def on_activate(self, context: BehaviourContext) -> None:
        position, _ = position_and_yaw(context.state)
        self._started_down_m = position[2]
        self._pad = self._target = self._blind_since_ns = None
        self._failures = []
        # Frames captured before the command are ignored: they may show another point.
        self._begun_ns = context.now_ns
        self._begin_search(context, position)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        position, _ = position_and_yaw(context.state)
        self._observe(context)
        if self._pad is not None:
            self._height_m = self._pad.position_at(context.now_ns)[2] - position[2]
        state = context.state
        if self._phase in (_Phase.FINAL, _Phase.DELEGATED):
            if not state.armed and state.landed is LandedState.ON_GROUND:
                return self._landed(context, position)
        elif not state.armed:
            return Outcome(False, f"disarmed while {self.status}")
        if context.now_ns > self._until_ns:
            return Outcome(False, f"timed out while {self.status}{self._so_far()}")
        return _STEPS[self._phase](self, dt_s, context, position)

    @property
    def approached(self) -> Approached | None:
        return None if self._pad is None else Approached(self._pad.detection, moves=self._moving)

    @property
    def landing_target(self) -> LandingTarget | None:
        return self._target if self._by_autopilot else None

    @property
    def landing(self) -> bool:
        return self._phase in (_Phase.DESCEND, _Phase.FINAL)

    @property
    def status(self) -> str:
        words = f"{self._phase.value} marker {self._identifier}"
        if self._phase is _Phase.SEARCH and self._search is not None:
            return f"{words}, {self._search.status}"
        return words if math.isnan(self._height_m) else f"{words}, {self._height_m:.1f} m above it"

    # --- detections

    def _observe(self, context: BehaviourContext) -> None:
        markers = context.markers
        self._blind_since_ns = (
            None if markers.fresh else self._blind_since_ns or max(context.now_ns, markers.captured_ns)
        )
        pad = context.below.of(self._marker)
        seen_ns = self._begun_ns if self._pad is None else self._pad.last_ns
        if pad is None or pad.position_ned_m is None or pad.last_ns <= seen_ns:
            return
        # Whether it moves is given: slow ones count as standing.
        self._pad = replace(pad, moving=self._moving)
        shown = [
            each
            for each in markers.targets
            if (each.pad, each.captured_ns) == (self._identifier, pad.last_ns)
        ]
        if shown:
            marker = min(shown, key=lambda each: each.range_sigma_m)
            self._target = LandingTarget(
                pad.last_ns, self._identifier, pad.position_ned_m, marker.pad_offset_frd_m, marker.size_m
            )

    def _unseen_s(self, now_ns: int) -> float:
        return math.inf if self._pad is None else self._pad.unseen_s(now_ns)

    # --- the phases

    def _enter(self, phase: _Phase, now_ns: int, timeout_s: float) -> None:
        self._phase = phase
        self._until_ns = now_ns + timeout_s * 1e9
        self._waiting_s = self._blocked_s = 0.0
        self._touching = False

    def _begin_search(self, context: BehaviourContext, position: Vector3) -> None:
        height_m = max(context.state.altitude_m or 0.0, 1.0)
        self._search = MarkerSearch(position, self._search_m, height_m)
        turns = self._search_m / height_m + 1.0
        self._enter(_Phase.SEARCH, context.now_ns, BASE_TIMEOUT_S + 12.0 * turns * self._search_m)

    def _searching(self, dt_s: float, context: BehaviourContext, position: Vector3) -> BehaviourOutput:
        now_ns = context.now_ns
        if self._unseen_s(now_ns) < SIGHT_FRESH_S:
            if self._by_autopilot:
                self._enter(_Phase.DELEGATED, now_ns, DELEGATED_TIMEOUT_S)
                return ModeRequest(FlightMode.PRECISION_LAND)
            height_m = max(self._height_m, 0.0)
            self._enter(_Phase.DESCEND, now_ns, BASE_TIMEOUT_S + 6.0 * height_m)
            self._wanted_down_m = position[2]
            return self._descending(dt_s, context, position)
        if self._blind_since_ns is not None:
            if now_ns - self._blind_since_ns > BLIND_TIMEOUT_S * 1e9:
                why = context.markers.fault or f"no camera frames for {BLIND_TIMEOUT_S:g} s"
                return Outcome(False, why + self._so_far())
            return Setpoint.brake(now_ns)
        search = self._search
        assert search is not None
        point = search.update(dt_s, position)
        if search.ended:
            return Outcome(
                False, f"marker {self._identifier} not found within {self._search_m:g} m{self._so_far()}"
            )
        return self._to(point, context, position, (0.0, 0.0), correction(point[2] - position[2], CLIMB_MPS))

    def _descending(self, dt_s: float, context: BehaviourContext, position: Vector3) -> BehaviourOutput:
        now_ns, pad = context.now_ns, self._pad
        assert pad is not None
        unseen_s = pad.unseen_s(now_ns)
        if unseen_s > (LOST_AFTER_S if self._height_m < LOW_M else LOST_HIGH_AFTER_S):
            why = f" ({context.markers.fault})" if context.markers.fault else ""
            return self._climb(f"lost {self._height_m:.1f} m above it{why}", context, position)
        point, drift = pad.position_at(now_ns), pad.velocity_at(now_ns)
        error_m = math.dist(point[:2], position[:2])
        if self._height_m <= FINAL_M:
            self._waiting_s += dt_s
            # An older position has drifted: the estimate's error changes by 0.3 m in 2 s.
            if unseen_s < WAIT_AFTER_S and self._well_above(error_m, context, drift):
                self._enter(_Phase.FINAL, now_ns, LANDING_TIMEOUT_S)
                return self._finishing(dt_s, context, position)
        allowed_m = CONE_M + CONE_PER_M * max(self._height_m, 0.0)
        inside = max(0.0, min(1.0, 2.0 * (allowed_m - error_m) / allowed_m))
        rate = min(DESCENT_MPS, SLOWEST_DESCENT_MPS + DESCENT_PER_M * max(self._height_m, 0.0)) * inside
        if unseen_s > WAIT_AFTER_S:
            rate = -RISE_MPS if self._height_m < LOW_M else 0.0
        elif self._height_m <= FINAL_M:
            rate = 0.0
        return self._to(point, context, position, drift, self._held(rate, dt_s, position))

    def _held(self, rate_mps: float, dt_s: float, position: Vector3) -> float:
        """Downward velocity that tracks a height setpoint which changes at a rate."""
        wanted_m = self._wanted_down_m + rate_mps * dt_s
        wanted_m = max(position[2] - HEIGHT_LEASH_M, min(position[2] + HEIGHT_LEASH_M, wanted_m))
        self._wanted_down_m = wanted_m
        return max(-CLIMB_MPS, min(DESCENT_MPS, rate_mps + HEIGHT_GAIN_PER_S * (wanted_m - position[2])))

    def _well_above(self, error_m: float, context: BehaviourContext, drift: tuple[float, float]) -> bool:
        north, east, _ = context.state.velocity_ned_mps or (0.0, 0.0, 0.0)
        speed = math.hypot(north - drift[0], east - drift[1])
        allowed_m = FINAL_ERROR_M * (1.0 + min(1.0, self._waiting_s / PATIENCE_S))
        return error_m + FINAL_LOOKAHEAD_S * speed < allowed_m

    def _finishing(self, dt_s: float, context: BehaviourContext, position: Vector3) -> BehaviourOutput:
        now_ns, pad = context.now_ns, self._pad
        assert pad is not None
        point, drift = pad.position_at(now_ns), pad.velocity_at(now_ns)
        error_m = math.dist(point[:2], position[:2])
        seen = pad.unseen_s(now_ns) < WAIT_AFTER_S
        if seen and error_m > MISSED_M and self._height_m > MISSED_HEIGHT_M and not self._touching:
            return self._climb(f"{error_m:.1f} m off before touchdown", context, position)
        on_ground = context.state.landed is LandedState.ON_GROUND
        if self._touching or on_ground:
            self._touching |= on_ground
            return ModeRequest(FlightMode.LAND)
        return self._to(point, context, position, drift, TOUCHDOWN_MPS)

    def _climb(self, why: str, context: BehaviourContext, position: Vector3) -> BehaviourOutput:
        self._failures.append(why)
        # Not much higher than the start: there the marker may be too small to detect.
        self._goal_down_m = min(position[2], max(self._started_down_m, position[2] - 2 * CLIMB_M))
        self._enter(_Phase.CLIMB, context.now_ns, BASE_TIMEOUT_S)
        return self._climbing(0.0, context, position)

    def _climbing(self, dt_s: float, context: BehaviourContext, position: Vector3) -> BehaviourOutput:
        now_ns, pad = context.now_ns, self._pad
        left_m = position[2] - self._goal_down_m
        blocked = context.sent is not None and (context.sent.velocity_ned_mps or (0, 0, 0))[2] > -0.05
        # A climb also ends where the envelope stops it.
        self._blocked_s = self._blocked_s + dt_s if blocked else 0.0
        if left_m < 0.3 or self._blocked_s > 3.0:
            if len(self._failures) >= self._attempts:
                return Outcome(False, f"gave up{self._so_far()}")
            if pad is not None and pad.unseen_s(now_ns) > LOST_AFTER_S:
                # Discard the position: it may have been wrong.
                self._pad = self._target = None
                context.below.forget(self._marker)
            self._begin_search(context, position)
            return self._searching(dt_s, context, position)
        point = position if pad is None else pad.position_at(now_ns)
        drift = (0.0, 0.0) if pad is None else pad.velocity_at(now_ns)
        if self._unseen_s(now_ns) > 2 * LOST_AFTER_S:
            point, drift = position, (0.0, 0.0)
        return self._to(point, context, position, drift, -CLIMB_MPS)

    def _delegated(self, dt_s: float, context: BehaviourContext, position: Vector3) -> BehaviourOutput:
        return ModeRequest(FlightMode.PRECISION_LAND)

    # --- ends and helpers

    def _landed(self, context: BehaviourContext, position: Vector3) -> Outcome:
        assert self._pad is not None
        beside_m = math.dist(self._pad.position_at(context.now_ns)[:2], position[:2])
        where = f"{beside_m:.2f} m beside where marker {self._identifier} was last seen"
        if self._by_autopilot and beside_m > ON_PAD_M:
            return Outcome(False, f"the autopilot landed elsewhere: {where}")
        return Outcome(True, f"landed and disarmed, {where}")

    def _so_far(self) -> str:
        if not self._failures:
            return ""
        times = "once" if len(self._failures) == 1 else f"{len(self._failures)} times"
        return f"; descended {times} without landing: {', then '.join(self._failures)}"

    def _to(
        self,
        point: Vector3,
        context: BehaviourContext,
        position: Vector3,
        drift: tuple[float, float],
        down_mps: float,
    ) -> Setpoint:
        """Setpoint towards a horizontal point that moves with `drift`, and down (negative: up) at a rate."""
        north, east = towards(point, position, GAIN_PER_S, self._speed_mps)
        wanted = (north + drift[0], east + drift[1])
        now_north, now_east, _ = context.state.velocity_ned_mps or (*wanted, 0.0)
        north = wanted[0] + VELOCITY_ERROR_GAIN * (wanted[0] - now_north)
        east = wanted[1] + VELOCITY_ERROR_GAIN * (wanted[1] - now_east)
        top_mps = self._speed_mps + math.hypot(*drift)
        scale = min(1.0, top_mps / max(math.hypot(north, east), 1e-6))
        velocity = (north * scale, east * scale, down_mps)
        return Setpoint.velocity(velocity, context.now_ns, yaw_rate_radps=0.0)


_STEPS: dict[_Phase, Callable[[LandOnMarkerBehaviour, float, BehaviourContext, Vector3], BehaviourOutput]] = {
    _Phase.SEARCH: LandOnMarkerBehaviour._searching,
    _Phase.DESCEND: LandOnMarkerBehaviour._descending,
    _Phase.FINAL: LandOnMarkerBehaviour._finishing,
    _Phase.CLIMB: LandOnMarkerBehaviour._climbing,
    _Phase.DELEGATED: LandOnMarkerBehaviour._delegated,
}
