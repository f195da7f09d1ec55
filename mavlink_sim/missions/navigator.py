"""PX4's Navigator, reduced: stored plans, mission progress, the geofence, the destination of RTL.

Belongs to one Autopilot, which calls `update` at every step and gets the tasks of MISSION, RTL, PRECLAND.
Messages for clients are queued in `announcements`, commands for other components in `commands`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.collision_prevention import ObstacleMap, Plane, limited_acceleration
from mavlink_sim.flight.precision_landing import LandingTarget, Precision, PrecisionLanding
from mavlink_sim.missions import items as mission_items
from mavlink_sim.missions.feasibility import complaints
from mavlink_sim.missions.geofence import Action, Geofence
from mavlink_sim.missions.items import MissionItem, PlanType
from mavlink_sim.missions.mission_flight import MissionFlight
from mavlink_sim.missions.plan import Mission, MissionState, Plan
from mavlink_sim.missions.return_flight import (
    Goal,
    ReturnFlight,
    RouteReturn,
    destination,
    landing_route,
    mission_route,
)
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.geography import LocalFrame
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.modes import Mode
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.wire.announcements import CRITICAL, INFO, Text

FENCE_PERIOD_S = 0.2  # GEOFENCE_CHECK_INTERVAL_US
REACHED_REPETITIONS = 10  # MISSION_ITEM_REACHED is repeated this often, once per second
REACHED_PERIOD_S = 1.0
ACTIVE, SUSPENDED = 1, 2  # MISSION_CURRENT.mission_mode
_MISSION_MODES = frozenset({Mode.MISSION, Mode.TAKEOFF, Mode.LAND})


@dataclass(frozen=True, slots=True)
class Current:
    """The current item changed: MISSION_CURRENT is due."""


@dataclass(frozen=True, slots=True)
class Reached:
    """MISSION_ITEM_REACHED is due."""

    sequence: int


class HomePosition(Protocol):
    """Home. `position`: local NED metres. `attitude_rad`: roll, pitch, yaw."""

    position: Vector
    attitude_rad: Vector


class Commander(Protocol):
    """What the Navigator uses of the autopilot it belongs to; see `autopilot.commander.Autopilot`."""

    now_s: float
    armed: bool
    mode: Mode
    cruise_mps: float
    texts: deque[Text]
    task: flight.Task | None

    @property
    def home(self) -> HomePosition: ...

    @property
    def landed(self) -> bool: ...

    @property
    def sensors_ready(self) -> bool: ...

    def set_mode(self, mode: Mode, report: bool = False) -> int: ...

    def hold_at(self, point: Vector) -> None: ...

    def restart_task(self) -> None: ...

    def change_speed(self, speed_mps: float, at_once: bool) -> None: ...


class Navigator:
    """Missions, fence and destinations of one vehicle.

    Attributes:
        frame: the vehicle's local frame.
        plans: the stored plans, by type. mission: the mission and its progress.
        fence: the geofence. obstacles: for collision prevention.
        target: the newest landing target.
        uploading: name of the link over which a client uploads. sessions: the mission protocol, by link.
    """

    def __init__(
        self,
        autopilot: Commander,
        airframe: Multirotor,
        parameters: Parameters,
        frame: LocalFrame,
        on_event: Callable[[str], None],
    ) -> None:
        self._autopilot = autopilot
        self._airframe = airframe
        self._parameters = parameters
        self.frame = frame
        self._on_event = on_event
        self.plans: dict[PlanType, Plan] = dict.fromkeys(PlanType, Plan())
        self.mission = Mission()
        self.fence = Geofence(parameters, frame)
        self.obstacles = ObstacleMap()
        self.target: LandingTarget | None = None
        self.uploading: str | None = None
        self.sessions: dict[str, Any] = {}
        self.announcements: deque[Current | Reached] = deque()
        self.commands: deque[MissionItem] = deque()
        self._checked_with: object = None
        self._state = MissionState.NO_MISSION
        self._active = False  # the mission on board was started
        self._disarmed_since_active = False
        self._breaches: list[str] = []
        self._next_fence_check_s = 0.0
        self._next_reached_s = 0.0
        self._repetitions = 0

    # ---- state ------------------------------------------------------------------------------------------

    @property
    def now_s(self) -> float:
        return self._autopilot.now_s

    @property
    def landed(self) -> bool:
        return self._autopilot.landed

    @property
    def cruise_mps(self) -> float:
        """Of DO_CHANGE_SPEED; NaN: MPC_XY_CRUISE."""
        return self._autopilot.cruise_mps

    @property
    def home(self) -> Vector:
        return self._autopilot.home.position

    @property
    def is_breached(self) -> bool:
        """The vehicle breaches the fence, and GF_ACTION does not ignore that."""
        return bool(self._breaches)

    @property
    def breaches(self) -> list[str]:
        """PX4's text for each breach."""
        return self._breaches

    @property
    def in_progress(self) -> bool:
        """A mission is in progress; automatic disarming is off then."""
        return self._autopilot.mode is Mode.MISSION and not self.mission.finished

    @property
    def mission_mode(self) -> int:
        return ACTIVE if self._autopilot.mode in _MISSION_MODES else SUSPENDED

    def mission_state(self) -> MissionState:
        """MISSION_CURRENT.mission_state; as in PX4, a pause before any item keeps the last state."""
        mission = self.mission
        if not mission.items or not mission.valid:
            self._state = MissionState.NO_MISSION
        elif mission.finished:
            self._state = MissionState.COMPLETE
        elif self.mission_mode == ACTIVE:
            self._state = MissionState.ACTIVE
        elif mission.reached >= 0:
            self._state = MissionState.PAUSED
        elif mission.current < 1:
            self._state = MissionState.NOT_STARTED
        return self._state

    def allows_goal(self, point: Vector) -> bool:
        """Whether a command (DO_REPOSITION, DO_ORBIT) may send the vehicle to a local NED position."""
        return self.fence.allows_goal(point, self._known_home())

    def take_stored(self, before: Navigator) -> None:
        """Restore the plans and the current item after a reboot: PX4 stores no more."""
        self.plans, self.fence = before.plans, before.fence
        mission = before.mission
        self.mission = Mission(mission.items, mission.current, jumps=mission.jumps)

    # ---- requests of clients ----------------------------------------------------------------------------

    def store(self, plan_type: PlanType, plan: Plan, current: int = -1) -> None:
        """Store a new plan. An identical one changes nothing.

        Args:
            current: the mission item marked as current, -1 for none.
        """
        if plan.identifier and plan.identifier == self.plans[plan_type].identifier:
            return
        self.plans[plan_type] = plan
        if plan_type is PlanType.FENCE:
            flying = None if self.landed else self._airframe.position
            for words in self.fence.load(plan.items, self._known_home(), flying):
                self.send_text(CRITICAL, words)
            self._checked_with = None
        elif plan_type is PlanType.MISSION:
            self._new_mission(plan, current)

    def _new_mission(self, plan: Plan, current: int) -> None:
        last = max(len(plan.items) - 1, 0)
        kept = min(self.mission.current, last)
        self.mission = Mission(plan.items, kept if current < 0 else current)
        self._active = False
        self._check_mission()
        self.announcements.append(Current())
        if self._flies_mission():
            self._autopilot.restart_task()

    def set_current(self, index: int) -> None:
        """Make this item the current one."""
        if index == self.mission.current or not self.mission.valid:
            return
        if not self.mission.go_to(index):
            return
        self.mission.finished = False
        self.current_changed()
        if self._flies_mission():
            self._autopilot.restart_task()

    def change_speed(self, speed_mps: float) -> None:
        """DO_CHANGE_SPEED; not above zero: the default speed."""
        self._autopilot.change_speed(speed_mps if speed_mps > 1e-6 else 0.0, at_once=False)

    def forget_reached(self) -> None:
        """Reset the reached item, when the upload of a mission begins."""
        self.mission.reached = -1

    # ---- reports of the flight tasks --------------------------------------------------------------------

    def current_changed(self) -> None:
        self.announcements.append(Current())

    def reached(self, index: int) -> None:
        """Announce a reached item, and repeat that each second for REACHED_REPETITIONS."""
        if index == self.mission.reached:
            return
        self.mission.reached = index
        self._repetitions = 0
        self._next_reached_s = self.now_s + REACHED_PERIOD_S
        self.announcements.append(Reached(index))
        self._on_event(f"mission item {index} reached")

    def command(self, item: MissionItem) -> None:
        """Queue an item that is a command, for this vehicle or another component."""
        self.commands.append(item)

    def send_text(self, severity: int, text: str) -> None:
        self._autopilot.texts.append(Text(severity, text))

    # ---- tasks ------------------------------------------------------------------------------------------

    def mission_task(self) -> flight.Task:
        """The task of Mode.MISSION, from the current item on."""
        mission = self.mission
        if self._active and self._disarmed_since_active and mission.current + 1 == len(mission.items):
            mission.current = 0  # it was completed before
            mission.jumps.clear()
        self._check_mission()
        if not mission.valid:
            then = "refusing takeoff" if self.landed else "loitering"
            self.send_text(CRITICAL, f"No valid mission available, {then}\t")
            return flight.Hold(self._airframe, self._parameters)
        self.send_text(INFO, "Executing Mission\t")
        self._active, self._disarmed_since_active = True, False
        mission.finished, mission.reached = False, -1
        self.current_changed()
        return MissionFlight(self, self._airframe, self._parameters)

    def precision_landing(self, precision: Precision, point: Vector | None = None) -> PrecisionLanding:
        """The task of landing on a target, beginning above `point` (None: here)."""
        return PrecisionLanding(
            self._airframe,
            self._parameters,
            precision,
            self.newest_target,
            self.time_s,
            point,
            self._on_event,
        )

    def newest_target(self) -> LandingTarget | None:
        return self.target

    def time_s(self) -> float:
        return self.now_s

    def return_task(self) -> flight.Task:
        """The task of RTL, by RTL_TYPE and RTL_PLD_MD; announces the return height."""
        position = self._airframe.position
        landing = partial(self._descent, int(self._parameters.number("RTL_PLD_MD")))
        route = mission_route(self.mission, self._parameters, self.home, self.frame)
        if route is not None:
            return RouteReturn(self._airframe, self._parameters, *route, landing)
        rally = self.plans[PlanType.RALLY].items
        found, words = destination(rally, self.mission, self._parameters, self.home, self.frame, position)
        for text in words:
            self.send_text(CRITICAL, text)
        yaw_rad = self._autopilot.home.attitude_rad[2] if found.kind is Goal.HOME else math.nan
        direct = ReturnFlight(self._airframe, self._parameters, found.position, yaw_rad, landing)
        height = direct.return_height_m
        above_sea = self.frame.geographic(found.position)[2] + height
        self.send_text(INFO, f"RTL: start return at {above_sea:.0f} m ({height:.0f} m above destination)\t")
        if found.kind is not Goal.MISSION_LANDING:
            return direct
        last = landing_route(self.mission, self.home, self.frame)
        climb_to_z = found.position[2] - height
        return RouteReturn(self._airframe, self._parameters, *last, landing, climb_to_z)

    def _descent(self, mode: int, point: Vector, yaw_rad: float) -> flight.TrajectoryTask:
        if mode not in (Precision.OPPORTUNISTIC, Precision.REQUIRED):
            return flight.Land(self._airframe, self._parameters, point, yaw_rad)
        z = self._airframe.position[2]
        return self.precision_landing(Precision(mode), (point[0], point[1], z))

    def guard_sticks(self, acceleration: Plane, velocity: Plane) -> Plane:
        """The sticks' acceleration as limited by collision prevention, m/s² (north, east)."""
        limited = limited_acceleration(
            acceleration, velocity, self._airframe.yaw_rad, self.obstacles, self._parameters, self.now_s
        )
        if limited.hold:
            self._on_event("no distances to obstacles: collision prevention changes to HOLD")
            self._autopilot.set_mode(Mode.HOLD)
        return limited.acceleration

    # ---- one step ---------------------------------------------------------------------------------------

    def update(self) -> None:
        """Check the end of the mission, its validity and the fence."""
        autopilot = self._autopilot
        if not autopilot.armed and self._active:
            self._disarmed_since_active = True
        if autopilot.armed and autopilot.mode is Mode.MISSION and not self.landed:
            task = autopilot.task
            if isinstance(task, MissionFlight) and task.ended:
                autopilot.hold_at(task.goal)
            elif not self.mission.valid:
                autopilot.set_mode(Mode.HOLD)
        if self.mission.reached >= 0:
            self._repeat_reached()
        if autopilot.now_s >= self._next_fence_check_s:
            self._next_fence_check_s = autopilot.now_s + FENCE_PERIOD_S
            if self._checked_with != self._check_key():
                self._check_mission()
            self._check_fence()

    def _repeat_reached(self) -> None:
        if self._repetitions < REACHED_REPETITIONS and self.now_s >= self._next_reached_s:
            self._next_reached_s += REACHED_PERIOD_S
            self._repetitions += 1
            self.announcements.append(Reached(self.mission.reached))

    def _flies_mission(self) -> bool:
        return self._autopilot.armed and self._autopilot.mode is Mode.MISSION

    def _known_home(self) -> Vector | None:
        return self.home if self._autopilot.sensors_ready else None

    def _check_key(self) -> object:
        """The inputs of the mission check; a change requires another check."""
        return self._known_home(), self.plans[PlanType.FENCE].identifier

    def _check_mission(self) -> None:
        home = self._known_home()
        if home is None:
            return  # PX4 waits for a position
        self._checked_with = self._check_key()
        was_valid = self.mission.valid
        self.mission.valid, words = complaints(
            self.mission.items, self._parameters, self.fence, home, self.frame, landed=self.landed
        )
        for text in words:
            self.send_text(CRITICAL, text)
        if was_valid != self.mission.valid:
            self._on_event("mission is valid" if self.mission.valid else "mission is not valid")

    def _check_fence(self) -> None:
        autopilot, action = self._autopilot, self.fence.action
        found: list[str] = []
        if action is not Action.NONE and autopilot.sensors_ready:
            found = self.fence.breaches(self._airframe.position, self._known_home())
        fresh = [words for words in found if words not in self._breaches]
        was_breached, self._breaches = self.is_breached, found
        for words in fresh:
            self.send_text(CRITICAL, words)
        if not found or was_breached or not autopilot.armed:
            return
        self._on_event(f"geofence breached: {found[0]}")  # the failsafes select the action


def goes_to_camera(command: int) -> bool:
    """Whether PX4 forwards a mission's command to the camera component instead of executing it."""
    return command in _CAMERA_COMMANDS


_CAMERA_COMMANDS = frozenset(
    {
        mission_items.START_CAPTURE,
        mission_items.STOP_CAPTURE,
        mission_items.SET_CAMERA_MODE,
        mission_items.SET_CAMERA_SOURCE,
        mission_items.START_VIDEO,
        mission_items.STOP_VIDEO,
    }
)
