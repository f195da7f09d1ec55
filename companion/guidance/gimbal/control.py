"""Primary control of the gimbal: what to request of its manager next. No link and no clock.

Primary control is requested when the gimbal is to be moved and released afterwards. An existing owner is
never displaced (the autopilot itself, which keeps control after a landing, does not count as one), and after
another component has taken control, it is not requested again for the same owner. While the manager does not
report the owner, it may be a ground station, and control is not requested.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from companion.vehicle.gimbal import NOBODY, Address, GimbalAim, GimbalState, address_text

AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
# Minimum period of pointing commands; each is acknowledged.
AIM_PERIOD_S = 0.1
SAME_AIM_RAD = math.radians(0.2)
# GIMBAL_MANAGER_STATUS may come every 2 s, and may show the state before our request.
SHOWN_WITHIN_S = 2.5
_UNKNOWN_OWNER = "primary control is not reported by its manager"


class GimbalCommand(StrEnum):
    """Requests to a gimbal manager."""

    TAKE = "take"
    POINT = "point"
    GIVE_BACK = "give_back"


@dataclass(frozen=True, slots=True)
class GimbalRequest:
    """One request; `aim` is for POINT."""

    ask: GimbalCommand
    aim: GimbalAim | None = None


class GimbalControl:
    """One client of one gimbal manager.

    Args:
        own: system and component id of our messages.

    Attributes:
        held: we have primary control, as far as known.
        pointed: the newest accepted aim of the current owner; None: none yet.
        problem: why the gimbal is not moved any more for the current owner; empty: no problem.
    """

    def __init__(self, own: Address) -> None:
        self._own = own
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
        free = (None, NOBODY, self._own, (self._own[0], AUTOPILOT_COMPONENT))
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
        if gimbal is not None and gimbal.status_ns > self._taken_ns and gimbal.primary_control == self._own:
            self._shown = True
        if self.held and (why := self._taken_over(now_ns, gimbal)) is not None:
            self.held = False
            if self._doubted_ns is None:  # else already reported
                self.problem = why
        if self._asked is not None:
            return None
        if aim is None or self.problem:
            return self._ask(GimbalRequest(GimbalCommand.GIVE_BACK)) if self._ours(now_ns, gimbal) else None
        if not self.held or self._doubted_ns is not None:
            if self._unsure(now_ns, gimbal):
                return None
            if (why := self._not_to_be_taken(now_ns, gimbal)) is not None:
                self.problem = why
                return None
            self._taken_from = None if gimbal is None else gimbal.primary_control
            return self._ask(GimbalRequest(GimbalCommand.TAKE))
        if now_ns - self._pointed_ns < AIM_PERIOD_S * 1e9 or _same(aim, self.pointed):
            return None
        self._pointed_ns = now_ns
        return self._ask(GimbalRequest(GimbalCommand.POINT, aim))

    def answered(self, now_ns: int, refused: str | None) -> None:
        """Handle the answer to the pending request."""
        asked, self._asked = self._asked, None
        if asked is None:
            return
        match asked.ask:
            case GimbalCommand.TAKE if refused is None:
                self.held, self._taken_ns, self._shown, self._doubted_ns = True, now_ns, False, None
                self._pointed_ns = -math.inf
            case GimbalCommand.POINT if refused is None:
                self.pointed = asked.aim
            case GimbalCommand.GIVE_BACK if refused is None:
                self.held, self._doubted_ns = False, None
            case GimbalCommand.GIVE_BACK:
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
        if primary == self._own:
            return None
        waiting = now_ns - self._taken_ns <= SHOWN_WITHIN_S * 1e9
        if not self._shown and primary == self._taken_from and waiting:
            return None
        if primary == NOBODY:
            return "primary control was removed"
        return f"{address_text(primary)} has taken primary control"

    def _ours(self, now_ns: int, gimbal: GimbalState | None) -> bool:
        """Whether there is control to release.

        After a refusal only a newer status of the manager decides: a release by a component without control
        may take it from its owner (PX4 compares system and component ids separately). We may also have
        control if only the answer to our request was lost.
        """
        if self._doubted_ns is None:
            return self.held
        if self._unsure(now_ns, gimbal):
            return False
        shown = gimbal is not None and gimbal.status_ns > self._doubted_ns
        self.held = shown and gimbal is not None and gimbal.primary_control == self._own
        return self.held and now_ns >= self._give_back_due_ns

    def _unsure(self, now_ns: int, gimbal: GimbalState | None) -> bool:
        """Whether a request was refused and the manager has not reported the owner since."""
        if self._doubted_ns is None or (gimbal is not None and gimbal.status_ns > self._doubted_ns):
            return False
        return now_ns - self._doubted_ns <= SHOWN_WITHIN_S * 1e9


def _same(aim: GimbalAim, other: GimbalAim | None) -> bool:
    if other is None:
        return False
    off_rad = max(abs(aim.pitch_rad - other.pitch_rad), abs(aim.yaw_rad - other.yaw_rad))
    return off_rad < SAME_AIM_RAD
