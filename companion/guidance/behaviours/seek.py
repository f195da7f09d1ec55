"""Turn on the spot to see what there is of a class, then face the surest object; a gimbal may sweep too."""

from __future__ import annotations

import math

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.behaviours.confirmation import (
    FACING_TIMEOUT_S,
    SIGHT_FRESH_S,
    Candidates,
    DetectionConfirmer,
    YawAligner,
)
from companion.guidance.gimbal.sweep import GimbalSweep
from companion.guidance.motion import in_degrees, laps_text, position_and_yaw, stay_at
from companion.guidance.targets.target import DOUBTED, Target
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

BLIND_TIMEOUT_S = 5.0
# A turn may take this many times what it should, plus the looks on the way.
SLOWEST_TURN = 3.0
# Time is given to face so many candidates that turn out to be nothing.
MOST_CANDIDATES = 5
# Nose and gimbal are so near to an object's direction that the camera sees the object.
POINTED_RAD = math.radians(8.0)
# A gimbal that swept in vain is let back to where it looked before, so long at most.
BACK_TIMEOUT_S = 5.0


class SeekBehaviour(Behaviour):
    """Turns up to `laps` (counted from the real heading), and ends facing the object.

    Args:
        whole_turn: see all around first (or as far as `laps` goes), then face the best of what was found, the
            next best where it is not there any more; later finds are faced at once. False: the first find is
            faced at once.
        sweep: how the gimbal moves meanwhile, slowing the turn as it must; found, the gimbal looks at the
            object. None: it is left alone.
    """

    name = "seek"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR, Requirement.PERCEPTION})

    def __init__(
        self,
        class_name: str,
        *,
        laps: float = 2.0,
        rate_radps: float = 0.5,
        confidence: float = 0.4,
        clockwise: bool = True,
        whole_turn: bool = False,
        sweep: GimbalSweep | None = None,
    ) -> None:
        self._sweep = sweep
        self._vain = ""
        self._vain_until_ns: float = 0
        self._begun_ns = 0
        if sweep is not None:
            self.requirements = SeekBehaviour.requirements | {Requirement.GIMBAL}
            self.gimbal_pitches_rad = (0.0, sweep.end_rad)
            rate_radps = min(rate_radps, sweep.turn_rate_radps)
        self.class_names = (class_name,)
        self._class_name = class_name
        self._laps = laps
        self._turn = 1.0 if clockwise else -1.0
        self._rate_radps = rate_radps
        self._sightings = DetectionConfirmer((class_name,), confidence)
        self._candidates = Candidates()
        self._compare_at_rad = min(laps, 1.0) * math.tau if whole_turn else 0.0
        self._compared = False
        self._place: Vector3 = (0.0, 0.0, 0.0)
        self._yaw_rad = 0.0
        self._turned_rad = 0.0
        self._give_up_ns: float = 0
        self._blind_since_ns: int | None = None
        self._gaze: YawAligner | None = None
        self._pointed = False

    def on_activate(self, context: BehaviourContext) -> None:
        self._place, self._yaw_rad = position_and_yaw(context.state)
        self._turned_rad = 0.0
        self._sightings.reset(context.now_ns)
        self._candidates, self._compared = Candidates(), False
        self._gaze = self._blind_since_ns = None
        self._vain, self._begun_ns = "", context.now_ns
        gimbal = context.state.gimbal
        if self._sweep is not None and gimbal is not None and gimbal.pitch_rad is not None:
            self._sweep.begin(gimbal.pitch_rad)  # else the first step says what is missing
        limit_s = SLOWEST_TURN * self._laps * math.tau / self._rate_radps + MOST_CANDIDATES * FACING_TIMEOUT_S
        self._give_up_ns = context.now_ns + limit_s * 1e9

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        now_ns = context.now_ns
        position, yaw_rad = position_and_yaw(context.state)
        self._turned_rad += self._turn * wrap_angle(yaw_rad - self._yaw_rad)
        self._yaw_rad = yaw_rad
        stay = stay_at(self._place, position)

        if self._sweep is not None and (why := self._hindered(self._sweep, context)) is not None:
            return Outcome(False, why)
        if self._vain:
            return self._look_back(dt_s, context, stay)
        if now_ns > self._give_up_ns:
            return Outcome(False, f"seek timed out: {self._turned_rad / math.tau:.1f} laps turned")
        if not context.perception_fresh:
            return self._wait_blind(context, stay)
        self._blind_since_ns = None
        seen = self._sightings.fresh(context)
        if self._gaze is not None:
            self._gaze.follow(seen)
        else:
            self._gaze = self._choose(seen, now_ns)
        if self._gaze is not None:
            if self._sweep is not None:
                self._sweep.towards(_within_reach(self._gaze.target, context), dt_s, _gimbal_pitch(context))
            return self._face(self._gaze, context, yaw_rad, stay)
        if abs(self._turned_rad) >= self._laps * math.tau:
            why = f": {DOUBTED}" if self._sightings.doubted else ""
            self._vain = f"no {self._class_name} seen in {laps_text(self._laps)}{why}"
            self._vain_until_ns = now_ns + BACK_TIMEOUT_S * 1e9
            return self._look_back(dt_s, context, stay)
        waiting = now_ns < self._sightings.look_until_ns
        if self._sweep is not None and not waiting:
            self._sweep.step(dt_s, _gimbal_pitch(context))
            waiting = self._sweep.waiting
        rate = 0.0 if waiting else self._turn * self._rate_radps
        return Setpoint.velocity(stay, now_ns, yaw_rate_radps=rate)

    def _choose(self, seen: list[Target], now_ns: int) -> YawAligner | None:
        """Take what new frames show; what to face now."""
        found = self._sightings.agreed(seen, now_ns)
        if found:
            self._sightings.look_until_ns = now_ns  # what the turn waited for has come
        self._candidates.add(seen, found)
        self._compared = self._compared or abs(self._turned_rad) >= self._compare_at_rad
        best = self._candidates.best() if self._compared else None
        if best is None:
            return None
        self._pointed = now_ns - best.captured_ns <= SIGHT_FRESH_S * 1e9
        return YawAligner(best, now_ns)

    @property
    def gimbal_aim(self) -> GimbalAim | None:
        return None if self._sweep is None else self._sweep.aim

    @property
    def status(self) -> str:
        if self._gaze is not None:
            return f"facing the {self._class_name} at {in_degrees(self._gaze.target.bearing_rad)}°"
        seen = f", {len(self._candidates)} found" if len(self._candidates) else ""
        return f"looking for a {self._class_name}, {max(0.0, self._turned_rad) / math.tau:.1f} laps{seen}"

    def _hindered(self, sweep: GimbalSweep, context: BehaviourContext) -> str | None:
        """Why the gimbal does not do what is asked, in words; None: it does."""
        # At the first turn it is still told of what came before.
        if context.gimbal.problem and context.now_ns > self._begun_ns:
            return f"seek lost the gimbal: {context.gimbal.problem}"
        gimbal = context.state.gimbal
        if gimbal is None:
            return "seek lost the gimbal: none answers"
        if gimbal.pitch_rad is None:
            # An attitude that says what nobody can read is withdrawn, and so is all after a restart.
            why = gimbal.why_not_looking(context.now_ns)
            return f"seek lost the gimbal: {why}"
        return None if self._vain else sweep.stuck(gimbal.pitch_rad)

    def _look_back(self, dt_s: float, context: BehaviourContext, stay: Vector3) -> BehaviourOutput:
        """Found nothing: the gimbal goes back to where it looked before."""
        sweep, now_ns = self._sweep, context.now_ns
        if sweep is None or now_ns > self._vain_until_ns or sweep.back(dt_s, _gimbal_pitch(context)):
            return Outcome(False, self._vain)
        return Setpoint.velocity(stay, now_ns, yaw_rate_radps=0.0)

    def _face(
        self, gaze: YawAligner, context: BehaviourContext, yaw_rad: float, stay: Vector3
    ) -> BehaviourOutput:
        now_ns = context.now_ns
        pitch_off_rad = 0.0
        if self._sweep is not None:
            pitch_off_rad = abs(_within_reach(gaze.target, context) - _gimbal_pitch(context))
        if not self._pointed:
            self._pointed = max(gaze.off_rad(yaw_rad), pitch_off_rad) <= POINTED_RAD
            gaze.expect_later(now_ns)
        if gaze.lost(now_ns):
            # The next best, or the turn goes on from here.
            self._gaze = None
            self._candidates.drop(gaze.target)
            self._sightings.forget()
            return Setpoint.velocity(stay, now_ns, yaw_rate_radps=0.0)
        if gaze.faced(yaw_rad, now_ns) and pitch_off_rad <= POINTED_RAD:
            return Outcome(True, found_text(gaze.target))
        return Setpoint.velocity(stay, now_ns, yaw_rad=gaze.target.bearing_rad)

    def _wait_blind(self, context: BehaviourContext, stay: Vector3) -> BehaviourOutput:
        """Nothing is seen at all: turning on would skip a part of the circle."""
        now_ns = context.now_ns
        if self._blind_since_ns is None:
            self._blind_since_ns = now_ns
        if now_ns - self._blind_since_ns > BLIND_TIMEOUT_S * 1e9:
            why = context.why_blind("nothing came from the detector")
            return Outcome(False, f"{why} for {BLIND_TIMEOUT_S:g} s")
        return Setpoint.velocity(stay, now_ns, yaw_rate_radps=0.0)


def _gimbal_pitch(context: BehaviourContext) -> float:
    """Radians above the horizon. Raises RuntimeError where a requirement was not checked."""
    gimbal = context.state.gimbal
    if gimbal is None or gimbal.pitch_rad is None:
        raise RuntimeError("where the gimbal looks is unknown: the behaviour must require GIMBAL")
    return gimbal.pitch_rad


def _within_reach(target: Target, context: BehaviourContext) -> float:
    """The pitch that brings the camera nearest to a target, radians above the horizon."""
    gimbal = context.state.gimbal
    pitch_rad = target.elevation_rad - context.gimbal.camera_pitch_rad
    return pitch_rad if gimbal is None else gimbal.nearest_pitch_rad(pitch_rad)


def found_text(target: Target) -> str:
    """What was found, and where."""
    range_text = "range unknown" if target.position_ned_m is None else f"{target.ground_range_m:.1f} m away"
    return f"found a {target.class_name}: bearing {in_degrees(target.bearing_rad)}°, {range_text}"
