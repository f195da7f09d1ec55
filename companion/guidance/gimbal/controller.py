"""Points the gimbal for the active behaviour or for an operator. Part of the guidance core.

The only module that moves the gimbal. `GimbalControl` decides when primary control is requested and released;
`GimbalController` selects the aim and finds the gimbal manager.

Primary control is requested when the gimbal is to be moved and released afterwards. An existing owner is
never displaced (the autopilot itself, which keeps control after a landing, does not count as one), and after
another component has taken control, it is not requested again for the same owner. While the manager does not
report the owner, it may be a ground station, and control is not requested.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from companion.guidance.behaviour import Behaviour, BehaviourContext, GimbalStatus, Outcome
from companion.guidance.gimbal.pointing import Pointing
from companion.guidance.interface import (
    Answer,
    EventKind,
    FindGimbal,
    OutputCollector,
    PointGimbal,
    ReleaseGimbal,
    TakeGimbal,
)
from companion.guidance.objects.tracked_object import GimbalGoal
from companion.vehicle.gimbal import NOBODY, Address, GimbalAim, GimbalState, YawFrame, address_text
from companion.vehicle.state import VehicleState
from vision.attitude import wrap_angle

# Period of searching for a camera's gimbal that does not respond.
SEARCH_PERIOD_S = 5.0
# How long a command waits for the gimbal's attitude and control status.
FIND_TIMEOUT_S = 4.0
POINTED_RAD = math.radians(3.0)
POINT_TIMEOUT_S = 10.0
# At the end of the service: for the pending answer, and again for releasing control.
RELEASE_TIMEOUT_S = 1.0
ENDING = "the service ends"
AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
# Minimum period of pointing commands; each is acknowledged.
AIM_PERIOD_S = 0.1
SAME_AIM_RAD = math.radians(0.2)
# GIMBAL_MANAGER_STATUS may come every 2 s, and may show the state before our request.
SHOWN_WITHIN_S = 2.5
_UNKNOWN_OWNER = "primary control is not reported by its manager"


# What is requested of a gimbal manager.
GimbalRequest = TakeGimbal | PointGimbal | ReleaseGimbal


class GimbalControl:
    """One client of one gimbal manager.

    Attributes:
        own: system and component id of our messages.
        held: we have primary control, as far as known.
        pointed: the newest accepted aim of the current owner; None: none yet.
        problem: why the gimbal is not moved any more for the current owner; empty: no problem.
    """

    def __init__(self) -> None:
        self.own: Address = VehicleState.own_address
        self.held = False
        self.pointed: GimbalAim | None = None
        self.problem = ""
        self._owner: object | None = None
        self._asked: GimbalRequest | None = None
        self._pointed_ns: float = -math.inf
        self._taken_ns = 0
        self._taken_from: Address | None = None
        self._shown = False
        self._doubted_ns: int | None = None
        self._give_back_due_ns: float = -math.inf

    def other_owner(self, gimbal: GimbalState | None) -> Address | None:
        """The component in control that must not be displaced; None: none known."""
        primary = None if gimbal is None else gimbal.primary_control
        free = (None, NOBODY, self.own, (self.own[0], AUTOPILOT_COMPONENT))
        return None if primary in free else primary

    def holds(self, now_ns: int, gimbal: GimbalState | None) -> bool:
        """Whether we have control by the manager's newest status, which `update` may not have seen yet."""
        return self.held and self._taken_over(now_ns, gimbal) is None

    def update(
        self, now_ns: int, gimbal: GimbalState | None, aim: GimbalAim | None, owner: object | None
    ) -> GimbalRequest | None:
        """The next request, if any; `answered` must follow before the next one.

        Args:
            aim: where to point; None: the gimbal is not to be moved.
            owner: the object that sets the aim. A new one resets `problem` and `pointed`.
        """
        if owner is not self._owner:
            self._owner, self.problem, self.pointed = owner, "", None
        if gimbal is not None and gimbal.status_ns > self._taken_ns and gimbal.primary_control == self.own:
            self._shown = True
        if self.held and (why := self._taken_over(now_ns, gimbal)) is not None:
            self.held = False
            if self._doubted_ns is None:  # else already reported
                self.problem = why
        if self._asked is not None:
            return None
        if aim is None or self.problem:
            return self._ask(ReleaseGimbal()) if self._ours(now_ns, gimbal) else None
        if not self.held or self._doubted_ns is not None:
            if self._unsure(now_ns, gimbal):
                return None
            if (why := self._not_to_be_taken(now_ns, gimbal)) is not None:
                self.problem = why
                return None
            self._taken_from = None if gimbal is None else gimbal.primary_control
            return self._ask(TakeGimbal())
        if now_ns - self._pointed_ns < AIM_PERIOD_S * 1e9 or _same(aim, self.pointed):
            return None
        self._pointed_ns = now_ns
        return self._ask(PointGimbal(aim))

    def answered(self, now_ns: int, refused: str | None) -> None:
        """Handle the answer to the pending request."""
        asked, self._asked = self._asked, None
        if asked is None:
            return
        match asked:
            case TakeGimbal() if refused is None:
                self.held, self._taken_ns, self._shown, self._doubted_ns = True, now_ns, False, None
                self._pointed_ns = -math.inf
            case PointGimbal(aim) if refused is None:
                self.pointed = aim
            case ReleaseGimbal() if refused is None:
                self.held, self._doubted_ns = False, None
            case ReleaseGimbal():
                # Possibly still ours: released again when the manager shows it, at a limited rate.
                self._doubted_ns, self._give_back_due_ns = now_ns, now_ns + SHOWN_WITHIN_S * 1e9
            case _:
                self.problem = refused or ""
                self._doubted_ns = now_ns

    def _ask(self, request: GimbalRequest) -> GimbalRequest:
        self._asked = request
        return request

    def _not_to_be_taken(self, now_ns: int, gimbal: GimbalState | None) -> str | None:
        """Why control must not be requested, in words; None: it may be."""
        if gimbal is None or not gimbal.control_known(now_ns):
            return _UNKNOWN_OWNER
        if self._doubted_ns is not None and gimbal.status_ns <= self._doubted_ns:
            return _UNKNOWN_OWNER  # no status since the denial
        who = self.other_owner(gimbal)
        return None if who is None else f"{address_text(who)} has primary control"

    def _taken_over(self, now_ns: int, gimbal: GimbalState | None) -> str | None:
        """Why control is lost, by the manager's status; None: it is not, or not reported."""
        if gimbal is None or gimbal.primary_control is None or gimbal.status_ns <= self._taken_ns:
            return None
        primary = gimbal.primary_control
        if primary == self.own:
            return None
        waiting = now_ns - self._taken_ns <= SHOWN_WITHIN_S * 1e9
        if not self._shown and primary == self._taken_from and waiting:
            return None
        if primary == NOBODY:
            return "primary control was removed"
        return f"{address_text(primary)} has taken primary control"

    def _ours(self, now_ns: int, gimbal: GimbalState | None) -> bool:
        """Whether there is control to release.

        After a rejected request only a newer status of the manager decides: a release by a component without
        control may take it from its owner (PX4 compares system and component ids separately). We may also
        have control if only the answer to our request was lost.
        """
        if self._doubted_ns is None:
            return self.held
        if self._unsure(now_ns, gimbal):
            return False
        shown = gimbal is not None and gimbal.status_ns > self._doubted_ns
        self.held = shown and gimbal is not None and gimbal.primary_control == self.own
        return self.held and now_ns >= self._give_back_due_ns

    def _unsure(self, now_ns: int, gimbal: GimbalState | None) -> bool:
        """Whether a request was refused and the manager has not reported the owner since."""
        if self._doubted_ns is None or (gimbal is not None and gimbal.status_ns > self._doubted_ns):
            return False
        return now_ns - self._doubted_ns <= SHOWN_WITHIN_S * 1e9


def _same(aim: GimbalAim, other: GimbalAim | None) -> bool:
    if other is None or aim.yaw_frame is not other.yaw_frame:
        return False
    off_rad = max(abs(aim.pitch_rad - other.pitch_rad), abs(wrap_angle(aim.yaw_rad - other.yaw_rad)))
    return off_rad < SAME_AIM_RAD


@dataclass(frozen=True, slots=True)
class GimbalMounting:
    """Which cameras are mounted on the gimbal.

    Attributes:
        carries_camera: a camera is mounted on it (`camera.on_gimbal`), so it is searched until it responds.
        carries_steering: the steering camera is mounted on it.
        camera_pitch_rad: pitch of that camera above the gimbal's axis.
    """

    carries_camera: bool = False
    carries_steering: bool = False
    camera_pitch_rad: float = 0.0


@dataclass(slots=True, eq=False)
class _PointRequest:
    """An operator's request to point the gimbal, and to keep it on its goal after it is answered."""

    identifier: int
    pointing: Pointing
    until_ns: float
    answered: bool = False


class GimbalController:
    """One gimbal's controller; every method is called from `Guidance.step`.

    Attributes:
        mounting: may be replaced after the start: a camera can provide its own mount.
    """

    def __init__(self, mounting: GimbalMounting) -> None:
        self.mounting = mounting
        self._control = GimbalControl()
        self._asked: tuple[int, GimbalRequest, int] | None = None
        self._find: int | None = None
        self._not_found = False
        self._search_due_ns = 0
        self._point: _PointRequest | None = None
        self._reported_problem = ""
        self._looking: bool | None = None
        self._release_failed = False
        self._ending_since_ns: int | None = None
        self._last_try = False
        self.released = False

    # --- status -------------------------------------------------------------------------------------------

    def snapshot(self, now_ns: int, state: VehicleState) -> GimbalStatus:
        """The gimbal's control and mounting for behaviours. Called first in every step."""
        self._control.own = state.own_address
        owner = self._control.other_owner(state.gimbal)
        carried, why = self.mounting.carries_steering, _not_looking(now_ns, state)
        return GimbalStatus(
            carried,
            f"its gimbal: {why}" if carried and why else "",
            "" if owner is None or self._control.holds(now_ns, state.gimbal) else address_text(owner),
            self._control.problem if self._point is None else "",
            self.mounting.camera_pitch_rad if carried else 0.0,
        )

    def in_control(self, now_ns: int, state: VehicleState) -> bool:
        """Whether this service has primary control."""
        return self._control.holds(now_ns, state.gimbal)

    # --- commands ----------------------------------------------------------------------------------------

    def find(self, out: OutputCollector) -> None:
        """Request the gimbal manager, unless a request is pending."""
        if self._find is None:
            self._find, self._not_found = out.request(FindGimbal()), False

    @property
    def not_found(self) -> bool:
        """Whether the newest `find` was refused. A gimbal that was found still has to report its attitude."""
        return self._find is None and self._not_found

    def point(
        self,
        identifier: int,
        goal: GimbalGoal,
        context: BehaviourContext,
        out: OutputCollector,
    ) -> None:
        """Point it for an operator and release it; it keeps its direction.

        At an object or a place: until that is lost, or the goal is ended.
        """
        now_ns, state, pointing = context.now_ns, context.state, Pointing(goal)
        pitches_rad = (goal.pitch_rad,) if isinstance(goal, GimbalAim) else ()
        if missing := missing_gimbal(state, now_ns, self.snapshot(now_ns, state), pitches_rad):
            out.ended(identifier, Outcome(False, f"gimbal needs {' and '.join(missing)}"))
            return
        if (why := pointing.begin(context)) is not None:
            out.ended(identifier, Outcome(False, f"gimbal: {why}"))
            return
        self._end_point(Outcome(False, "gimbal: superseded by a newer gimbal command"), out)
        self._point = _PointRequest(identifier, pointing, now_ns + POINT_TIMEOUT_S * 1e9)

    def end_goal(self, by: str, out: OutputCollector) -> None:
        """No longer keep it on an object or a place. `by`: the command that ends it."""
        if self._point is not None and self._point.pointing.kept:
            self._end_point(Outcome(False, f"gimbal: ended by {by}"), out)

    # --- the steps ---------------------------------------------------------------------------------------

    def take_answer(self, answer: Answer, now_ns: int, out: OutputCollector) -> None:
        """Handle the answer to a request; others are ignored."""
        if answer.identifier == self._find:
            self._find, self._not_found = None, answer.refused is not None
        elif self._asked is not None and answer.identifier == self._asked[0]:
            asked, self._asked = self._asked[1], None
            self._control.answered(now_ns, answer.refused)
            self._report_problem(out)
            if isinstance(asked, ReleaseGimbal):
                if answer.refused is not None and not self._release_failed:
                    text = f"gimbal: release of control refused: {answer.refused}"
                    out.event(EventKind.GIMBAL, "", text, warning=True)
                self._release_failed = answer.refused is not None

    def update(
        self,
        context: BehaviourContext,
        active: Behaviour | None,
        out: OutputCollector,
    ) -> None:
        """One step, after that of the active behaviour."""
        now_ns, state = context.now_ns, context.state
        aim = None if active is None else active.gimbal_aim
        owner: object | None = active
        if self._point is not None and aim is not None and active is not None:
            self._end_point(Outcome(False, f"gimbal: superseded by {active.name}"), out)
        if self._point is not None and (why := self._point.pointing.update(context)) is not None:
            self._end_point(Outcome(False, f"gimbal: {why}"), out)
        if self._point is not None:
            aim, owner = self._point.pointing.aim, self._point
        request = self._control.update(now_ns, state.gimbal, aim, owner)
        if request is not None:
            self._asked = (out.request(request), request, now_ns)
        self._report_problem(out)
        if self._point is not None:
            self._judge(self._point, now_ns, state, out)
        self._watch(now_ns, state, out)

    def end(self, now_ns: int, state: VehicleState, out: OutputCollector) -> None:
        """One step while the service ends: stop moving it and release control if held."""
        if self._ending_since_ns is None:
            self._ending_since_ns = now_ns
            self._end_point(Outcome(False, ENDING), out)
            if self._find is not None:
                out.cancel(self._find)
                self._find = None
        late = now_ns - self._ending_since_ns > RELEASE_TIMEOUT_S * 1e9
        if self._asked is not None and late:
            # The manager's status since the request decides instead.
            identifier, _, asked_ns = self._asked
            out.cancel(identifier)
            self._asked = None
            self._control.answered(asked_ns, "gimbal manager not responding")
        if self._asked is not None or self.released:
            return
        request = None if self._last_try else self._control.update(now_ns, state.gimbal, None, None)
        if request is None:
            self.released = True
        else:
            self._asked, self._last_try = (out.request(request), request, now_ns), True
            self._ending_since_ns = now_ns

    def _end_point(self, outcome: Outcome, out: OutputCollector) -> None:
        if self._point is not None:
            if self._point.answered:
                out.event(EventKind.GIMBAL, "", outcome.reason, warning=True)
            out.ended(self._point.identifier, outcome, answered=self._point.answered)
        self._point = None

    def problem(self, now_ns: int, state: VehicleState) -> str:
        return self._control.problem or _not_looking(now_ns, state)

    def _report_problem(self, out: OutputCollector) -> None:
        if self._control.problem != self._reported_problem:
            self._reported_problem = self._control.problem
            if self._reported_problem:
                text = f"gimbal not moved: {self._reported_problem}"
                out.event(EventKind.GIMBAL, "", text, warning=True)

    def _judge(self, request: _PointRequest, now_ns: int, state: VehicleState, out: OutputCollector) -> None:
        """Answer an operator's request once it is done or has failed."""
        if self._control.problem:
            self._end_point(Outcome(False, f"gimbal: {self._control.problem}"), out)
            return
        gimbal, aim = state.gimbal, request.pointing.aim
        off_rad = None if gimbal is None or aim is None else gimbal.off_rad(aim, state.yaw_rad or 0.0)
        known = gimbal is not None and gimbal.attitude_fresh(now_ns) and off_rad is not None
        there = known and off_rad is not None and off_rad <= POINTED_RAD
        if aim is not None and request.pointing.kept and there:
            if not request.answered:
                text = f"gimbal kept on {request.pointing.name}, now {direction_text(aim)}"
                out.in_progress(request.identifier, Outcome(True, text))
            request.answered, request.until_ns = True, now_ns + POINT_TIMEOUT_S * 1e9
        elif aim is not None and self._control.pointed == aim and there:
            self._end_point(Outcome(True, f"gimbal points {direction_text(aim)}"), out)
        elif now_ns > request.until_ns:
            where = (
                "has not reported its attitude" if off_rad is None else f"is {math.degrees(off_rad):.0f}° off"
            )
            self._end_point(Outcome(False, f"gimbal: after {POINT_TIMEOUT_S:g} s it {where}"), out)

    def _watch(self, now_ns: int, state: VehicleState, out: OutputCollector) -> None:
        """Log whether the direction of a camera's gimbal is known; search for one that does not respond."""
        if not self.mounting.carries_camera:
            return
        gimbal = state.gimbal
        looking = gimbal is not None and gimbal.why_not_looking(now_ns) is None
        if looking is not self._looking and (looking or self._looking is not None):
            text = (
                "camera direction known: gimbal attitude received"
                if looking
                else f"camera direction unknown: {self.problem(now_ns, state)}"
            )
            out.event(EventKind.GIMBAL, "", text, warning=not looking)
        self._looking = looking
        if not looking and now_ns >= self._search_due_ns and state.connected(now_ns):
            self._search_due_ns = now_ns + round(SEARCH_PERIOD_S * 1e9)
            self.find(out)


def missing_gimbal(
    state: VehicleState, now_ns: int, status: GimbalStatus, pitches_rad: Sequence[float]
) -> list[str]:
    """What is missing before the gimbal can be moved, in words.

    Args:
        pitches_rad: pitches it must reach, above the horizon.
    """
    gimbal = state.gimbal
    if gimbal is None:
        return ["a gimbal (gimbal manager not responding)"]
    missing = []
    if (why := gimbal.why_not_looking(now_ns)) is not None:
        missing.append(f"the gimbal's attitude ({why})")
    if not gimbal.control_known(now_ns):
        missing.append("the gimbal's primary control (not reported by its manager)")
    elif status.controlled_by:
        missing.append(f"control of the gimbal ({status.controlled_by} has it and must release it)")
    beyond = [pitch for pitch in pitches_rad if not gimbal.reaches(pitch)]
    if beyond:
        wanted = " and ".join(f"{math.degrees(pitch):.0f}°" for pitch in beyond)
        low, high = math.degrees(gimbal.lowest_pitch_rad), math.degrees(gimbal.highest_pitch_rad)
        missing.append(f"a gimbal that pitches to {wanted} (its range is {low:.0f}° to {high:.0f}°)")
    return missing


def is_known(gimbal: GimbalState | None, now_ns: int) -> bool:
    """Whether attitude and primary control are known, as needed to move it."""
    return gimbal is not None and gimbal.attitude_fresh(now_ns) and gimbal.control_known(now_ns)


def direction_text(aim: GimbalAim) -> str:
    """A direction in words."""
    pitch, yaw = round(math.degrees(aim.pitch_rad)), round(math.degrees(aim.yaw_rad))
    words = "level" if pitch == 0 else f"{abs(pitch)}° {'up' if pitch > 0 else 'down'}"
    if aim.yaw_frame is YawFrame.NORTH:
        return f"{words}, bearing {yaw % 360}°"
    return words if yaw == 0 else f"{words}, {abs(yaw)}° to the {'right' if yaw > 0 else 'left'}"


def _not_looking(now_ns: int, state: VehicleState) -> str:
    """Why the gimbal's direction is unknown, in words; empty: it is known."""
    if state.gimbal is None:
        return "gimbal manager not responding"
    return state.gimbal.why_not_looking(now_ns) or ""
