"""Mission flight: the task of Mode.MISSION, item by item as in PX4's Navigator.

Positions are local NED metres.
"""

from __future__ import annotations

import enum
import math
from typing import Protocol

from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.position_control import NAN, TrajectorySetpoint
from mavlink_sim.flight.precision_landing import Precision, PrecisionLanding
from mavlink_sim.missions import items as mission_items
from mavlink_sim.missions.items import MissionItem
from mavlink_sim.missions.plan import Mission
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.geography import LocalFrame
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.wire.announcements import INFO

NAVIGATOR_PERIOD_S = 0.05  # items are processed at 20 Hz, the trajectory at every step
# Corners below this angle are flown at cruise speed.
STRAIGHT_ON_RAD = math.radians(1.0)
# MPC_YAW_MODE
TOWARDS_WAYPOINT, TOWARDS_HOME, AWAY_FROM_HOME, ALONG_TRAJECTORY, YAW_FIRST = range(5)
_WAIT_FOR_COMMAND = frozenset(
    {mission_items.WINCH, mission_items.GRIPPER, mission_items.GIMBAL_PITCH_YAW}
)  # done after MIS_COMMAND_TOUT
_ROI_LOCATION = 3  # MAV_ROI
_ROI_NEXT = 1


class MissionNavigator(Protocol):
    """What flying a mission uses of the Navigator; see `navigator.Navigator`."""

    frame: LocalFrame
    mission: Mission

    @property
    def now_s(self) -> float: ...

    @property
    def landed(self) -> bool: ...

    @property
    def cruise_mps(self) -> float: ...

    @property
    def home(self) -> Vector: ...

    def reached(self, index: int) -> None: ...

    def current_changed(self) -> None: ...

    def command(self, item: MissionItem) -> None: ...

    def change_speed(self, speed_mps: float) -> None: ...

    def precision_landing(self, precision: Precision, point: Vector | None = None) -> PrecisionLanding: ...

    def send_text(self, severity: int, text: str) -> None: ...


class Stage(enum.Enum):
    """The stage of the current item."""

    CLIMB = "climb"  # to its altitude first, at the current horizontal position
    FLY = "fly"
    MOVE_TO_LAND = "move to land"
    LAND = "land"
    ACT = "act"  # an item without a position


class MissionFlight(flight.TrajectoryTask):
    """Fly the mission on board from its current item on.

    Attributes:
        ended: the mission is over, and the vehicle stays at `goal`.
    """

    def __init__(self, navigator: MissionNavigator, airframe: Multirotor, parameters: Parameters) -> None:
        self._navigator = navigator
        self._mission = navigator.mission
        super().__init__(airframe, parameters)
        self._descent: flight.TrajectoryTask | None = None
        self._since_check_s = 0.0
        self._arrived_s: float | None = None
        self._turned = False
        self._yaw_rad = NAN
        self._roi: Vector | None = None
        self._roi_is_next = False
        self._climb_to_z: float | None = None
        self._from_ground = False
        self.ended = False
        self.goal: Vector = self._trajectory.stopping_point()
        self._stage = Stage.FLY
        self._replay_speed()
        self._check_climb()
        self._begin_item()

    # ---- one step ---------------------------------------------------------------------------------------

    def update(self, dt_s: float) -> TrajectorySetpoint:
        self._since_check_s += dt_s
        if self._since_check_s >= NAVIGATOR_PERIOD_S - 1e-9 and not self.ended:
            self._since_check_s = 0.0
            if self._is_reached():
                self._go_on()
            self.taking_off = self._stage is Stage.CLIMB and self._from_ground
        if self._descent is not None:
            setpoint = self._descent.update(dt_s)
            self.landing = self._descent.landing
            self.goal = self._descent.goal or self.goal
            return setpoint
        self.landing = False
        if self._navigator.landed:
            self._trajectory.keep_height()
        self._trajectory.cruise_mps = self._navigator.cruise_mps
        return self._trajectory.towards(self._aim(), dt_s, self._heading(), **self._climb_speed())

    def _climb_speed(self) -> dict[str, float]:
        """The climb limit: from the ground that of a take-off."""
        if self._stage is Stage.CLIMB and self._navigator.landed:
            return {"max_up_mps": self._parameters.number("MPC_TKO_SPEED")}
        return {}

    # ---- items ------------------------------------------------------------------------------------------

    def _go_on(self) -> None:
        if self._stage is not Stage.CLIMB:
            self._navigator.reached(self._mission.current)
        if not self._mission.item.autocontinue:
            return
        if self._stage is Stage.MOVE_TO_LAND:
            self._descend()
        elif self._stage is Stage.CLIMB:
            self._begin_item()
        elif self._mission.advance():
            self._navigator.current_changed()
            self._begin_item()
        else:
            self._end()

    def _begin_item(self) -> None:
        """Start the current item."""
        item = self._mission.item
        self._arrived_s, self._turned = None, False
        if item.has_position:
            self._fly_to(item)
        elif item.command == mission_items.GATE:
            self._stage = Stage.FLY
            following = self._mission.next_position(self._mission.current + 1)
            if following is not None:
                self.goal = self._point_of(following)
        else:
            self._stage = Stage.ACT
            self._act(item)

    def _fly_to(self, item: MissionItem) -> None:
        landing = item.command == mission_items.LAND
        point = self._point_of(item)
        if self._climb_to_z is not None:
            self._stage = Stage.CLIMB
            self._from_ground = self._navigator.landed
            x, y, _ = self._airframe.position
            self.goal = (x, y, self._climb_to_z)
            self._yaw_rad = NAN
            above = self._navigator.home[2] - self._climb_to_z
            self._navigator.send_text(INFO, f"Climb to {above:.1f} meters above home\t")
            self._climb_to_z = None
        elif landing and not self._navigator.landed and self._away(point) > self._acceptance():
            self._stage = Stage.MOVE_TO_LAND
            self._leave_ground()
            self.goal = (point[0], point[1], self.goal[2])
            self._yaw_rad = NAN
        elif landing:
            self._descend()
        else:
            self._stage = Stage.FLY
            self._leave_ground()
            self.goal = point
            self._yaw_rad = NAN if item.command == mission_items.TAKEOFF else item.yaw_rad

    def _descend(self) -> None:
        item = self._mission.item
        self._stage = Stage.LAND
        self._arrived_s = None
        precision = int(item.parameters[1])
        if precision in (Precision.OPPORTUNISTIC, Precision.REQUIRED) and not self._navigator.landed:
            self._descent = self._navigator.precision_landing(Precision(precision), self.goal)
        else:
            self._descent = flight.Land(self._airframe, self._parameters, self._point_of(item))

    def _leave_ground(self) -> None:
        if self._descent is not None:
            self._descent = None
            self._trajectory = flight.Trajectory(self._airframe, self._parameters)

    def _end(self) -> None:
        self._finish()
        self.ended = True

    def _finish(self) -> None:
        where = "landed" if self._navigator.landed else "loitering"
        self._navigator.send_text(INFO, f"Mission finished, {where}\t")
        self._mission.jumps.clear()
        self._mission.finished = True

    def _act(self, item: MissionItem) -> None:
        command = item.command
        if command == mission_items.DO_LAND_START:
            return
        if command in (mission_items.SET_ROI_LOCATION, mission_items.SET_ROI):
            mode = item.parameters[0] if command == mission_items.SET_ROI else _ROI_LOCATION
            self._roi = self._point_of(item) if mode == _ROI_LOCATION else None
            self._roi_is_next = mode == _ROI_NEXT
        elif command == mission_items.SET_ROI_NEXT_WAYPOINT:
            self._roi, self._roi_is_next = None, True
        elif command == mission_items.SET_ROI_NONE:
            self._roi, self._roi_is_next = None, False
        if command != mission_items.NAV_DELAY:
            self._navigator.command(item)
        if command == mission_items.RETURN_TO_LAUNCH:
            # reached as it begins (since PX4 v1.17): then the mode changes
            self._navigator.reached(self._mission.current)
            if self._mission.current + 1 == len(self._mission.items):
                self._end()

    def _replay_speed(self) -> None:
        """Apply the last speed change before the current item, for a resumed mission."""
        self._navigator.change_speed(0.0)
        for item in self._mission.items[: self._mission.current]:
            if item.command == mission_items.DO_CHANGE_SPEED:
                self._navigator.change_speed(item.parameters[1])

    def _check_climb(self) -> None:
        following = self._mission.next_position(self._mission.current)
        if following is None:
            return
        z = self._point_of(following)[2]
        if self._airframe.position[2] - z > self._parameters.number("NAV_MC_ALT_RAD"):
            self._climb_to_z = z

    # ---- reached ----------------------------------------------------------------------------------------

    def _is_reached(self) -> bool:
        item = self._mission.item
        now = self._navigator.now_s
        if self._stage is Stage.LAND:
            return self._navigator.landed
        if self._stage is Stage.ACT:
            return self._has_acted(item, now)
        if item.command == mission_items.GATE:
            return self._has_passed(item)
        if item.command == mission_items.LOITER_UNLIMITED and self._stage is Stage.FLY:
            return False
        if self._arrived_s is None:
            if self._navigator.landed or not self._is_at(item):
                return False
            self._arrived_s = now
        if not self._turned and math.isfinite(self._yaw_rad):
            off = math.remainder(self._yaw_rad - self._airframe.yaw_rad, math.tau)
            allowed = math.radians(self._parameters.number("MIS_YAW_ERR"))
            patient = self._parameters.number("MIS_YAW_TMT") <= 0.0
            if abs(off) >= allowed and patient:
                return False
        self._turned = True
        return self._stage is not Stage.FLY or now >= self._arrived_s + item.hold_s

    def _has_acted(self, item: MissionItem, now: float) -> bool:
        if item.command == mission_items.RETURN_TO_LAUNCH or item.command == mission_items.IDLE:
            return False  # the mode changes; idling never ends
        if item.command == mission_items.NAV_DELAY or item.command in _WAIT_FOR_COMMAND:
            if self._arrived_s is None:
                self._arrived_s = now
            wait = item.hold_s
            if item.command in _WAIT_FOR_COMMAND:
                wait = self._parameters.number("MIS_COMMAND_TOUT")
            return now >= self._arrived_s + wait
        return True

    def _has_passed(self, item: MissionItem) -> bool:
        """Whether the vehicle has passed the gate on the path to the next waypoint."""
        gate = self._point_of(item)
        x, y, _ = self._airframe.position
        return (x - gate[0]) * (self.goal[0] - gate[0]) + (y - gate[1]) * (self.goal[1] - gate[1]) >= 0.0

    def _is_at(self, item: MissionItem) -> bool:
        altitude_radius = self._parameters.number("NAV_MC_ALT_RAD")
        left = self._airframe.position[2] - self.goal[2]  # metres still to climb
        if self._stage is Stage.CLIMB:
            height = self._navigator.home[2] - self.goal[2]
            if 0.0 < height < altitude_radius:
                altitude_radius = height / 2.0
            return left < altitude_radius
        radius = self._acceptance()
        if item.command == mission_items.WAYPOINT and item.parameters[1] > 0.0 and self._stage is Stage.FLY:
            radius = item.parameters[1]
        if item.command == mission_items.LOITER_TO_ALTITUDE:
            given = abs(item.parameters[1])
            usual = self._parameters.number("NAV_LOITER_RAD")
            radius += given if math.isfinite(given) and given > 0.0 else usual
        return self._away(self.goal) <= radius and abs(left) <= altitude_radius

    def _acceptance(self) -> float:
        return self._parameters.number("NAV_ACC_RAD")

    def _away(self, point: Vector) -> float:
        return math.dist(point[:2], self._airframe.position[:2])

    def _point_of(self, item: MissionItem) -> Vector:
        """The position of an item; NaN components are those of the vehicle."""
        here = self._airframe.position
        if item.frame == mission_items.FRAME_MISSION:
            latitude, longitude, altitude = item.parameters[4:]
            wanted = self._navigator.frame.local(latitude, longitude, altitude)
        else:
            wanted = item.local_position(self._navigator.home, self._navigator.frame)
        x, y, z = (value if math.isfinite(value) else own for value, own in zip(wanted, here, strict=True))
        return (x, y, z)

    # ---- path -------------------------------------------------------------------------------------------

    def _aim(self) -> Vector:
        """The goal, or a point beyond it so that the vehicle passes the goal at speed."""
        x, y, z = self.goal
        px, py, _ = self._trajectory.position
        dx, dy = x - px, y - py
        far = math.hypot(dx, dy)
        speed = self._passing_speed()
        if speed <= 0.0 or far < 1e-3:
            return self.goal
        braking = flight.BRAKING_SHARE * self._parameters.positive("MPC_ACC_HOR")
        beyond = speed * speed / (2.0 * braking) / far
        return (x + dx * beyond, y + dy * beyond, z)

    def _passing_speed(self) -> float:
        """The speed at the current waypoint, m/s: 0 where the vehicle stops, else limited by the next corner.

        The corner is flown on the circle that touches both legs at the acceptance radius.
        """
        item = self._mission.item
        if self._stage is not Stage.FLY or not item.has_position or not item.autocontinue:
            return 0.0
        if item.hold_s > 0.0 or item.command in (mission_items.LOITER_UNLIMITED, mission_items.LAND):
            return 0.0
        following = self._mission.items[self._mission.current + 1 : self._mission.current + 2]
        if following and following[0].command == mission_items.NAV_DELAY:
            return 0.0
        after = self._mission.next_position(self._mission.current + 1)
        if after is None:
            return 0.0
        x, y, _ = self._trajectory.position
        point = self._point_of(after)
        ahead = (self.goal[0] - x, self.goal[1] - y)
        onward = (point[0] - self.goal[0], point[1] - self.goal[1])
        if math.hypot(*ahead) < 1e-3 or math.hypot(*onward) < 1e-3:
            return 0.0
        turn = math.remainder(math.atan2(onward[1], onward[0]) - math.atan2(ahead[1], ahead[0]), math.tau)
        cruise = self._navigator.cruise_mps
        if math.isnan(cruise):
            cruise = self._parameters.number("MPC_XY_CRUISE")
        if abs(turn) < STRAIGHT_ON_RAD:
            return cruise
        radius = self._acceptance() / math.tan(abs(turn) / 2.0)
        braking = flight.BRAKING_SHARE * self._parameters.positive("MPC_ACC_HOR")
        return min(math.sqrt(max(braking * radius, 0.0)), cruise)

    def _heading(self) -> float:
        """The heading: to a region of interest, the item's, else by MPC_YAW_MODE; NaN: unchanged."""
        if self._stage in (Stage.FLY, Stage.ACT):
            interest = self.goal if self._roi_is_next else self._roi
            if interest is not None and self._mission.item.command != mission_items.TAKEOFF:
                return self._towards(interest)
            if math.isfinite(self._yaw_rad):
                return self._yaw_rad
        mode = int(self._parameters.number("MPC_YAW_MODE"))
        if mode in (TOWARDS_WAYPOINT, YAW_FIRST):
            return self._towards(self.goal)
        if mode == TOWARDS_HOME:
            return self._towards(self._navigator.home)
        if mode == AWAY_FROM_HOME:
            return self._towards(self._navigator.home) + math.pi
        vx, vy, _ = self._trajectory.velocity
        if mode == ALONG_TRAJECTORY and math.hypot(vx, vy) > 0.5:
            return math.atan2(vy, vx)
        return NAN

    def _towards(self, point: Vector) -> float:
        if self._away(point) <= self._acceptance():
            return NAN
        x, y, _ = self._airframe.position
        return math.atan2(point[1] - y, point[0] - x)
