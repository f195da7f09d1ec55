"""Seek: turn on the spot, optionally with a gimbal sweep, then face the best object of a class."""

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
from companion.guidance.gimbal.pitch import GimbalSweep
from companion.guidance.motion import in_degrees, laps_text, position_and_yaw, stay_at
from companion.guidance.objects.target import DOUBTED, Target
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

BLIND_TIMEOUT_S = 5.0
# Time-out of a turn relative to its nominal time, plus the time to face candidates.
SLOWEST_TURN = 3.0
# Number of false candidates that the time-out allows for.
MOST_CANDIDATES = 5
# Within this angle of nose and gimbal the camera sees the object.
POINTED_RAD = math.radians(8.0)
# Time-out for returning the gimbal after an unsuccessful sweep.
BACK_TIMEOUT_S = 5.0


class SeekBehaviour(Behaviour):
    """Turns up to `laps` (measured by the heading), and ends facing the object.

    Args:
        whole_turn: complete one turn first (or `laps`, if less), then face the best find, and the next best
            if that is lost; later finds are faced at once. False: the first find is faced at once.
        sweep: the gimbal's motion during the turn, which limits the turn rate; it then points at the find.
            None: the gimbal is not used.
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
        self._failure = ""
        self._return_until_ns: float = 0
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
        self._confirmer = DetectionConfirmer((class_name,), confidence)
        self._candidates = Candidates()
        self._compare_at_rad = min(laps, 1.0) * math.tau if whole_turn else 0.0
        self._compared = False
        self._point: Vector3 = (0.0, 0.0, 0.0)
        self._yaw_rad = 0.0
        self._turned_rad = 0.0
        self._give_up_ns: float = 0
        self._blind_since_ns: int | None = None
        self._aligner: YawAligner | None = None
        self._pointed = False

    def on_activate(self, context: BehaviourContext) -> None:
        self._point, self._yaw_rad = position_and_yaw(context.state)
        self._turned_rad = 0.0
        self._confirmer.reset(context.now_ns)
        self._candidates, self._compared = Candidates(), False
        self._aligner = self._blind_since_ns = None
        self._failure, self._begun_ns = "", context.now_ns
        gimbal = context.state.gimbal
        if self._sweep is not None and gimbal is not None and gimbal.pitch_rad is not None:
            self._sweep.begin(gimbal.pitch_rad)  # else the first update reports what is missing
        limit_s = SLOWEST_TURN * self._laps * math.tau / self._rate_radps + MOST_CANDIDATES * FACING_TIMEOUT_S
        self._give_up_ns = context.now_ns + limit_s * 1e9

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        now_ns = context.now_ns
        position, yaw_rad = position_and_yaw(context.state)
        self._turned_rad += self._turn * wrap_angle(yaw_rad - self._yaw_rad)
        self._yaw_rad = yaw_rad
        stay = stay_at(self._point, position)

        if self._sweep is not None and (why := self._hindered(self._sweep, context)) is not None:
            return Outcome(False, why)
        if self._failure:
            return self._look_back(dt_s, context, stay)
        if now_ns > self._give_up_ns:
            return Outcome(False, f"seek timed out: {self._turned_rad / math.tau:.1f} laps turned")
        if not context.perception_fresh:
            return self._wait_blind(context, stay)
        self._blind_since_ns = None
        seen = self._confirmer.fresh(context)
        if self._aligner is not None:
            self._aligner.follow(seen)
        else:
            self._aligner = self._choose(seen, now_ns)
        if self._aligner is not None:
            if self._sweep is not None:
                self._sweep.towards(
                    _within_reach(self._aligner.target, context), dt_s, _gimbal_pitch(context)
                )
            return self._face(self._aligner, context, yaw_rad, stay)
        if abs(self._turned_rad) >= self._laps * math.tau:
            why = f": {DOUBTED}" if self._confirmer.doubted else ""
            self._failure = f"no {self._class_name} found in {laps_text(self._laps)}{why}"
            self._return_until_ns = now_ns + BACK_TIMEOUT_S * 1e9
            return self._look_back(dt_s, context, stay)
        waiting = now_ns < self._confirmer.look_until_ns
        if self._sweep is not None and not waiting:
            self._sweep.step(dt_s, _gimbal_pitch(context))
            waiting = self._sweep.waiting
        rate = 0.0 if waiting else self._turn * self._rate_radps
        return Setpoint.velocity(stay, now_ns, yaw_rate_radps=rate)

    def _choose(self, seen: list[Target], now_ns: int) -> YawAligner | None:
        """Process new detections; returns the aligner for the find to face now, if any."""
        found = self._confirmer.agreed(seen, now_ns)
        if found:
            self._confirmer.look_until_ns = now_ns  # the awaited detections have arrived
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
        if self._aligner is not None:
            return f"facing the {self._class_name} at {in_degrees(self._aligner.target.bearing_rad)}°"
        seen = f", {len(self._candidates)} found" if len(self._candidates) else ""
        return f"searching for a {self._class_name}, {max(0.0, self._turned_rad) / math.tau:.1f} laps{seen}"

    def _hindered(self, sweep: GimbalSweep, context: BehaviourContext) -> str | None:
        """Why the gimbal does not follow, in words; None: it does."""
        # The first update still shows the previous owner's problem.
        if context.gimbal.problem and context.now_ns > self._begun_ns:
            return f"seek lost the gimbal: {context.gimbal.problem}"
        gimbal = context.state.gimbal
        if gimbal is None:
            return "gimbal manager not responding"
        if gimbal.pitch_rad is None:
            # The attitude is cleared when its frame is unknown, and after a restart of the gimbal.
            why = gimbal.why_not_looking(context.now_ns)
            return f"seek lost the gimbal: {why}"
        return None if self._failure else sweep.stuck(gimbal.pitch_rad)

    def _look_back(self, dt_s: float, context: BehaviourContext, stay: Vector3) -> BehaviourOutput:
        """Nothing found: return the gimbal to its initial pitch, then end."""
        sweep, now_ns = self._sweep, context.now_ns
        if sweep is None or now_ns > self._return_until_ns or sweep.back(dt_s, _gimbal_pitch(context)):
            return Outcome(False, self._failure)
        return Setpoint.velocity(stay, now_ns, yaw_rate_radps=0.0)

    def _face(
        self, aligner: YawAligner, context: BehaviourContext, yaw_rad: float, stay: Vector3
    ) -> BehaviourOutput:
        now_ns = context.now_ns
        pitch_off_rad = 0.0
        if self._sweep is not None:
            pitch_off_rad = abs(_within_reach(aligner.target, context) - _gimbal_pitch(context))
        if not self._pointed:
            self._pointed = max(aligner.off_rad(yaw_rad), pitch_off_rad) <= POINTED_RAD
            aligner.expect_later(now_ns)
        if aligner.lost(now_ns):
            # Face the next best, or continue the turn.
            self._aligner = None
            self._candidates.drop(aligner.target)
            self._confirmer.forget()
            return Setpoint.velocity(stay, now_ns, yaw_rate_radps=0.0)
        if aligner.faced(yaw_rad, now_ns) and pitch_off_rad <= POINTED_RAD:
            return Outcome(True, found_text(aligner.target))
        return Setpoint.velocity(stay, now_ns, yaw_rad=aligner.target.bearing_rad)

    def _wait_blind(self, context: BehaviourContext, stay: Vector3) -> BehaviourOutput:
        """Perception is stale: stop turning, so that no part of the circle is skipped."""
        now_ns = context.now_ns
        if self._blind_since_ns is None:
            self._blind_since_ns = now_ns
        if now_ns - self._blind_since_ns > BLIND_TIMEOUT_S * 1e9:
            why = context.perception_fault("no detections received")
            return Outcome(False, f"{why} for {BLIND_TIMEOUT_S:g} s")
        return Setpoint.velocity(stay, now_ns, yaw_rate_radps=0.0)


def _gimbal_pitch(context: BehaviourContext) -> float:
    """The gimbal's pitch, radians above the horizon. Raises RuntimeError if it is unknown."""
    gimbal = context.state.gimbal
    if gimbal is None or gimbal.pitch_rad is None:
        raise RuntimeError("gimbal attitude unknown: the behaviour must require GIMBAL")
    return gimbal.pitch_rad


def _within_reach(target: Target, context: BehaviourContext) -> float:
    """The reachable gimbal pitch nearest to a target, radians above the horizon."""
    gimbal = context.state.gimbal
    pitch_rad = target.elevation_rad - context.gimbal.camera_pitch_rad
    return pitch_rad if gimbal is None else gimbal.nearest_pitch_rad(pitch_rad)


def found_text(target: Target) -> str:
    """A find in words: class, bearing, range."""
    range_text = "range unknown" if target.position_ned_m is None else f"{target.ground_range_m:.1f} m away"
    return f"found a {target.class_name}: bearing {in_degrees(target.bearing_rad)}°, {range_text}"
