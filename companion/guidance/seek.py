"""Turn on the spot until an object of a class is seen for sure, then face it."""

from __future__ import annotations

import math
from collections import deque

from companion.guidance.behaviour import Behaviour, Outcome, Requirement, Situation, Step
from companion.guidance.motion import in_degrees, laps_text, position_and_yaw, stay_at
from companion.guidance.target import DOUBTED, Target
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3
from vision.rotation import wrap_angle

# One detection is a rumour: so many frames of the last so many seconds must agree on a direction.
FRAMES_NEEDED = 3
FRAMES_WINDOW_S = 1.5
SAME_BEARING_RAD = math.radians(12.0)
# After a first sighting the turn waits this long for the others to come.
LOOK_S = 1.0
# Facing the object: how well, for how long it must last, and when to give the sighting up.
FACING_RAD = math.radians(4.0)
FACING_S = 0.4
FACING_TIMEOUT_S = 12.0
SIGHT_LOST_S = 2.0
# Found means seen now, not a moment ago.
SIGHT_FRESH_S = 0.7
BLIND_TIMEOUT_S = 5.0
# A turn may take this many times what it should, plus the looks on the way.
SLOWEST_TURN = 3.0


class SeekBehaviour(Behaviour):
    """Turns up to `laps` (counted from the real heading), and ends facing the object."""

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
    ) -> None:
        self.class_names = (class_name,)
        self._class_name = class_name
        self._laps, self._confidence = laps, confidence
        self._turn = 1.0 if clockwise else -1.0
        self._rate_radps = rate_radps
        self._sightings: deque[Target] = deque(maxlen=32)
        self._place: Vector3 = (0.0, 0.0, 0.0)
        self._yaw_rad = 0.0
        self._turned_rad = 0.0
        self._newest_ns = 0
        self._look_until_ns: float = 0
        self._give_up_ns: float = 0
        self._blind_since_ns: int | None = None
        self._doubted = False
        self._found: Target | None = None
        self._found_ns = 0
        self._facing_since_ns: int | None = None

    def on_activate(self, situation: Situation) -> None:
        self._place, self._yaw_rad = position_and_yaw(situation.state)
        self._turned_rad = 0.0
        self._doubted = False
        self._sightings.clear()
        self._found = self._blind_since_ns = self._facing_since_ns = None
        # Frames captured before the command do not count: they may be of another place.
        self._newest_ns = situation.now_ns
        self._look_until_ns = 0
        limit_s = SLOWEST_TURN * self._laps * math.tau / self._rate_radps + 2 * FACING_TIMEOUT_S
        self._give_up_ns = situation.now_ns + limit_s * 1e9

    def update(self, dt_s: float, situation: Situation) -> Step:
        now_ns = situation.now_ns
        position, yaw_rad = position_and_yaw(situation.state)
        self._turned_rad += self._turn * wrap_angle(yaw_rad - self._yaw_rad)
        self._yaw_rad = yaw_rad
        stay = stay_at(self._place, position)

        if now_ns > self._give_up_ns:
            return Outcome(False, f"seek timed out: {self._turned_rad / math.tau:.1f} laps turned")
        if not situation.perception_fresh:
            return self._wait_blind(situation, stay)
        self._blind_since_ns = None
        self._look(situation)
        if self._found is not None:
            return self._face(self._found, situation, yaw_rad, stay)
        if abs(self._turned_rad) >= self._laps * math.tau:
            why = f": {DOUBTED}" if self._doubted else ""
            return Outcome(False, f"no {self._class_name} seen in {laps_text(self._laps)}{why}")
        waiting = now_ns < self._look_until_ns
        rate = 0.0 if waiting else self._turn * self._rate_radps
        return Setpoint.velocity(stay, now_ns, yaw_rate_radps=rate)

    @property
    def status(self) -> str:
        if self._found is not None:
            return f"facing the {self._class_name} at {in_degrees(self._found.bearing_rad)}°"
        return f"looking for a {self._class_name}, {max(0.0, self._turned_rad) / math.tau:.1f} laps"

    def _look(self, situation: Situation) -> None:
        """Take what new frames show; enough sightings that agree make a find."""
        fresh = [t for t in situation.targets if t.captured_ns > self._newest_ns]
        if fresh:
            self._newest_ns = max(t.captured_ns for t in fresh)
        seen = [t for t in fresh if t.class_name == self._class_name and t.score >= self._confidence]
        if self._found is not None:
            same = [t for t in seen if t.trusted and _apart(t, self._found) <= SAME_BEARING_RAD]
            if same:
                found = self._found
                self._found = min(
                    same, key=lambda t: (t.track_id is None or t.track_id != found.track_id, _apart(t, found))
                )
            return
        if not seen:
            return
        if not self._sightings or seen[0].captured_ns - self._sightings[-1].captured_ns > LOOK_S * 1e9:
            self._look_until_ns = situation.now_ns + LOOK_S * 1e9
        self._sightings.extend(seen)
        oldest_ns = self._newest_ns - FRAMES_WINDOW_S * 1e9
        recent = [t for t in self._sightings if t.captured_ns >= oldest_ns]
        for target in sorted(seen, key=lambda t: -t.confidence):
            frames = {t.captured_ns for t in recent if _apart(t, target) <= SAME_BEARING_RAD}
            if len(frames) < FRAMES_NEEDED:
                continue
            if not target.trusted:
                self._doubted = True
            else:
                self._found, self._found_ns = target, situation.now_ns
                self._facing_since_ns = None
                return

    def _face(self, found: Target, situation: Situation, yaw_rad: float, stay: Vector3) -> Step:
        now_ns = situation.now_ns
        unseen_s = (now_ns - found.captured_ns) / 1e9
        if unseen_s > SIGHT_LOST_S or now_ns - self._found_ns > FACING_TIMEOUT_S * 1e9:
            # It was not there after all, or it went away: the turn goes on from here.
            self._found = None
            self._sightings.clear()
            return Setpoint.velocity(stay, now_ns, yaw_rate_radps=0.0)
        if unseen_s > SIGHT_FRESH_S or abs(wrap_angle(found.bearing_rad - yaw_rad)) > FACING_RAD:
            self._facing_since_ns = None
        elif self._facing_since_ns is None:
            self._facing_since_ns = now_ns
        elif now_ns - self._facing_since_ns >= FACING_S * 1e9:
            range_text = "range unknown" if found.position_ned_m is None else f"{found.range_m:.1f} m away"
            where = f"bearing {in_degrees(found.bearing_rad)}°, {range_text}"
            return Outcome(True, f"found a {self._class_name}: {where}")
        return Setpoint.velocity(stay, now_ns, yaw_rad=found.bearing_rad)

    def _wait_blind(self, situation: Situation, stay: Vector3) -> Step:
        """Nothing is seen at all: turning on would skip a part of the circle."""
        now_ns = situation.now_ns
        if self._blind_since_ns is None:
            self._blind_since_ns = now_ns
        if now_ns - self._blind_since_ns > BLIND_TIMEOUT_S * 1e9:
            return Outcome(False, f"nothing came from the detector for {BLIND_TIMEOUT_S:g} s")
        return Setpoint.velocity(stay, now_ns, yaw_rate_radps=0.0)


def _apart(first: Target, second: Target) -> float:
    return abs(wrap_angle(first.bearing_rad - second.bearing_rad))
