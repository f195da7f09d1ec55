"""PX4's Commander, reduced: arming checks, modes, the offboard-loss failsafe, landed states, auto-disarming.

`update` runs once per control step. PX4's texts for ground stations are queued in `texts`.
Times are seconds since boot. Names in capitals are PX4's parameters.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable

from mavlink_sim.autopilot import position_failsafe
from mavlink_sim.autopilot.ground_contact import TAKEOFF_DETECTION_HEIGHT_M, GroundContact, asks_to_rise
from mavlink_sim.autopilot.home import Home
from mavlink_sim.autopilot.supervision import REASONS, Supervision
from mavlink_sim.flight import manual_flight
from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.attitude_control import AttitudeController, RatesSetpoint
from mavlink_sim.flight.orbit import Orbit, OrbitRequest
from mavlink_sim.flight.position_control import Demand, PositionController, TrajectorySetpoint
from mavlink_sim.flight.precision_landing import Precision
from mavlink_sim.flight.tasks import Reposition, reposition_goal
from mavlink_sim.missions.navigator import Navigator
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.geography import LocalFrame
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.modes import (
    MANUAL_MODES,
    MODES_PREVENTING_ARMING,
    LandedState,
    Mode,
    SystemState,
    base_mode,
)
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.releases import Release
from mavlink_sim.wire.announcements import (
    ARMED_EVENT,
    ARMING_DENIED_EVENT,
    CRITICAL,
    DEFAULT_ALTITUDE_EVENT,
    DISARMED_EVENT,
    GIMBAL_COMMANDS,
    INFO,
    LANDED_EVENT,
    LANDING_EVENT,
    TAKEOFF_EVENT,
    GimbalCommand,
    Text,
)

ACCEPTED = 0  # MAV_RESULT
TEMPORARILY_REJECTED = 1

# Measured: a vehicle that does not take off is disarmed 11.2 s after arming with COM_DISARM_PRFLT = 10.
PREFLIGHT_DISARM_MARGIN_S = 1.2
# Measured with COM_OF_LOSS_T = 1: OFFBOARD is left 1.05-1.15 s after the last setpoint; a stream of 0.9 Hz is
# lost for 50 ms at a time.
OFFBOARD_LOSS_MARGIN_S = 0.06
# PX4's land detector needs ground contact, then "maybe landed", then "landed": together about this long.
LAND_DETECTION_S = 1.5
# Least time between two texts that a mode is not available.
DENIED_TEXT_PERIOD_S = 1.0
IDLE_THRUST_MPS2 = 0.6


class Autopilot:
    """The decisions of one vehicle. `now_s` is the time since boot, advanced by `update`."""

    vtol_state = 0  # MAV_VTOL_STATE_UNDEFINED
    # time of ground contact until it is landed
    _land_detection_s = LAND_DETECTION_S

    def __init__(
        self,
        airframe: Multirotor,
        parameters: Parameters,
        *,
        local_frame: LocalFrame,
        ready_after_s: float,
        on_event: Callable[[str], None],
        release: Release,
    ) -> None:
        self._airframe = airframe
        self._parameters = parameters
        self._ready_after_s = ready_after_s
        self._on_event = on_event
        self.controller = PositionController(parameters)
        self.controller.reset(airframe.yaw_rad)
        self.attitude = AttitudeController(parameters)
        self.cruise_mps = math.nan  # of DO_CHANGE_SPEED; it ends with the mode
        self.now_s = 0.0
        self.armed = False
        self.mode = Mode.HOLD
        self.intended_mode = Mode.HOLD
        self.failsafe = False
        self.ground = GroundContact(airframe, parameters, self._land_detection_s)
        self.position_valid = True  # horizontally; without it PX4 refuses and leaves most modes
        self.home = Home(airframe)
        self.commands_handled = 0
        self.texts: deque[Text] = deque()
        self.supervision = Supervision(self, parameters, release)
        self.gimbal_commands: deque[GimbalCommand] = deque()
        self.demand = Demand(0.0, 0.0, 0.0, 0.0)
        self._gimbal_schedule: deque[tuple[float, GimbalCommand]] = deque()
        self._takeoff_height_m: float | None = None
        self.task: flight.Task | None = None
        self._mode_after_disarming = Mode.HOLD
        self._had_sticks = False
        self._last_setpoint_s = self._denied_sent_s = -math.inf
        self._setpoint_needs_position = False
        self.navigator = Navigator(self, airframe, parameters, local_frame, on_event)
        # collision prevention: may reduce the sticks' setpoint in Position mode
        self.stick_guard: manual_flight.AccelerationGuard | None = self.navigator.guard_sticks

    # ---- state ------------------------------------------------------------------------------------------

    @property
    def landed(self) -> bool:
        """Landed, by the land detector."""
        return self.ground.landed

    @property
    def has_setpoints(self) -> bool:
        """The offboard stream is alive (COM_OF_LOSS_T)."""
        if self._setpoint_needs_position and not self.position_valid:
            return False
        limit = self._parameters.number("COM_OF_LOSS_T") + OFFBOARD_LOSS_MARGIN_S
        return self.now_s - self._last_setpoint_s <= limit

    @property
    def pilot_has_sticks(self) -> bool:
        """A remote control or a joystick is valid, so manual modes can be flown."""
        return self.supervision.pilot_has_sticks

    @pilot_has_sticks.setter
    def pilot_has_sticks(self, attached: bool) -> None:
        self.supervision.pilot_attached = attached

    @property
    def lacks_ground_station(self) -> bool:
        """NAV_DLL_ACT requires a ground station, and none is connected."""
        return self.supervision.lacks_ground_station

    @property
    def ground_station_lost(self) -> bool:
        return self.supervision.conditions.ground_station_lost

    @property
    def terminated(self) -> bool:
        """Flight termination: the motors are off until a reboot."""
        return self.supervision.terminated

    @property
    def sensors_ready(self) -> bool:
        return self.now_s >= self._ready_after_s

    @property
    def can_arm(self) -> bool:
        """PX4's prearm check of the current mode (SYS_STATUS' bit MAV_SYS_STATUS_PREARM_CHECK)."""
        return (
            self.sensors_ready
            and not self.terminated
            and (self.position_valid or not position_failsafe.needs_position(self.mode))
            and (self.armed or self.mode not in MODES_PREVENTING_ARMING)  # irrelevant once armed
            and (self.navigator.mission.valid or not (self.requires_mission or self.mode is Mode.MISSION))
            and not self.navigator.is_breached
            and (self.mode is not Mode.OFFBOARD or self.has_setpoints)
            and (self.mode not in MANUAL_MODES or self.pilot_has_sticks)
            and self.supervision.allows_arming
        )

    @property
    def requires_mission(self) -> bool:
        return self.supervision.requires_mission

    @property
    def system_status(self) -> SystemState:
        if self.terminated:
            return SystemState.FLIGHT_TERMINATION
        if self.failsafe and self.armed:
            return SystemState.CRITICAL
        if self.armed:
            return SystemState.ACTIVE
        return SystemState.STANDBY if self.can_arm else SystemState.UNINIT

    @property
    def base_mode(self) -> int:
        # PX4 uses the newest setpoint, however old
        has_setpoint = math.isfinite(self._last_setpoint_s)
        return base_mode(self.mode, self.armed, has_setpoint)

    @property
    def landed_state(self) -> LandedState:
        if self.landed:
            return LandedState.ON_GROUND
        if self.mode is Mode.TAKEOFF or (self.task is not None and self.task.taking_off):
            return LandedState.TAKEOFF
        if self.task is not None and self.task.landing:
            return LandedState.LANDING
        return LandedState.IN_AIR

    # ---- requests ---------------------------------------------------------------------------------------

    def arm(self, by: str = "external command") -> int:
        """MAV_RESULT of an arming request. `by`: PX4's name of the source, a key of `supervision.REASONS`."""
        if self.armed:
            return ACCEPTED
        denied = self.supervision.refuses_arming(by)
        if denied is not None:
            self.texts.append(denied)
            return TEMPORARILY_REJECTED
        if not self.can_arm:
            if not self.sensors_ready:
                self._send_text(CRITICAL, "Preflight Fail: heading estimate not stable")
            self._send_text(
                CRITICAL, "Arming denied: Resolve system health failures first\t", ARMING_DENIED_EVENT
            )
            self.report_checks()
            return TEMPORARILY_REJECTED
        self.armed = True
        self.ground.arm(self.now_s)
        self.home.follow(self._airframe, self._parameters)
        self._send_text(INFO, f"Armed by {by}\t", (*ARMED_EVENT[:2], bytes([REASONS[by]])))
        self._on_event("armed")
        self._start_task()
        return ACCEPTED

    def report_checks(self) -> None:
        """Report the failing checks by their events, for RUN_PREARM_CHECKS and when arming is denied."""
        self.supervision.report_checks()

    def disarm(self, force: bool = False, by: str = "external command") -> int:
        """MAV_RESULT of a disarming request; `force` stops the motors in the air too."""
        if not self.armed:
            return ACCEPTED
        if not self.landed and not force and not self.supervision.may_disarm_in_the_air(by):
            if by != "stick gesture":
                self._send_text(CRITICAL, "Disarming denied: not landed\t")
            return TEMPORARILY_REJECTED
        self._disarm(f"Disarmed by {by}\t", "by command" if by == "external command" else f"by {by}")
        return ACCEPTED

    def set_mode(self, mode: Mode, report: bool = False) -> int:
        """MAV_RESULT of a request for a mode; with `report`, a rejected one is also a text."""
        if self.armed and not self.can_run(mode):
            if report:
                self.report_unavailable(mode)
            return TEMPORARILY_REJECTED
        self._intend(mode)
        return ACCEPTED

    def force_mode(self, mode: Mode) -> int:
        """Set a mode that is always accepted: LAND, which without a position is a descent."""
        self._intend(mode)
        return ACCEPTED

    def _refuses(self, mode: Mode) -> bool:
        """Whether a command that would switch to this mode is refused, which is reported."""
        refused = self.armed and not self.can_run(mode)
        if refused:
            self.report_unavailable(mode)
        return refused

    def report_unavailable(self, mode: Mode) -> None:
        """Report a refused mode, at most once per second as PX4 does."""
        if self.now_s - self._denied_sent_s > DENIED_TEXT_PERIOD_S:
            self._denied_sent_s = self.now_s
            self._send_text(CRITICAL, f"Switching to {mode.title} is currently not available\t")

    def can_run(self, mode: Mode) -> bool:
        """Whether an armed vehicle may fly in this mode now."""
        if not self.position_valid and position_failsafe.needs_position(mode):
            return False
        if mode is Mode.OFFBOARD:
            return self.has_setpoints
        if mode in MANUAL_MODES:
            return self.pilot_has_sticks
        return mode is not Mode.MISSION or self.navigator.mission.valid

    def takeoff(self, altitude_m: float | None) -> int:
        """Mode TAKEOFF to a height above home (None: MIS_TAKEOFF_ALT). It never arms."""
        if self._refuses(Mode.TAKEOFF):
            return TEMPORARILY_REJECTED
        if altitude_m is None:
            altitude_m = self._parameters.number("MIS_TAKEOFF_ALT")
            self._send_text(
                INFO,
                f"Using default takeoff altitude: {altitude_m:.1f} m\t",
                (DEFAULT_ALTITUDE_EVENT, 0x66, struct.pack("<f", altitude_m)),
            )
        elif altitude_m < self.home.position[2] - self._airframe.position[2]:
            # happens with a height above ground sent as AMSL; the vehicle does not descend
            self._send_text(CRITICAL, "Already higher than takeoff altitude\t")
        self._takeoff_height_m = altitude_m
        self._intend(Mode.TAKEOFF)
        return ACCEPTED

    def land(self) -> int:
        """Always accepted: without a position it descends."""
        self._send_text(INFO, "Landing at current position\t", LANDING_EVENT)
        return self.force_mode(Mode.LAND)

    def return_home(self) -> int:
        if self._refuses(Mode.RTL):
            return TEMPORARILY_REJECTED
        self._send_text(INFO, "Returning to launch\t")
        self._intend(Mode.RTL)
        return ACCEPTED

    def reposition(self, goal: Vector, yaw_rad: float, speed_mps: float = math.nan) -> int:
        """Fly to a local NED position and hold there; NaN components as in `reposition_goal`."""
        if self._refuses(Mode.HOLD):
            return TEMPORARILY_REJECTED
        former = self._goal()
        self._intend(Mode.HOLD)
        self._move_hold(goal, yaw_rad, speed_mps, former)
        return ACCEPTED

    def move_hold_to(self, goal: Vector, yaw_rad: float, speed_mps: float) -> None:
        """Move the goal if the mode is HOLD already; neither mode nor intention changes."""
        self._move_hold(goal, yaw_rad, speed_mps, self._goal())

    def _move_hold(self, goal: Vector, yaw_rad: float, speed_mps: float, former: Vector | None) -> None:
        if not (self.armed and self.mode is Mode.HOLD):  # not armed, or a failsafe is active
            return
        airframe, parameters = self._airframe, self._parameters
        goal = reposition_goal(goal, yaw_rad, airframe, parameters, former)
        if not self.navigator.allows_goal(goal):
            self._send_text(CRITICAL, "Reposition is outside geofence\t")
            return
        self.task = Reposition(airframe, parameters, goal, yaw_rad, self.home.position)
        self.task.cruise_at(speed_mps if speed_mps > 0.0 else self.cruise_mps)

    def _goal(self) -> Vector | None:
        return None if self.task is None else self.task.goal

    def change_speed(self, speed_mps: float, at_once: bool) -> None:
        """Set the cruise speed of auto modes until the mode ends; zero or less: MPC_XY_CRUISE.

        `at_once`: for the current goal too, else from the next one on.
        """
        self.cruise_mps = speed_mps if speed_mps > 0.0 else math.nan
        if at_once and speed_mps > 0.0 and self.task is not None:
            self.task.cruise_at(speed_mps)

    def orbit(self, request: OrbitRequest) -> int:
        """Mode ORBIT; an invalid radius is accepted too, and then the vehicle hovers in that mode."""
        if self.armed and not self.can_run(Mode.ORBIT):
            self._send_text(CRITICAL, "Orbit command rejected")
            return TEMPORARILY_REJECTED
        if self.mode is not Mode.ORBIT or not isinstance(self.task, Orbit):
            self._intend(Mode.ORBIT)
        if isinstance(self.task, Orbit) and not self.task.apply(request):
            self._send_text(CRITICAL, "Orbit radius limit exceeded\t")
        return ACCEPTED

    def pilot_takes_over(self, mode: Mode = Mode.POSCTL) -> int:
        """A pilot with a remote control switches the mode and takes over from a companion."""
        self.pilot_has_sticks = True
        return self.set_mode(mode)

    def hold_at(self, point: Vector) -> None:
        """Change to HOLD at a local NED position instead of the end of braking."""
        self._intend(Mode.HOLD)
        if self.armed and self.mode is Mode.HOLD:  # no failsafe is active
            self.task = flight.Hold(self._airframe, self._parameters, point)

    def restart_task(self) -> None:
        """Restart the current mode's task."""
        self._start_task()

    def offboard_setpoint(self, setpoint: TrajectorySetpoint) -> None:
        """Use a valid setpoint. Outside OFFBOARD it only keeps the signal alive."""
        self._last_setpoint_s = self.now_s
        self._setpoint_needs_position = position_failsafe.asks_for_position(setpoint)
        if self.mode is Mode.OFFBOARD and isinstance(self.task, flight.Offboard):
            self.task.setpoint = setpoint

    # ---- one step ---------------------------------------------------------------------------------------

    @property
    def status(self) -> tuple[object, ...]:
        """PX4 publishes its vehicle_status at once when this changes; each command counts as a change."""
        return self.mode, self.intended_mode, self.armed, self.failsafe, self.commands_handled

    def update(self, dt_s: float) -> None:
        """Check failsafes and detectors, run the flight task, move the airframe."""
        self.now_s += dt_s
        self.navigator.update()
        supervision, airframe = self.supervision, self._airframe
        supervision.update(dt_s, airframe)
        self._keep_landing()
        self._follow_sticks()
        while self._gimbal_schedule and self._gimbal_schedule[0][0] <= self.now_s:
            self.gimbal_commands.append(self._gimbal_schedule.popleft()[1])
        if not self.armed or supervision.terminated:
            self._idle(dt_s, 0.0)
            if not self.landed and airframe.on_ground:
                self._has_landed()
            if self.armed:
                self._disarm_automatically()
            return
        task = self.task
        assert task is not None
        was_landing = task.landing
        setpoint = task.update(dt_s)
        if task.landing and not was_landing and self.mode is Mode.RTL:
            self._send_text(INFO, "RTL: land at destination\t")
        if supervision.motors_stopped:
            self._idle(dt_s, 0.0)
        elif task.demand is not None:
            self._fly_directly(dt_s, task.demand)
        elif isinstance(setpoint, RatesSetpoint):
            if self._spooling():
                self._idle(dt_s, IDLE_THRUST_MPS2)
            else:
                self.demand = self.attitude.fly(dt_s, setpoint, airframe, self.controller, self.demand)
        elif self.ground.landed and self._rests(setpoint):
            self._idle(dt_s, IDLE_THRUST_MPS2)
        else:
            self.attitude.release()
            demand = self.demand = self.controller.update(
                dt_s,
                setpoint,
                airframe.position,
                airframe.velocity,
                airframe.acceleration,
                airframe.yaw_rad,
                self.ground.climb_limit_mps(self.now_s),
            )
            airframe.step(dt_s, demand.thrust_mps2, demand.roll_rad, demand.pitch_rad, demand.yaw_rate_radps)
        self._detect_landing()
        self._disarm_automatically()
        if self.armed and task is self.task and task.finished and self.mode is Mode.TAKEOFF:
            goal = task.goal
            assert goal is not None
            self.hold_at(goal)

    def _idle(self, dt_s: float, thrust_mps2: float) -> None:
        airframe = self._airframe
        self.attitude.release()
        self.controller.reset(airframe.yaw_rad)
        self.demand = Demand(thrust_mps2, 0.0, 0.0, 0.0)
        airframe.step(dt_s, thrust_mps2, 0.0, 0.0, 0.0)

    def _fly_directly(self, dt_s: float, demand: Demand) -> None:
        """Tilt and thrust by the pilot's sticks, without position control."""
        self.attitude.release()
        self.controller.reset(self._airframe.yaw_rad)
        if self._spooling():
            demand = Demand(IDLE_THRUST_MPS2, 0.0, 0.0, 0.0)
        self.demand = demand
        self._airframe.step(
            dt_s, demand.thrust_mps2, demand.roll_rad, demand.pitch_rad, demand.yaw_rate_radps
        )

    def _spooling(self) -> bool:
        return self.ground.armed_for_s(self.now_s) < self._parameters.number("COM_SPOOLUP_TIME")

    def _rests(self, setpoint: TrajectorySetpoint) -> bool:
        """Whether it stays on the ground, where it is: the setpoint does not climb."""
        rises = asks_to_rise(self.task, setpoint, self._airframe.position[2]) and not self._spooling()
        return self.ground.rests(self.now_s, rises=rises)

    def _detect_landing(self) -> None:
        airframe = self._airframe
        if self.ground.landed:
            # An estimate that drifts is no take-off.
            height_m = airframe.floor_down_m - airframe.position[2]
            if height_m > TAKEOFF_DETECTION_HEIGHT_M and not airframe.on_ground:
                self.ground.leave(self.now_s)
                self._send_text(INFO, "Takeoff detected\t", TAKEOFF_EVENT)
                self._on_event("takeoff")
        elif self.ground.presses(self.now_s, self.controller.velocity[2]):
            self._has_landed()

    def _has_landed(self) -> None:
        self.ground.touch_down(self.now_s)
        if not self.armed:  # it fell
            self.home.follow(self._airframe, self._parameters)
        self._send_text(INFO, "Landing detected\t", LANDED_EVENT)
        self._on_event("landed")

    def _disarm_automatically(self) -> None:
        ground = self.ground
        if not ground.landed:
            return
        if ground.has_flown and self.navigator.in_progress and not self.terminated:
            return
        if ground.has_flown:
            delay = self._parameters.number("COM_DISARM_LAND")
            if delay >= 0.0 and ground.landed_for_s(self.now_s) >= delay:
                self._disarm("Disarmed by landing\t", "after landing")
        else:
            delay = self._parameters.number("COM_DISARM_PRFLT")
            if delay > 0.0 and ground.armed_for_s(self.now_s) >= delay + PREFLIGHT_DISARM_MARGIN_S:
                self._disarm("Disarmed by auto preflight disarming\t", "no takeoff")

    # ---- transitions ------------------------------------------------------------------------------------

    def _intend(self, mode: Mode) -> None:
        self.adopt_intention(mode)
        self.supervision.mode_was_requested()
        self._enter(self.supervision.run_failsafes())

    # The user, the geofence, lost setpoints, links, the battery and a lost position all influence the mode.
    # None of them sets it: they report to `supervision.conditions` or through `can_run`, and the failsafe
    # state machine selects the worst action. `_enter` gets only that selection.

    def adopt_intention(self, mode: Mode) -> None:
        """Set the mode that the user wants; the failsafes decide whether it is active."""
        self.intended_mode = mode
        if mode not in MODES_PREVENTING_ARMING:
            self._mode_after_disarming = mode

    def follow_failsafes(self, mode: Mode) -> None:
        """Enter the mode that the failsafes have selected."""
        if mode is not self.mode and self.landed and isinstance(self.task, position_failsafe.Descend):
            self.adopt_intention(
                Mode.LAND
            )  # it descended without a position: it must not take off again when the position is back
            mode = self.supervision.run_failsafes()
        if mode is not self.mode:
            self._enter(mode)

    def announce(self, line: str) -> None:
        """Report an event of the simulation."""
        self._on_event(line)

    def _enter(self, mode: Mode) -> None:
        if mode is not self.mode:
            self._on_event(f"mode {mode.name}")
            self.cruise_mps = math.nan
        self.mode = mode
        if not self.armed:
            return
        self._start_task()
        self._gimbal_schedule.clear()
        if mode in (Mode.LAND, Mode.RTL) and not self.landed:
            self._gimbal_schedule.extend((self.now_s + delay, command) for delay, command in GIMBAL_COMMANDS)

    def _start_task(self) -> None:
        airframe, parameters = self._airframe, self._parameters
        self.attitude.release()
        if self.mode is Mode.OFFBOARD:
            if not isinstance(self.task, flight.Offboard):
                self.task = flight.Offboard()
        elif self.mode is Mode.ORBIT:
            self.task = Orbit(airframe, parameters)
        elif self.mode in MANUAL_MODES and not self.pilot_has_sticks:
            self.task = position_failsafe.task_without_sticks(self.mode, airframe, parameters, self.demand)
        elif self.mode in MANUAL_MODES:
            self.task = manual_flight.task_of(
                self.mode, airframe, parameters, self.supervision.read_sticks, self.stick_guard
            )
        elif self.mode is Mode.TAKEOFF:
            self.task = flight.Takeoff(airframe, parameters, self.home.position[2] - self._takeoff_height())
        elif self.mode is Mode.MISSION:
            self.task = self.navigator.mission_task()
        elif self.mode is Mode.PRECLAND:
            self.task = self.navigator.precision_landing(Precision.REQUIRED)
        elif self.mode is Mode.LAND:
            self.task = self._landing_task()
        elif self.mode is Mode.RTL:
            self.task = self.navigator.return_task()
        else:
            self.task = flight.Hold(airframe, parameters)

    def _landing_task(self) -> flight.Task:
        return position_failsafe.landing_task(
            self._airframe, self._parameters, position_valid=self.position_valid
        )

    def _keep_landing(self) -> None:
        """A landing continues as a descent when the position is lost, and at one point when it is back."""
        if self.mode is not Mode.LAND or not self.armed:
            return
        descending = isinstance(self.task, position_failsafe.Descend)
        if descending and self.landed:
            return  # it is down
        if descending is self.position_valid:
            self.task = self._landing_task()

    def _follow_sticks(self) -> None:
        """A mode of sticks is flown by another task while there are none."""
        if self.mode in MANUAL_MODES and self.armed and self.pilot_has_sticks is not self._had_sticks:
            self._start_task()
        self._had_sticks = self.pilot_has_sticks

    def _takeoff_height(self) -> float:
        height = self._takeoff_height_m
        return self._parameters.number("MIS_TAKEOFF_ALT") if height is None else height

    def _disarm(self, text: str, reason: str) -> None:
        self.armed = False
        self.failsafe = False
        self.task = None
        self._takeoff_height_m = None
        if self.landed:
            self.home.follow(self._airframe, self._parameters)
        code = REASONS.get(reason.removeprefix("by "), 6 if reason == "after landing" else 4)
        self._send_text(INFO, text, (DISARMED_EVENT, 0x66, bytes([code])))
        self.supervision.disarmed()
        self._on_event(f"disarmed ({reason})")
        self.intended_mode = self._mode_after_disarming
        self._enter(self.intended_mode)

    def _send_text(self, severity: int, text: str, event: tuple[int, int, bytes] | None = None) -> None:
        self.texts.append(Text(severity, text, event))
