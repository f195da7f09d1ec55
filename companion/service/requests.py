"""Executes guidance's requests with the driver; each result is an answer for guidance's next step."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from companion.guidance.interface import (
    Action,
    Answer,
    Arm,
    Disarm,
    FindGimbal,
    GuidanceOutput,
    PointGimbal,
    ReleaseGimbal,
    Request,
    SetMode,
    TakeGimbal,
    TakeOff,
)
from companion.host.tasks import spawn
from companion.vehicle.driver import CommandRefusedError, Driver, LinkError, TakenOverError
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.state import VehicleState
from companion.vehicle.streamer import Streamer
from vision.obstacle_sectors import ObstacleSectors
from vision.path_planner import PathRequest

logger = logging.getLogger(__name__)


def apply_output(
    output: GuidanceOutput,
    streamer: Streamer,
    *,
    start: Callable[[Request], None],
    cancel: Callable[[int], None],
    send_landing_target: Callable[[LandingTarget], None],
    send_obstacle_distance: Callable[[ObstacleSectors], None],
    request_path: Callable[[PathRequest], None],
) -> None:
    """Pass the setpoint, requests, landing target, obstacles and path request of one step on."""
    if output.setpoint is None:
        streamer.stop()
    else:
        streamer.submit(output.setpoint)
    for identifier in output.cancelled:
        cancel(identifier)
    for request in output.requests:
        start(request)
    if output.landing_target is not None:
        send_landing_target(output.landing_target)
    if output.obstacle_distance is not None:
        send_obstacle_distance(output.obstacle_distance)
    if output.path_request is not None:
        request_path(output.path_request)


class RequestRunner:
    """Runs each request as a task, in the driver's loop.

    Args:
        on_answer: called when there is a new answer.
    """

    def __init__(self, driver: Driver, on_answer: Callable[[], None]) -> None:
        self._driver, self._on_answer = driver, on_answer
        self._tasks: dict[int, asyncio.Task[None]] = {}
        self._cancelled: set[int] = set()
        self._motion: set[int] = set()
        self._answers: list[Answer] = []

    def start(self, request: Request) -> None:
        """Start a request."""
        # Of the step that has decided it: a report, or a standstill, may come before the task begins.
        task = spawn(self._run(request, self._driver.state), f"request {request.action}")
        self._tasks[request.identifier] = task
        if isinstance(request.action, SetMode | Arm | Disarm | TakeOff):
            self._motion.add(request.identifier)
        task.add_done_callback(lambda done: self._on_done(request.identifier, done))

    def cancel(self, identifier: int) -> None:
        """Cancel a request; what has been sent may still take effect."""
        task = self._tasks.get(identifier)
        if task is not None:
            self._cancelled.add(identifier)
            task.cancel()

    def _on_done(self, identifier: int, task: asyncio.Task[None]) -> None:
        self._tasks.pop(identifier, None)
        self._motion.discard(identifier)
        if task.cancelled() and identifier not in self._cancelled:
            # Not cancelled by us: without an answer guidance would wait forever.
            self._answers.append(Answer(identifier, "the request was cancelled"))
            self._on_answer()
        self._cancelled.discard(identifier)

    def take_answers(self) -> tuple[Answer, ...]:
        """Return the answers since the last call."""
        answers, self._answers = tuple(self._answers), []
        return answers

    def abandon_motion(self, why: str) -> None:
        """Cancel what changes the mode or the arming, and answer it as refused."""
        for identifier in sorted(self._motion):
            self._answers.append(Answer(identifier, why))
            self.cancel(identifier)

    async def close(self) -> None:
        """Cancel all pending requests."""
        tasks = list(self._tasks.values())
        for identifier in list(self._tasks):
            self.cancel(identifier)
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _run(self, request: Request, since: VehicleState) -> None:
        refused: str | None = None
        taken_over = False
        try:
            refused = await self._execute(request.action, since, request.valid_until_ns)
        except (CommandRefusedError, LinkError) as error:
            refused = str(error) or type(error).__name__
            taken_over = isinstance(error, TakenOverError)
        except Exception as error:
            # Without an answer guidance would wait forever.
            logger.exception("%s: request failed", request.action)
            refused = f"{type(error).__name__}: {error}"
        self._answers.append(Answer(request.identifier, refused, taken_over))
        self._on_answer()

    async def _execute(self, action: Action, since: VehicleState, until_ns: int) -> str | None:
        match action:
            case SetMode(mode):
                await self._driver.set_mode(mode, since=since, valid_until_ns=until_ns)
            case Arm():
                await self._driver.arm(since=since, valid_until_ns=until_ns)
            case Disarm():
                await self._driver.disarm(since=since, valid_until_ns=until_ns)
            case TakeOff(altitude_m):
                await self._driver.takeoff(altitude_m, since=since, valid_until_ns=until_ns)
            case FindGimbal():
                return None if await self._driver.find_gimbal() else "gimbal manager not responding"
            case TakeGimbal():
                await self._driver.take_gimbal()
            case PointGimbal(aim):
                await self._driver.point_gimbal(aim)
            case ReleaseGimbal():
                await self._driver.give_gimbal_back()
        return None
