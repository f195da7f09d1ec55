"""Seek: turn on the spot, or fly over an area, until an object of a class is found; then face it.

A find is an object that is `certain`. It is verified when the vehicle faces it and still sees it.
"""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.behaviours.path_flight import PathFlight
from companion.guidance.command import (
    BuildContext,
    ClassName,
    Command,
    EnumArgument,
    GrammarError,
    Number,
    behaviour,
)
from companion.guidance.gimbal.pitch import LEAST_SWEEP_DEG, USUAL_RATE_DPS, GimbalSweep
from companion.guidance.motion import Lasting, Standing, in_degrees, laps_text, position_and_yaw
from companion.guidance.objects.target import DOUBTED
from companion.guidance.objects.tracked_object import FOUND_FRAMES, TrackedObject
from companion.guidance.search_pattern import Footprint, expanding_square, field_of_view_rad, lawnmower
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

# Finds whose confidence is within this of the best are equal: the nearest is selected.
EQUAL_CONFIDENCE = 0.1
# At a first detection a turn pauses this long for more.
LOOK_S = 1.0
# Facing the object: tolerance, duration, time-out, and when it counts as lost.
FACING_RAD = math.radians(4.0)
FACING_S = 0.4
FACING_TIMEOUT_S = 12.0
SIGHT_LOST_S = 2.0
# What is faced must have been seen within this time.
SIGHT_FRESH_S = 0.7
# Within this angle of nose and gimbal the camera sees the object.
POINTED_RAD = math.radians(8.0)
BLIND_TIMEOUT_S = 5.0
# How long to look at a point before the turn, once the nose points there; and time for half a turn.
FIRST_S, FIRST_LIMIT_S = 3.0, 12.0
# Time-out of a turn relative to its nominal time, plus the time to face false finds.
SLOWEST_TURN = 3.0
MOST_FALSE_FINDS = 5
# Time-out for returning the gimbal after an unsuccessful sweep.
BACK_TIMEOUT_S = 5.0


@behaviour("seek", "turn, or search an area, until an object of the class is found; then face it")
class Seek(Command):
    class_name: Annotated[str, ClassName("class", "what to search for")]
    laps: Annotated[float, Number("laps", "", 0.25, 20.0, "turns before giving up")] = 2.0
    rate_radps: Annotated[float, Number("rate", "rad/s", 0.05, 1.0, "how fast to turn")] = 0.5
    confidence: Annotated[float, Number("confidence", "", 0.05, 1.0, "minimum confidence")] = 0.4
    direction: Annotated[
        str, EnumArgument("direction", ("clockwise", "counterclockwise"), "seen from above")
    ] = "clockwise"
    pattern: Annotated[
        str, EnumArgument("pattern", ("turn", "square", "lawnmower"), "on the spot, or over an area about it")
    ] = "turn"
    radius_m: Annotated[
        float | None, Number("radius", "m", 1.0, 500.0, "half a side of the expanding square")
    ] = None
    width_m: Annotated[
        float | None, Number("width", "m", 1.0, 1000.0, "of the lawnmower's area, west to east")
    ] = None
    height_m: Annotated[
        float | None, Number("height", "m", 1.0, 1000.0, "of the lawnmower's area, south to north")
    ] = None
    spacing_m: Annotated[
        float | None,
        Number("spacing", "m", 1.0, 200.0, "between strips; default: from the camera's footprint"),
    ] = None
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "over an area, at most")] = 2.0
    sweep_deg: Annotated[
        float | None,
        Number("sweep", "deg", -90.0, 90.0, "gimbal sweep between level and this pitch; below is negative"),
    ] = None
    sweep_rate_dps: Annotated[
        float, Number("sweep_rate", "deg/s", 2.0, 60.0, "of the gimbal; slower also slows the turn")
    ] = USUAL_RATE_DPS

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sweep_deg is not None and abs(self.sweep_deg) < LEAST_SWEEP_DEG:
            raise GrammarError(
                f"seek: sweep must be {LEAST_SWEEP_DEG:g} deg or more from level, got {self.sweep_deg:g}"
            )
        if self.sweep_deg is not None and self.pattern != "turn":
            raise GrammarError(f"seek: pattern={self.pattern} does not use sweep")
        if self.sweep_deg is None and self.sweep_rate_dps != USUAL_RATE_DPS:
            raise GrammarError("seek: sweep_rate needs sweep")
        given = {
            "radius": self.radius_m,
            "width": self.width_m,
            "height": self.height_m,
            "spacing": self.spacing_m,
        }
        needed = {"turn": (), "square": ("radius",), "lawnmower": ("width", "height")}[self.pattern]
        allowed = (*needed, "spacing") if needed else ()
        for key, value in given.items():
            if value is None and key in needed:
                raise GrammarError(f"seek: pattern={self.pattern} needs {' and '.join(needed)}")
            if value is not None and key not in allowed:
                raise GrammarError(f"seek: pattern={self.pattern} does not use {key}")

    def build(self, context: BuildContext) -> Behaviour:
        if self.pattern != "turn":
            return SearchBehaviour(self, context.footprint)
        sweep = None
        if self.sweep_deg is not None:
            sweep_rad, rate_radps = math.radians(self.sweep_deg), math.radians(self.sweep_rate_dps)
            sweep = GimbalSweep(sweep_rad, rate_radps, field_of_view_rad(context.footprint))
        return SeekBehaviour(self, whole_turn=True, sweep=sweep)


class Facing:
    """Turns the nose to an object.

    Attributes:
        object: as it was seen last without ambiguity.
        faced: the nose has pointed at it for `FACING_S`, and it is still seen.
        lost: it is not seen where the camera points, or facing it timed out.
    """

    def __init__(self, found: TrackedObject, now_ns: int) -> None:
        self.object = found
        self.faced = self.lost = False
        self._begun_ns = now_ns
        self._pointed = found.unseen_s(now_ns) <= SIGHT_FRESH_S
        self._expected_ns = found.last_ns
        self._facing = Lasting()

    @property
    def bearing_rad(self) -> float:
        """Where to turn the nose."""
        return self.object.detection.bearing_rad

    def update(self, context: BehaviourContext, pitch_off_rad: float = 0.0) -> None:
        """Set `object`, `faced` and `lost`. `pitch_off_rad`: between the gimbal and the object."""
        now_ns = context.now_ns
        known = context.objects.now(self.object)
        if not known.ambiguous:
            self.object = known
        _, yaw_rad = position_and_yaw(context.state)
        seen = self.object.detection
        # At an elevation a difference of bearings is a smaller angle.
        off_rad = abs(wrap_angle(seen.bearing_rad - yaw_rad)) * math.cos(seen.elevation_rad)
        if not self._pointed:
            self._pointed = max(off_rad, pitch_off_rad) <= POINTED_RAD
            self._expected_ns = now_ns
        expected_s = (now_ns - max(self.object.last_ns, self._expected_ns)) / 1e9
        self.lost = expected_s > SIGHT_LOST_S or now_ns - self._begun_ns > FACING_TIMEOUT_S * 1e9
        facing = self.object.unseen_s(now_ns) <= SIGHT_FRESH_S and off_rad <= FACING_RAD
        self.faced = self._facing.held_s(facing, now_ns) >= FACING_S and pitch_off_rad <= POINTED_RAD


class BlindTime:
    """How long nothing was seen: a vehicle that stands meanwhile passes nothing unseen."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s, self._blind = limit_s, Lasting()

    def outcome(self, context: BehaviourContext) -> Outcome | None:
        """The end of the behaviour, if perception has been stale for the limit."""
        if self._blind.held_s(not context.perception_fresh, context.now_ns) <= self._limit_s:
            return None
        why = context.perception_fault("no detections received")
        return Outcome(False, f"{why} for {self._limit_s:g} s")


def found_text(found: TrackedObject, context: BehaviourContext) -> str:
    """A find in words: class, bearing, range."""
    bearing = in_degrees(found.detection.bearing_rad)
    return f"found a {found.class_name}: bearing {bearing}°, {range_text(found, context)}"


class SeekBehaviour(Behaviour):
    """Turns up to `laps` (measured by the heading), and ends facing the object.

    Args:
        whole_turn: complete one turn first (or `laps`, if less), then face the best find, and the next best
            if that is lost; later finds are faced at once. False: the first find is faced at once.
        sweep: the gimbal's motion during the turn, which limits the turn rate; it then points at the find.
            None: the gimbal is not used.
        first_at: a point (local NED) to look at before the turn; None: none.

    Attributes:
        looks_first: it looks there, and has not turned yet.
    """

    name = "seek"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR, Requirement.PERCEPTION})

    def __init__(
        self,
        command: Seek,
        *,
        whole_turn: bool = False,
        sweep: GimbalSweep | None = None,
        first_at: Vector3 | None = None,
    ) -> None:
        self._first_at = first_at
        self._command, self._sweep, self._rate_radps = command, sweep, command.rate_radps
        if sweep is not None:
            self.requirements = SeekBehaviour.requirements | {Requirement.GIMBAL}
            self.gimbal_pitches_rad = (0.0, sweep.end_rad)
            self._rate_radps = min(command.rate_radps, sweep.turn_rate_radps)
        self.class_names = (command.class_name,)
        self._turn = 1.0 if command.direction == "clockwise" else -1.0
        self._compare_at_rad = min(command.laps, 1.0) * math.tau if whole_turn else 0.0
        self._begin(0, 0.0)

    def _begin(self, now_ns: int, yaw_rad: float) -> None:
        self._begun_ns, self._standing, self._yaw_rad = now_ns, Standing(), yaw_rad
        turn_s = self._command.laps * math.tau / self._rate_radps
        limit_s = SLOWEST_TURN * turn_s + MOST_FALSE_FINDS * FACING_TIMEOUT_S
        self.looks_first, self._pointed_ns = self._first_at is not None, math.inf
        self._give_up_ns = now_ns + limit_s * 1e9
        self._turned_rad = 0.0
        self._compared = self._doubted = False
        # By object id, when it was certain last: a turn takes longer than the table shows an object.
        self._finds: dict[int, TrackedObject] = {}
        self._facing: Facing | None = None
        self._seen_ns, self._look_until_ns = 0, 0.0
        self._blind = BlindTime(BLIND_TIMEOUT_S)
        self._failure, self._return_until_ns = "", 0.0

    def on_activate(self, context: BehaviourContext) -> None:
        self._begin(context.now_ns, position_and_yaw(context.state)[1])
        gimbal = context.state.gimbal
        if self._sweep is not None and gimbal is not None and gimbal.pitch_rad is not None:
            self._sweep.begin(gimbal.pitch_rad)  # else the first update reports what is missing

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        now_ns = context.now_ns
        position, yaw_rad = position_and_yaw(context.state)
        self._turned_rad += self._turn * wrap_angle(yaw_rad - self._yaw_rad)
        self._yaw_rad = yaw_rad
        stay = self._standing.velocity(context.state, dt_s)
        wait = Setpoint.velocity(stay, now_ns, yaw_rate_radps=0.0)

        if self._sweep is not None and (why := self._hindered(self._sweep, context)) is not None:
            return Outcome(False, why)
        if self._failure:
            return self._look_back(dt_s, context) or wait
        if now_ns > self._give_up_ns:
            return Outcome(False, f"seek timed out: {self._turned_rad / math.tau:.1f} laps turned")
        if (blind := self._blind.outcome(context)) is not None:
            return blind
        if not context.perception_fresh:
            return wait  # so that no part of the circle is skipped
        self._note(context)
        if self._facing is None and (best := self._best(context)) is not None:
            self._facing = Facing(best, now_ns)
        if self._facing is not None:
            return self._face(self._facing, stay, dt_s, context) or wait
        if self.looks_first and self._first_at is not None:
            north, east = self._first_at[0] - position[0], self._first_at[1] - position[1]
            bearing_rad = math.atan2(east, north)
            if abs(wrap_angle(bearing_rad - yaw_rad)) < POINTED_RAD:
                self._pointed_ns = min(self._pointed_ns, now_ns)
            until_ns = min(self._pointed_ns + FIRST_S * 1e9, self._begun_ns + FIRST_LIMIT_S * 1e9)
            if now_ns <= until_ns:
                return Setpoint.velocity(stay, now_ns, yaw_rad=bearing_rad)
            self.looks_first, self._turned_rad = False, 0.0
        if abs(self._turned_rad) >= self._command.laps * math.tau:
            why = f": {DOUBTED}" if self._doubted else ""
            self._failure = f"no {self._command.class_name} found in {laps_text(self._command.laps)}{why}"
            self._return_until_ns = now_ns + BACK_TIMEOUT_S * 1e9
            return self._look_back(dt_s, context) or wait
        if now_ns < self._look_until_ns:
            return wait
        if self._sweep is not None:
            self._sweep.step(dt_s, _gimbal_pitch(context))
            if self._sweep.waiting:
                return wait
        return Setpoint.velocity(stay, now_ns, yaw_rate_radps=self._turn * self._rate_radps)

    def _note(self, context: BehaviourContext) -> None:
        """Note what the newest frame shows, and pause the turn at a first sight."""
        seen = context.objects.seen(self.class_names, self._command.confidence, self._begun_ns)
        certain = [each for each in seen if each.certain]
        # Two of them may turn out to be one.
        finds = (*self._finds.values(), *certain)
        self._finds = {context.objects.now(each).object_id: each for each in finds}
        self._doubted |= any(each.frames >= FOUND_FRAMES and not each.certain for each in seen)
        if not seen:
            return
        if seen[0].last_ns - self._seen_ns > LOOK_S * 1e9:
            self._look_until_ns = context.now_ns + LOOK_S * 1e9
        self._seen_ns = seen[0].last_ns
        if certain:
            self._look_until_ns = context.now_ns

    def _best(self, context: BehaviourContext) -> TrackedObject | None:
        """After the turn, the nearest of the finds within `EQUAL_CONFIDENCE` of the highest rank."""
        self._compared = self._compared or abs(self._turned_rad) >= self._compare_at_rad
        if not self._compared or not self._finds:
            return None
        least = max(_rank(each) for each in self._finds.values()) - EQUAL_CONFIDENCE
        best = [each for each in self._finds.values() if _rank(each) >= least]
        return min(best, key=lambda each: range_m(each, context))

    def _face(
        self, facing: Facing, stay: Vector3, dt_s: float, context: BehaviourContext
    ) -> BehaviourOutput | None:
        """Turn nose and gimbal to the find; None: it is lost, and the next best or the turn follows."""
        pitch_off_rad = 0.0
        if self._sweep is not None:
            pitch_rad = _gimbal_pitch(context)
            goal_rad = context.gimbal_pitch_to(facing.object.detection.elevation_rad)
            self._sweep.towards(goal_rad, dt_s, pitch_rad)
            pitch_off_rad = abs(goal_rad - pitch_rad)
        facing.update(context, pitch_off_rad)
        if facing.lost:
            self._facing = None
            self._finds.pop(context.objects.now(facing.object).object_id, None)
            return None
        if facing.faced:
            return Outcome(True, found_text(facing.object, context))
        return Setpoint.velocity(stay, context.now_ns, yaw_rad=facing.bearing_rad)

    @property
    def gimbal_aim(self) -> GimbalAim | None:
        return None if self._sweep is None else self._sweep.aim

    @property
    def status(self) -> str:
        name, laps = self._command.class_name, max(0.0, self._turned_rad) / math.tau
        if self._facing is not None:
            return f"facing the {name} at {in_degrees(self._facing.bearing_rad)}°"
        seen = f", {len(self._finds)} found" if self._finds else ""
        return f"searching for a {name}, {laps:.1f} laps{seen}"

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

    def _look_back(self, dt_s: float, context: BehaviourContext) -> Outcome | None:
        """Nothing found: return the gimbal to its initial pitch (None), then end."""
        sweep, late = self._sweep, context.now_ns > self._return_until_ns
        if sweep is None or late or sweep.back(dt_s, _gimbal_pitch(context)):
            return Outcome(False, self._failure)
        return None


class SearchBehaviour(PathFlight):
    """Flies an expanding square or a lawnmower pattern about its start, nose along the path.

    Args:
        footprint: of the camera, for the spacing of strips at the current height; None: not known.
    """

    name = "seek"
    requirements = SeekBehaviour.requirements

    def __init__(self, command: Seek, footprint: Footprint | None = None) -> None:
        super().__init__(command.speed_mps)
        self.class_names = (command.class_name,)
        self._command, self._footprint = command, footprint
        self._begin(0)

    def _begin(self, now_ns: int) -> None:
        self._begun_ns, self._doubted = now_ns, False
        self._facing: Facing | None = None
        self._blind = BlindTime(BLIND_TIMEOUT_S)

    def on_activate(self, context: BehaviourContext) -> None:
        super().on_activate(context)
        self._begin(context.now_ns)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        if (blind := self._blind.outcome(context)) is not None:
            return blind
        if not context.perception_fresh:
            return self.stand(dt_s, context)
        seen = context.objects.seen(self.class_names, self._command.confidence, self._begun_ns)
        self._doubted |= any(each.frames >= FOUND_FRAMES and not each.certain for each in seen)
        if self._facing is None and (found := [each for each in seen if each.certain]):
            self._facing = Facing(found[0], context.now_ns)
        if self._facing is not None:
            self._facing.update(context)
            if self._facing.faced:
                return Outcome(True, found_text(self._facing.object, context))
            if not self._facing.lost:
                return self.stand(dt_s, context, self._facing.bearing_rad)
            self._facing = None
        step = super().update(dt_s, context)
        if isinstance(step, Outcome) and step.success:
            why = f": {DOUBTED}" if self._doubted else ""
            return Outcome(False, f"no {self._command.class_name} found in the area{why}")
        return step

    @property
    def status(self) -> str:
        if self._facing is not None:
            return f"facing the {self._command.class_name}"
        return f"searching an area for a {self._command.class_name}{super().status.removeprefix(self.name)}"

    def _points(self, context: BehaviourContext) -> list[Vector3]:
        position, _ = position_and_yaw(context.state)
        command, spacing_m = self._command, self._command.spacing_m
        if spacing_m is None:
            if self._footprint is None:
                raise ValueError("camera footprint unknown: set spacing")
            spacing_m = self._footprint.spacing_m(context.state.altitude_m or 0.0)
        if command.radius_m is not None:
            points = expanding_square(command.radius_m, spacing_m)
        else:
            assert command.width_m is not None
            assert command.height_m is not None
            points = lawnmower(command.width_m, command.height_m, spacing_m)
        if command.radius_m is not None and len(points) == 1:
            raise ValueError(f"one strip of {spacing_m:.0f} m covers the area: use pattern=turn")
        return [(position[0] + north, position[1] + east, position[2]) for north, east in points]

    def _success_text(self) -> str:
        return "whole area searched"


def range_text(found: TrackedObject, context: BehaviourContext) -> str:
    """How far away an object is, in words."""
    away_m = range_m(found, context)
    return f"{away_m:.1f} m away" if math.isfinite(away_m) else "range unknown"


def range_m(found: TrackedObject, context: BehaviourContext) -> float:
    """Horizontal, to where it was seen last; infinite where its range is unknown."""
    position, _ = position_and_yaw(context.state)
    place = found.position_ned_m
    return math.inf if place is None else math.dist(place[:2], position[:2])


def _rank(found: TrackedObject) -> float:
    """Its confidence, reduced by the share of ambiguous frames and by a low number of frames."""
    return found.detection.score * (1.0 - found.doubt) * found.frames / (found.frames + FOUND_FRAMES)


def _gimbal_pitch(context: BehaviourContext) -> float:
    """The gimbal's pitch, radians above the horizon. Raises RuntimeError if it is unknown."""
    gimbal = context.state.gimbal
    if gimbal is None or gimbal.pitch_rad is None:
        raise RuntimeError("gimbal attitude unknown: the behaviour must require GIMBAL")
    return gimbal.pitch_rad
