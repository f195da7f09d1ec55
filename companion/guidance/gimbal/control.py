"""Whose the gimbal is, and what to ask of its manager next. No link, no clock: `gimbal_controller` asks.

Control is taken when somebody wants the gimbal moved and given back when nobody does any more. It is never
fought for: who has it at the beginning keeps it (the autopilot itself, which keeps it after a landing, is
nobody), and once another has taken it, it is not taken again for the same errand. While the manager does not
tell who has it, it may be a ground station's, and is not taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from companion.vehicle.gimbal import NOBODY, Address, GimbalAim, GimbalState, address_text

AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
# An aim that moves goes out so often at most; each is a command that is answered.
AIM_PERIOD_S = 0.1
SAME_AIM_RAD = math.radians(0.2)
# GIMBAL_MANAGER_STATUS may come once in two seconds, and what it shows may be from before we asked.
SHOWN_WITHIN_S = 2.5
_UNTOLD = "its manager does not tell who has control of it"


class GimbalCommand(StrEnum):
    """What is asked of a gimbal's manager."""

    TAKE = "take"
    POINT = "point"
    GIVE_BACK = "give_back"


@dataclass(frozen=True, slots=True)
class GimbalRequest:
    """One thing to ask; `aim` is for POINT."""

    ask: GimbalCommand
    aim: GimbalAim | None = None


class GimbalControl:
    """One client of one gimbal manager.

    Args:
        own: whom our messages are from.

    Attributes:
        held: control is ours, as far as we know.
        pointed: the newest aim that was accepted for whom it is moved now; None: none yet.
        problem: why it is not moved any more for whom it was moved; empty: nothing is wrong.
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

    def elsewhere(self, gimbal: GimbalState | None) -> Address | None:
        """Who is known to have control that is not to be taken from him; None: nobody is."""
        primary = None if gimbal is None else gimbal.primary_control
        free = (None, NOBODY, self._own, (self._own[0], AUTOPILOT_COMPONENT))
        return None if primary in free else primary

    def holds(self, now_ns: int, gimbal: GimbalState | None) -> bool:
        """Whether control is ours by what the manager shows now, which `update` may not have seen yet."""
        return self.held and self._taken_over(now_ns, gimbal) is None

    def update(
        self, now_ns: int, gimbal: GimbalState | None, aim: GimbalAim | None, owner: object | None
    ) -> GimbalRequest | None:
        """What to ask now, if anything; `answered` must follow before more is asked.

        Args:
            aim: where it is to look; None: nobody wants it moved.
            owner: who wants that. Another one begins anew, whatever stopped the one before.
        """
        if owner is not self._owner:
            self._owner, self.problem, self.pointed = owner, "", None
        if gimbal is not None and gimbal.status_ns > self._taken_ns and gimbal.primary_control == self._own:
            self._shown = True
        if self.held and (why := self._taken_over(now_ns, gimbal)) is not None:
            self.held = False
            if self._doubted_ns is None:  # else it was told already, of whose errand it was
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
        """What was asked was done, or why it was not."""
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
                # Still ours, perhaps: asked again when the manager shows that, but not at every word of it.
                self._doubted_ns, self._give_back_due_ns = now_ns, now_ns + SHOWN_WITHIN_S * 1e9
            case _:
                self.problem = refused or ""
                self._doubted_ns = now_ns

    def _ask(self, request: GimbalRequest) -> GimbalRequest:
        self._asked = request
        return request

    def _not_to_be_taken(self, now_ns: int, gimbal: GimbalState | None) -> str | None:
        """Why control is not asked for, in words; None: whoever has it, it may be taken from him."""
        if gimbal is None or not gimbal.control_known(now_ns):
            return _UNTOLD
        if self._doubted_ns is not None and gimbal.status_ns <= self._doubted_ns:
            return _UNTOLD  # since the denial
        who = self.elsewhere(gimbal)
        return None if who is None else f"{address_text(who)} has control of it"

    def _taken_over(self, now_ns: int, gimbal: GimbalState | None) -> str | None:
        """Why control is not ours any more, by what the manager shows; None: it is, or it does not tell."""
        if gimbal is None or gimbal.primary_control is None or gimbal.status_ns <= self._taken_ns:
            return None
        primary = gimbal.primary_control
        if primary == self._own:
            return None
        waiting = now_ns - self._taken_ns <= SHOWN_WITHIN_S * 1e9
        if not self._shown and primary == self._taken_from and waiting:
            return None
        if primary == NOBODY:
            return "control of it was taken away"
        return f"{address_text(primary)} has taken control of it"

    def _ours(self, now_ns: int, gimbal: GimbalState | None) -> bool:
        """Whether there is something to give back.

        After a refusal only what the manager has shown since tells: given back by one who does not have it,
        control may be lost to the one who does (PX4 compares system and component each by itself). That
        may also be ours where only the answer to the taking was lost.
        """
        if self._doubted_ns is None:
            return self.held
        if self._unsure(now_ns, gimbal):
            return False
        shown = gimbal is not None and gimbal.status_ns > self._doubted_ns
        self.held = shown and gimbal is not None and gimbal.primary_control == self._own
        return self.held and now_ns >= self._give_back_due_ns

    def _unsure(self, now_ns: int, gimbal: GimbalState | None) -> bool:
        """Refused, and the manager has not shown since whose it is: it may be another's by now."""
        if self._doubted_ns is None or (gimbal is not None and gimbal.status_ns > self._doubted_ns):
            return False
        return now_ns - self._doubted_ns <= SHOWN_WITHIN_S * 1e9


def _same(aim: GimbalAim, other: GimbalAim | None) -> bool:
    if other is None:
        return False
    off_rad = max(abs(aim.pitch_rad - other.pitch_rad), abs(aim.yaw_rad - other.yaw_rad))
    return off_rad < SAME_AIM_RAD
