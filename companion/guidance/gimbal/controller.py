"""Points the gimbal for the active behaviour or for an operator. Part of the guidance core.

The only module that moves the gimbal. `control` decides when control may be taken and is released; this one
selects the aim and finds the gimbal manager.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from companion.guidance.behaviour import Behaviour, Outcome
from companion.guidance.gimbal.control import GimbalCommand, GimbalControl, GimbalRequest
from companion.guidance.gimbal_status import GimbalStatus, missing_gimbal
from companion.guidance.interface import (
    Answer,
    EventKind,
    FindGimbal,
    OutputCollector,
    PointGimbal,
    ReleaseGimbal,
    TakeGimbal,
)
from companion.vehicle.gimbal import Address, GimbalAim, GimbalState, address_text
from companion.vehicle.state import VehicleState

# Period of searching for a camera's gimbal that does not respond.
SEARCH_PERIOD_S = 5.0
# How long a command waits for the gimbal's attitude and control status.
FIND_TIMEOUT_S = 4.0
POINTED_RAD = math.radians(3.0)
POINT_TIMEOUT_S = 10.0
# At the end of the service: for the pending answer, and again for releasing control.
RELEASE_TIMEOUT_S = 1.0
ENDING = "the service ends"


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


@dataclass(frozen=True, slots=True)
class _PointRequest:
    """An operator's request to point the gimbal."""

    identifier: int
    aim: GimbalAim
    until_ns: float


class GimbalController:
    """One gimbal's controller; every method is called from `Guidance.step`.

    Args:
        own: system and component id of our messages.

    Attributes:
        mounting: may be replaced after the start: a camera can provide its own mount.
    """

    def __init__(self, own: Address, mounting: GimbalMounting) -> None:
        self.mounting = mounting
        self._control = GimbalControl(own)
        self._asked: tuple[int, GimbalCommand, int] | None = None
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
        """The gimbal's control and mounting for behaviours."""
        owner = self._control.other_owner(state.gimbal)
        fault = ""
        if self.mounting.carries_steering:
            why = (
                "gimbal manager not responding"
                if state.gimbal is None
                else state.gimbal.why_not_looking(now_ns)
            )
            fault = "" if why is None else f"its gimbal: {why}"
        return GimbalStatus(
            self.mounting.carries_steering,
            fault,
            "" if owner is None or self._control.holds(now_ns, state.gimbal) else address_text(owner),
            self._control.problem if self._point is None else "",
            self.mounting.camera_pitch_rad,
        )

    def status(self, now_ns: int, state: VehicleState) -> dict[str, Any] | None:
        """For `status`; None where there is no gimbal and none is expected."""
        gimbal = state.gimbal
        if gimbal is None and not self.mounting.carries_camera:
            return None
        pitch_rad = None if gimbal is None else gimbal.pitch_rad
        primary = None if gimbal is None else gimbal.primary_control
        return {
            "answers": gimbal is not None,
            "pitch_deg": None if pitch_rad is None else round(math.degrees(pitch_rad), 1),
            "primary_control": None if primary is None else address_text(primary),
            "ours": self._control.holds(now_ns, gimbal),
            "problem": self._problem(now_ns, state),
        }

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
        self, identifier: int, aim: GimbalAim, now_ns: int, state: VehicleState, out: OutputCollector
    ) -> None:
        """Point it for an operator and release it; it keeps its direction."""
        if missing := missing_gimbal(state, now_ns, self.snapshot(now_ns, state), (aim.pitch_rad,)):
            out.result(identifier, Outcome(False, f"gimbal needs {' and '.join(missing)}"))
            return
        self._end_point(Outcome(False, "gimbal: superseded by a newer gimbal command"), out)
        self._point = _PointRequest(identifier, aim, now_ns + POINT_TIMEOUT_S * 1e9)

    # --- the steps ---------------------------------------------------------------------------------------

    def take_answer(self, answer: Answer, now_ns: int, out: OutputCollector) -> None:
        """Handle the answer to a request; others are ignored."""
        if answer.identifier == self._find:
            self._find, self._not_found = None, answer.refused is not None
        elif self._asked is not None and answer.identifier == self._asked[0]:
            ask, self._asked = self._asked[1], None
            self._control.answered(now_ns, answer.refused)
            self._report_problem(out)
            if ask is GimbalCommand.GIVE_BACK:
                if answer.refused is not None and not self._release_failed:
                    text = f"gimbal: release of control refused: {answer.refused}"
                    out.event(EventKind.GIMBAL, "", text, warning=True)
                self._release_failed = answer.refused is not None

    def update(
        self, now_ns: int, state: VehicleState, active: Behaviour | None, out: OutputCollector
    ) -> None:
        """One step, after that of the active behaviour."""
        aim = None if active is None else active.gimbal_aim
        owner: object | None = active
        if self._point is not None and aim is not None and active is not None:
            self._end_point(Outcome(False, f"gimbal: superseded by {active.name}"), out)
        if self._point is not None:
            aim, owner = self._point.aim, self._point
        request = self._control.update(now_ns, state.gimbal, aim, owner)
        if request is not None:
            self._asked = (out.request(_action(request)), request.ask, now_ns)
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
            self._asked, self._last_try = (out.request(_action(request)), request.ask, now_ns), True
            self._ending_since_ns = now_ns

    def _end_point(self, outcome: Outcome, out: OutputCollector) -> None:
        if self._point is not None:
            out.result(self._point.identifier, outcome)
            self._point = None

    def _problem(self, now_ns: int, state: VehicleState) -> str:
        if self._control.problem:
            return self._control.problem
        if state.gimbal is None:
            return "gimbal manager not responding"
        return state.gimbal.why_not_looking(now_ns) or ""

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
        gimbal = state.gimbal
        off_rad = None if gimbal is None else gimbal.off_rad(request.aim, state.yaw_rad or 0.0)
        known = gimbal is not None and gimbal.attitude_fresh(now_ns) and off_rad is not None
        if self._control.pointed == request.aim and known and off_rad is not None and off_rad <= POINTED_RAD:
            self._end_point(Outcome(True, f"gimbal points {direction_text(request.aim)}"), out)
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
                else f"camera direction unknown: {self._problem(now_ns, state)}"
            )
            out.event(EventKind.GIMBAL, "", text, warning=not looking)
        self._looking = looking
        if not looking and now_ns >= self._search_due_ns and state.connected(now_ns):
            self._search_due_ns = now_ns + round(SEARCH_PERIOD_S * 1e9)
            self.find(out)


def is_known(gimbal: GimbalState | None, now_ns: int) -> bool:
    """Whether attitude and primary control are known, as needed to move it."""
    return gimbal is not None and gimbal.attitude_fresh(now_ns) and gimbal.control_known(now_ns)


def direction_text(aim: GimbalAim) -> str:
    """A direction in words."""
    pitch, yaw = round(math.degrees(aim.pitch_rad)), round(math.degrees(aim.yaw_rad))
    words = "level" if pitch == 0 else f"{abs(pitch)}° {'up' if pitch > 0 else 'down'}"
    return words if yaw == 0 else f"{words}, {abs(yaw)}° to the {'right' if yaw > 0 else 'left'}"


def _action(request: GimbalRequest) -> TakeGimbal | PointGimbal | ReleaseGimbal:
    if request.aim is not None:
        return PointGimbal(request.aim)
    return TakeGimbal() if request.ask is GimbalCommand.TAKE else ReleaseGimbal()
