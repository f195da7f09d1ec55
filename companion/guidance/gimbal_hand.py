"""Moves the gimbal for what flies, or for an operator, and says when it cannot. Never waits in `update`."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from companion.guidance.behaviour import Behaviour, Outcome
from companion.guidance.gimbal_control import GimbalAsk, GimbalControl, GimbalRequest
from companion.guidance.gimbal_sight import GimbalSight, missing_gimbal
from companion.vehicle.driver import CommandRefusedError, Driver, LinkError
from companion.vehicle.gimbal import GimbalAim, GimbalState, address_text
from companion.vehicle.state import VehicleState

logger = logging.getLogger(__name__)

# A gimbal that carries a camera and is not heard is asked for so often.
SEARCH_PERIOD_S = 5.0
# How long a command waits for a gimbal that has not been heard to tell where it looks.
FIND_TIMEOUT_S = 4.0
POINTED_RAD = math.radians(3.0)
POINT_TIMEOUT_S = 10.0
# For the answer to what is being asked, and again for giving control back.
CLOSE_TIMEOUT_S = 1.0
_ENDING = "the service ends"


@dataclass(frozen=True, slots=True)
class _Errand:
    """An operator's wish."""

    aim: GimbalAim
    until_ns: float
    ended: asyncio.Future[Outcome]

    def end(self, outcome: Outcome) -> None:
        if not self.ended.done():
            self.ended.set_result(outcome)


class GimbalHand:
    """The one place from which a gimbal is moved.

    Args:
        on_event: called with (level, text) for what a person should know.
        carries_camera: a camera sits on it (`camera.gimbal`), so it is looked for until it is heard.
        carries_steering: the camera that steers does. camera_pitch_rad: how far above its axis that looks.
        clock_ns: the time of `update`, `sight` and `status` (CLOCK_MONOTONIC nanoseconds).
    """

    def __init__(
        self,
        driver: Driver,
        on_event: Callable[[str, str], None],
        *,
        carries_camera: bool = False,
        carries_steering: bool = False,
        camera_pitch_rad: float = 0.0,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._driver, self._on_event = driver, on_event
        self._carries_camera, self._carries_steering = carries_camera, carries_steering
        self._camera_pitch_rad = camera_pitch_rad
        self._clock_ns = clock_ns
        self._control = GimbalControl(driver.own_address)
        self._asking: asyncio.Task[None] | None = None
        self._asked_ns = 0
        self._not_given_back = self._closed = False
        self._search: asyncio.Task[bool] | None = None
        self._search_due_ns = 0
        self._errand: _Errand | None = None
        self._told = ""
        self._looking: bool | None = None
        self._heard: list[asyncio.Future[None]] = []

    def sight(self, now_ns: int, state: VehicleState) -> GimbalSight:
        """What behaviours see of the gimbal, besides its state."""
        elsewhere = self._control.elsewhere(state.gimbal)
        undirected = ""
        if self._carries_steering:
            why = "no gimbal answers" if state.gimbal is None else state.gimbal.why_not_looking(now_ns)
            undirected = "" if why is None else f"the gimbal that carries it: {why}"
        return GimbalSight(
            self._carries_steering,
            undirected,
            "" if elsewhere is None or self._control.holds(now_ns, state.gimbal) else address_text(elsewhere),
            self._control.problem if self._errand is None else "",
            self._camera_pitch_rad,
        )

    def update(self, now_ns: int, state: VehicleState, behaviour: Behaviour | None) -> None:
        """One turn of the guidance loop, after the pilot's."""
        if self._closed:
            return
        flown = None if behaviour is None else behaviour.flown
        aim = None if flown is None else flown.gimbal_aim
        owner: object | None = flown
        errand = self._errand
        if errand is not None and aim is not None and flown is not None:
            errand.end(Outcome(False, f"{flown.name} moves the gimbal"))
        if errand is not None and errand.ended.done():
            self._errand = errand = None
        if errand is not None:
            aim, owner = errand.aim, errand
        request = self._control.update(now_ns, state.gimbal, aim, owner)
        if request is not None:
            self._asked_ns = now_ns
            self._asking = asyncio.get_running_loop().create_task(self._ask(request))
        self._tell_problem()
        if errand is not None:
            self._judge(errand, now_ns, state)
        self._listen(now_ns, state)

    async def find(self) -> None:
        """Return when it is known where the gimbal looks and who has it, or when it was not told in time."""
        if _told(self._driver.state.gimbal, self._clock_ns()):
            return
        heard: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._heard.append(heard)
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(FIND_TIMEOUT_S):
                    if await self._driver.find_gimbal():
                        await heard
        finally:
            heard.cancel()
            if heard in self._heard:
                self._heard.remove(heard)

    async def point(self, aim: GimbalAim, moved_by: Behaviour | None) -> Outcome:
        """Point it for an operator and give it back; it stays as it was pointed.

        Args:
            moved_by: what flies now; where that moves the gimbal itself, the answer is no.
        """
        if moved_by is not None and moved_by.flown.gimbal_aim is not None:
            return Outcome(False, f"gimbal: {moved_by.flown.name} moves it; end that first")
        await self.find()
        if self._closed:
            return Outcome(False, _ENDING)
        now_ns, state = self._clock_ns(), self._driver.state
        missing = missing_gimbal(state, now_ns, self.sight(now_ns, state), (aim.pitch_rad,))
        if missing:
            return Outcome(False, f"gimbal needs {' and '.join(missing)}")
        if self._errand is not None:
            self._errand.end(Outcome(False, "gimbal: another one took its place"))
        ended: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        self._errand = _Errand(aim, now_ns + POINT_TIMEOUT_S * 1e9, ended)
        return await ended

    def status(self, now_ns: int, state: VehicleState) -> dict[str, Any] | None:
        """For `status`; None where there is no gimbal and none is to be."""
        gimbal = state.gimbal
        if gimbal is None and not self._carries_camera:
            return None
        pitch_rad = None if gimbal is None else gimbal.pitch_rad
        primary = None if gimbal is None else gimbal.primary_control
        return {
            "heard": gimbal is not None,
            "pitch_deg": None if pitch_rad is None else round(math.degrees(pitch_rad), 1),
            "primary_control": None if primary is None else address_text(primary),
            "ours": self._control.holds(now_ns, gimbal),
            "problem": self._problem(now_ns, state),
        }

    async def close(self) -> None:
        """Move it no more, and give it back if it is ours."""
        self._closed = True
        if self._errand is not None:
            self._errand.end(Outcome(False, _ENDING))
        for waiting in self._heard:
            if not waiting.done():
                waiting.set_result(None)
        if self._asking is not None:
            # Control that is asked for may be had by now: without the answer nobody would give it back.
            await asyncio.wait({self._asking}, timeout=CLOSE_TIMEOUT_S)
        tasks = [task for task in (self._asking, self._search) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._asking is not None and self._asking.cancelled():
            # What the manager has shown since it was asked tells instead.
            self._control.answered(self._asked_ns, "the gimbal's manager did not answer")
        request = self._control.update(self._clock_ns(), self._driver.state.gimbal, None, None)
        if request is not None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CLOSE_TIMEOUT_S):
                    await self._ask(request)

    def _problem(self, now_ns: int, state: VehicleState) -> str:
        if self._control.problem:
            return self._control.problem
        if state.gimbal is None:
            return "no gimbal answers"
        return state.gimbal.why_not_looking(now_ns) or ""

    async def _ask(self, request: GimbalRequest) -> None:
        refused: str | None = None
        try:
            if request.ask is GimbalAsk.TAKE:
                await self._driver.take_gimbal()
            elif request.ask is GimbalAsk.GIVE_BACK:
                await self._driver.give_gimbal_back()
            elif request.aim is not None:
                await self._driver.point_gimbal(request.aim)
        except (CommandRefusedError, LinkError) as error:
            refused = str(error)
        except Exception as error:
            # Unanswered, nothing more would ever be asked.
            logger.exception("the gimbal's manager could not be asked")
            refused = f"{type(error).__name__}: {error}"
        self._control.answered(self._clock_ns(), refused)
        self._tell_problem()  # at once: by the next turn, what flew may have ended for it
        if request.ask is GimbalAsk.GIVE_BACK:
            if refused is not None and not self._not_given_back:
                self._on_event("warning", f"the gimbal could not be given back: {refused}")
            self._not_given_back = refused is not None

    def _tell_problem(self) -> None:
        if self._control.problem != self._told:
            self._told = self._control.problem
            if self._told:
                self._on_event("warning", f"the gimbal is not moved: {self._told}")

    def _judge(self, errand: _Errand, now_ns: int, state: VehicleState) -> None:
        """Whether what an operator asked for is done, or will not be."""
        if self._control.problem:
            errand.end(Outcome(False, f"gimbal: {self._control.problem}"))
            return
        gimbal = state.gimbal
        off_rad = None if gimbal is None else gimbal.off_rad(errand.aim, state.yaw_rad or 0.0)
        known = gimbal is not None and gimbal.attitude_fresh(now_ns) and off_rad is not None
        if self._control.pointed == errand.aim and known and off_rad is not None and off_rad <= POINTED_RAD:
            errand.end(Outcome(True, f"the gimbal looks {direction_text(errand.aim)}"))
        elif now_ns > errand.until_ns:
            where = (
                "does not tell where it looks" if off_rad is None else f"is {math.degrees(off_rad):.0f}° off"
            )
            errand.end(Outcome(False, f"gimbal: after {POINT_TIMEOUT_S:g} s it {where}"))

    def _listen(self, now_ns: int, state: VehicleState) -> None:
        """Say whether it is known where a camera's gimbal looks, and look for one that is not heard."""
        gimbal = state.gimbal
        looking = gimbal is not None and gimbal.why_not_looking(now_ns) is None
        if _told(gimbal, now_ns):
            while self._heard:
                waiting = self._heard.pop(0)  # so that the newest word comes last, and counts
                if not waiting.done():
                    waiting.set_result(None)
        if not self._carries_camera:
            return
        if looking is not self._looking and (looking or self._looking is not None):
            self._on_event(
                "info" if looking else "warning",
                "the camera's gimbal tells where it looks"
                if looking
                else f"where the camera looks is not known: {self._problem(now_ns, state)}",
            )
        self._looking = looking
        idle = self._search is None or self._search.done()
        if not looking and idle and now_ns >= self._search_due_ns and state.connected(now_ns):
            self._search_due_ns = now_ns + round(SEARCH_PERIOD_S * 1e9)
            self._search = asyncio.get_running_loop().create_task(self._driver.find_gimbal())


def _told(gimbal: GimbalState | None, now_ns: int) -> bool:
    """Whether all that must be known before it is moved was told."""
    return gimbal is not None and gimbal.attitude_fresh(now_ns) and gimbal.control_known(now_ns)


def direction_text(aim: GimbalAim) -> str:
    """Where that is, for people."""
    pitch, yaw = round(math.degrees(aim.pitch_rad)), round(math.degrees(aim.yaw_rad))
    words = "level" if pitch == 0 else f"{abs(pitch)}° {'up' if pitch > 0 else 'down'}"
    return words if yaw == 0 else f"{words}, {abs(yaw)}° to the {'right' if yaw > 0 else 'left'}"
