"""Copter's decisions: arming checks, modes, landed states, disarming, and its failsafes.

The failsafes are those for the ground station (FS_GCS_*), the EKF's position (FS_EKF_ACTION) and the fence.
It uses the shared control loops and the tasks of this package. Times are seconds since boot. Names in
capitals are ArduPilot's parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from mavlink_sim.autopilot.commander import ACCEPTED, IDLE_THRUST_MPS2, Autopilot
from mavlink_sim.autopilot.ground_contact import TAKEOFF_DETECTION_HEIGHT_M
from mavlink_sim.autopilot.position_failsafe import Descend
from mavlink_sim.flight import manual_flight
from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.position_control import TrajectorySetpoint
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.geography import LocalFrame
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.modes import (
    CUSTOM_MODE_ENABLED,
    GUIDED_ENABLED,
    MANUAL_INPUT_ENABLED,
    SAFETY_ARMED,
    STABILIZE_ENABLED,
    LandedState,
    Mode,
    SystemState,
)
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.releases import Release
from mavlink_sim.vehicles.ardupilot.guided import Guided
from mavlink_sim.vehicles.ardupilot.landing import Land, ReturnToLaunch
from mavlink_sim.vehicles.ardupilot.modes import (
    ARMABLE,
    POSITION_CONTROLLED,
    SUPPORTED,
    WITHOUT_POSITION,
    CopterMode,
)
from mavlink_sim.wire.announcements import CRITICAL, INFO, Text

NOTICE = 5  # MAV_SEVERITY_NOTICE
POSITION_LOST_S = 1.0
FENCE_ALTITUDE, FENCE_CIRCLE = 1, 2  # bits of FENCE_TYPE
STOP_AT_FENCE = 1  # a bit of AVOID_ENABLE
# Speed towards the circle, less FENCE_MARGIN, per remaining metre.
AVOIDANCE_GAIN_PER_S = 1.0
# FS_GCS_ENABLE: 1 RTL, 2 AUTO or RTL, 3 and 4 SMART_RTL, 5 LAND, 7 BRAKE or LAND. There is no SMART_RTL here.
_GCS_MODES = {
    1: CopterMode.RTL,
    2: CopterMode.RTL,
    3: CopterMode.RTL,
    4: CopterMode.LAND,
    5: CopterMode.LAND,
    6: CopterMode.RTL,
    7: CopterMode.BRAKE,
}
# FENCE_ACTION: 1 RTL or LAND, 2 LAND, 3 SMART_RTL or RTL or LAND, 4 BRAKE or LAND, 5 SMART_RTL or LAND.
_FENCE_MODES = {
    1: CopterMode.RTL,
    2: CopterMode.LAND,
    3: CopterMode.RTL,
    4: CopterMode.BRAKE,
    5: CopterMode.LAND,
}
_GOING_DOWN = (CopterMode.LAND, CopterMode.RTL)


FAILED = 4  # MAV_RESULT
WARNING = 4  # MAV_SEVERITY_WARNING
LAND_DETECTION_S = 1.0  # LAND_DETECTOR_TRIGGER_SEC
PREARM_DISPLAY_PERIOD_S = 30.0
SPOOL_UP_S = 2.3  # measured: delay of a take-off right after arming (ARMING_DELAY_SEC, spool-up)
_BASE_MODE = CUSTOM_MODE_ENABLED | STABILIZE_ENABLED | MANUAL_INPUT_ENABLED

# Manual modes and the shared tasks with the same behaviour.
_BY_STICKS = {
    CopterMode.STABILIZE: Mode.STABILIZED,
    CopterMode.ACRO: Mode.ACRO,
    CopterMode.ALT_HOLD: Mode.ALTCTL,
    CopterMode.LOITER: Mode.POSCTL,
    CopterMode.POSHOLD: Mode.POSCTL,
}
# The modes for PX4's names in takeovers by a pilot.
_PILOTS_MODES = {
    Mode.MANUAL: CopterMode.STABILIZE,
    Mode.STABILIZED: CopterMode.STABILIZE,
    Mode.ACRO: CopterMode.ACRO,
    Mode.ALTCTL: CopterMode.ALT_HOLD,
    Mode.POSCTL: CopterMode.LOITER,
    Mode.HOLD: CopterMode.BRAKE,
    Mode.RTL: CopterMode.RTL,
    Mode.LAND: CopterMode.LAND,
    Mode.MISSION: CopterMode.AUTO,
    Mode.OFFBOARD: CopterMode.GUIDED,
}


class CopterAutopilot(Autopilot):
    """The decisions of one Copter.

    Attributes:
        mode: a CopterMode. mode_changes: their count, so that a HEARTBEAT can follow at once.
    """

    mode: Any
    intended_mode: Any
    vtol_state = 3  # MAV_VTOL_STATE_MC, as Copter's always is
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
        super().__init__(
            airframe,
            parameters,
            local_frame=local_frame,
            ready_after_s=ready_after_s,
            on_event=on_event,
            release=release,
        )
        self.mode = self.intended_mode = CopterMode.STABILIZE
        self.mode_changes = 0
        self._next_prearm_s = PREARM_DISPLAY_PERIOD_S / 2
        self.watch = Failsafes(self, parameters)

    # ---- state ------------------------------------------------------------------------------------------

    @property
    def has_setpoints(self) -> bool:
        return False  # there is no stream to lose: GUIDED continues without setpoints

    @property
    def can_arm(self) -> bool:
        return self._reason_against_arming() is None

    @property
    def system_status(self) -> SystemState:
        if self.failsafe:
            return SystemState.CRITICAL
        if not self.sensors_ready:
            return SystemState.UNINIT
        return SystemState.STANDBY if self.landed else SystemState.ACTIVE

    @property
    def base_mode(self) -> int:
        guided = GUIDED_ENABLED if self.armed and self.mode in POSITION_CONTROLLED else 0
        return _BASE_MODE | guided | (SAFETY_ARMED if self.armed else 0)

    @property
    def landed_state(self) -> LandedState:
        if self.landed:
            return LandedState.ON_GROUND
        if self.task is not None and self.task.landing:
            return LandedState.LANDING
        if isinstance(self.task, Guided) and self.task.is_taking_off:
            return LandedState.TAKEOFF
        return LandedState.IN_AIR

    @property
    def guided(self) -> Guided | None:
        """The task of GUIDED while an armed vehicle is in that mode."""
        return self.task if isinstance(self.task, Guided) else None

    @property
    def position(self) -> Vector:
        """The estimated position, local NED."""
        return self._airframe.position

    def _reason_against_arming(self) -> str | None:
        """ArduPilot's reason against arming, without its prefix; None: it can arm."""
        mode: CopterMode = self.mode
        if mode not in WITHOUT_POSITION and not (self.sensors_ready and self.position_valid):
            return "Need Position Estimate"
        if self._parameters.number("ARMING_CHECK"):
            if not self.sensors_ready:
                return "Gyros still settling"
            if self.watch.is_breached:
                return "vehicle outside Fence"
        if mode not in ARMABLE:
            return f"{mode.title} mode not armable"
        return "Motors Emergency Stopped" if self.terminated else None

    # ---- requests ---------------------------------------------------------------------------------------

    def arm(self, by: str = "external command") -> int:
        if self.armed:
            return ACCEPTED
        reason = self._reason_against_arming()
        if reason is not None:
            self._send_text(CRITICAL, f"Arm: {reason}")
            return FAILED
        self.force_arm()
        return ACCEPTED

    def force_arm(self) -> None:
        """Arm without any check (COMPONENT_ARM_DISARM's magic number)."""
        self.armed = True
        self.ground.arm(self.now_s)
        self.home.follow(self._airframe, self._parameters)
        self._send_text(INFO, "Arming motors")
        self._on_event("armed")
        self._start_task()

    def disarm(self, force: bool = False, by: str = "external command") -> int:
        if not self.armed:
            return ACCEPTED
        if not self.landed and not force:
            return FAILED
        self._disarm("Disarming motors", "by command" if by == "external command" else f"by {by}")
        return ACCEPTED

    def request_mode(self, mode: CopterMode) -> int:
        """MAV_RESULT of a request for a mode. A disarmed vehicle accepts every one."""
        if mode not in SUPPORTED:
            self._send_text(WARNING, f"No such mode {int(mode)}")
            return FAILED
        if mode is not self.mode and self.armed:
            reason = None
            if mode not in WITHOUT_POSITION and not self.position_valid:
                reason = "requires position"
            elif mode is CopterMode.AUTO:
                reason = "init failed"  # there is no mission
            if reason is not None:
                self._send_text(WARNING, f"Mode change to {mode.title} failed: {reason}")
                return FAILED
        self.watch.mode_was_chosen()
        self.change_mode(mode)
        return ACCEPTED

    def change_mode(self, mode: CopterMode) -> None:
        """Change the mode; the current one continues unchanged."""
        if mode is self.mode:
            return
        self.intended_mode = mode
        self.mode_changes += 1
        self._enter(mode)

    def set_mode(self, mode: Mode, report: bool = False) -> int:
        """Request a mode by PX4's name, as the shared faults and the pilot's sticks do."""
        meant = _PILOTS_MODES.get(mode)
        return FAILED if meant is None else self.request_mode(meant)

    def can_run(self, mode: Mode) -> bool:
        return _PILOTS_MODES.get(mode) in SUPPORTED

    def user_takeoff(self, height_m: float) -> int:
        """NAV_TAKEOFF: to a height above home, only in GUIDED, armed, on the ground, and upwards."""
        guided = self.guided
        if guided is None or not self.armed or not self.landed:
            return FAILED
        down = self.home.position[2] - height_m
        if not down < self._airframe.position[2]:
            return FAILED
        guided.take_off(down)
        return ACCEPTED

    # ---- one step ---------------------------------------------------------------------------------------

    def update(self, dt_s: float) -> None:
        self.now_s += dt_s
        self._watch(dt_s)
        if not self.armed:
            self._idle(dt_s, 0.0)
            if not self.landed and self._airframe.on_ground:
                self._has_landed()
            return
        task = self.task
        assert task is not None
        self._fly(dt_s, task, task.update(dt_s))
        self._disarm_automatically()

    def _watch(self, dt_s: float) -> None:
        supervision = self.supervision
        supervision.battery.step(dt_s, self.armed, self._airframe.thrust_mps2)
        if supervision.transmitter.on:
            supervision.remote_control(supervision.transmitter.channels())
        supervision.manual_control.update(self.now_s)  # its requests are PX4's gestures and switches
        self.watch.update()
        if not self.armed and self.now_s >= self._next_prearm_s:
            self._next_prearm_s += PREARM_DISPLAY_PERIOD_S
            self.send_prearm()

    def send_prearm(self) -> None:
        """Send the reason against arming; a mode that does not allow it is reported only at arming."""
        reason = self._reason_against_arming()
        if reason is not None and "mode not armable" not in reason:
            self._send_text(CRITICAL, f"PreArm: {reason}")

    def _fly(self, dt_s: float, task: flight.Task, setpoint: flight.Setpoint) -> None:
        if task.demand is not None:
            self._fly_directly(dt_s, task.demand)
        elif self._stays_on_ground(task):
            self._idle(dt_s, IDLE_THRUST_MPS2)
        elif isinstance(setpoint, TrajectorySetpoint):
            self.attitude.release()
            frame = self._airframe
            demand = self.demand = self.controller.update(
                dt_s, setpoint, frame.position, frame.velocity, frame.acceleration, frame.yaw_rad,
                self.ground.climb_limit_mps(self.now_s),
            )  # fmt: skip
            frame.step(dt_s, demand.thrust_mps2, demand.roll_rad, demand.pitch_rad, demand.yaw_rate_radps)
        else:
            self.demand = self.attitude.fly(dt_s, setpoint, self._airframe, self.controller, self.demand)
        vertical = setpoint.velocity[2] if isinstance(setpoint, TrajectorySetpoint) else math.nan
        self._detect_flight(vertical)

    def _stays_on_ground(self, task: flight.Task) -> bool:
        """Whether it stays on the ground: it leaves it only by a take-off or by the pilot's throttle."""
        rises = isinstance(task, Guided) and task.starting
        if self.mode in _BY_STICKS:
            rises = self.supervision.sticks.throttle > manual_flight.TAKEOFF_THROTTLE
        spooling = self.ground.armed_for_s(self.now_s) < SPOOL_UP_S
        return self.ground.rests(self.now_s, rises=rises and not spooling)

    def _detect_flight(self, wanted_down_mps: float) -> None:
        frame, ground = self._airframe, self.ground
        if ground.landed:
            if self.home.position[2] - frame.position[2] > TAKEOFF_DETECTION_HEIGHT_M and not frame.on_ground:
                ground.leave(self.now_s)
                self._on_event("takeoff")
        elif ground.presses(self.now_s, wanted_down_mps):
            self._has_landed()

    def _has_landed(self) -> None:
        self.ground.touch_down(self.now_s)
        self._on_event("landed")
        if self.guided is not None:
            self._start_task()  # a target from before the landing does not cause a take-off

    def _disarm_automatically(self) -> None:
        if not self.landed or not self.armed:
            return
        if self.task is not None and self.task.landing and self.ground.has_flown:
            self._disarm("Disarming motors", "after landing")
            return
        delay = self._parameters.number("DISARM_DELAY")
        starting = self.guided is not None and self.guided.starting
        idle_s = min(self.ground.landed_for_s(self.now_s), self.ground.armed_for_s(self.now_s))
        if delay > 0.0 and not starting and idle_s >= delay:
            self._disarm("Disarming motors", "no takeoff")

    # ---- transitions ------------------------------------------------------------------------------------

    def _start_task(self) -> None:
        airframe, parameters, mode = self._airframe, self._parameters, self.mode
        self.attitude.release()
        by_sticks = _BY_STICKS.get(mode)
        if mode is CopterMode.GUIDED:
            self.task = Guided(airframe, parameters, self.watch.avoid_fence)
        elif by_sticks is not None:
            self.task = manual_flight.task_of(by_sticks, airframe, parameters, self.supervision.read_sticks)
        elif mode is CopterMode.LAND:
            self.task = self.landing_task() if self.position_valid else self._descent()
        elif mode is CopterMode.RTL:
            self.task = ReturnToLaunch(airframe, parameters, self.home.position, self.landing_task)
        else:
            self.task = flight.Hold(airframe, parameters)

    def landing_task(self, point: Vector | None = None) -> Land:
        """The descent, here or at a point."""
        return Land(
            self._airframe, self._parameters, self.navigator.newest_target, self.navigator.time_s, point
        )

    def _descent(self) -> Descend:
        return Descend(self._parameters, self._airframe.yaw_rad)

    def _enter(self, mode: Any) -> None:
        self._on_event(f"mode {mode.name}")
        self.mode = mode
        self.cruise_mps = math.nan
        if self.armed:
            self._start_task()

    def _disarm(self, text: str, reason: str) -> None:
        """Disarm; the mode stays: a Copter that has landed is still in LAND."""
        self.armed = False
        self.task = None
        self.failsafe = False
        self.watch.disarmed()
        self._send_text(INFO, text)
        self.supervision.disarmed()
        self._on_event(f"disarmed ({reason})")


class Failsafes:
    """Copter's automatic mode changes.

    Attributes:
        ground_station_seen_s: the newest heartbeat of SYSID_MYGCS. is_breached: outside the fence.
    """

    def __init__(self, autopilot: CopterAutopilot, parameters: Parameters) -> None:
        self._autopilot = autopilot
        self._parameters = parameters
        self.ground_station_seen_s = math.nan
        self._gcs_lost = self._ekf_lost = False
        self.is_breached = False
        self._position_seen_s = 0.0

    def mode_was_chosen(self) -> None:
        """Note a mode request: an active failsafe does not override it."""
        self._autopilot.failsafe = self._gcs_lost or self._ekf_lost

    def disarmed(self) -> None:
        self._gcs_lost = self._ekf_lost = False

    def update(self) -> None:
        self._check_ground_station()
        self._check_position()
        self._check_fence()
        self._autopilot.failsafe = self._gcs_lost or self._ekf_lost

    def avoid_fence(self, velocity: Vector) -> Vector:
        """A commanded velocity limited towards the fence circle; its tangential component is unchanged."""
        value, autopilot = self._parameters.number, self._autopilot
        circle = value("FENCE_ENABLE") and int(value("FENCE_TYPE")) & FENCE_CIRCLE
        if not circle or not int(value("AVOID_ENABLE")) & STOP_AT_FENCE:
            return velocity
        north, east, _ = (
            point - home for point, home in zip(autopilot.position, autopilot.home.position, strict=True)
        )
        distance_m = max(math.hypot(north, east), 1e-6)
        north, east = north / distance_m, east / distance_m
        left_m = value("FENCE_RADIUS") - value("FENCE_MARGIN") - distance_m
        outwards_mps = north * velocity[0] + east * velocity[1]
        too_fast_mps = max(0.0, outwards_mps - max(0.0, AVOIDANCE_GAIN_PER_S * left_m))
        return (velocity[0] - too_fast_mps * north, velocity[1] - too_fast_mps * east, velocity[2])

    def _check_ground_station(self) -> None:
        autopilot, value = self._autopilot, self._parameters.number
        if math.isnan(self.ground_station_seen_s):
            return  # without a first heartbeat it is not lost
        action = int(value("FS_GCS_ENABLE"))
        silent_s = autopilot.now_s - self.ground_station_seen_s
        lost = action in _GCS_MODES and autopilot.armed and silent_s > value("FS_GCS_TIMEOUT")
        if lost is self._gcs_lost:
            return
        self._gcs_lost = lost
        if not lost:
            self._send_text("GCS Failsafe Cleared")
            return
        self._send_text("GCS Failsafe")
        autopilot.announce("failsafe: ground station lost")
        if autopilot.landed:
            autopilot.disarm(force=True, by="failsafe")
        elif autopilot.mode is not CopterMode.LAND:
            self._change(_GCS_MODES[action])

    def _check_position(self) -> None:
        autopilot = self._autopilot
        if autopilot.position_valid:
            self._position_seen_s = autopilot.now_s
            if self._ekf_lost:
                self._ekf_lost = False
                autopilot.texts.append(Text(CRITICAL, "EKF Failsafe Cleared"))
            return
        blind_s = autopilot.now_s - self._position_seen_s
        if self._ekf_lost or not autopilot.armed or blind_s < POSITION_LOST_S:
            return
        if not self._parameters.number("FS_EKF_ACTION"):
            return
        if autopilot.mode in WITHOUT_POSITION and autopilot.mode is not CopterMode.LAND:
            return
        self._ekf_lost = True
        autopilot.announce("failsafe: position lost")
        if autopilot.mode is CopterMode.LAND:
            autopilot.restart_task()  # it descends without a position
        else:
            autopilot.change_mode(CopterMode.LAND)
        autopilot.texts.append(Text(CRITICAL, f"EKF Failsafe: changed to {autopilot.mode.title} Mode"))

    def _check_fence(self) -> None:
        autopilot, value = self._autopilot, self._parameters.number
        breach = self._breach() if value("FENCE_ENABLE") else None
        was_breached, self.is_breached = self.is_breached, breach is not None
        if breach is None or was_breached or not autopilot.armed or autopilot.landed:
            return
        autopilot.texts.append(Text(NOTICE, f"{breach} fence breached"))
        autopilot.announce(f"{breach} fence breached")
        mode = _FENCE_MODES.get(int(value("FENCE_ACTION")))
        if mode is not None and autopilot.mode not in _GOING_DOWN:
            self._change(mode)

    def _breach(self) -> str | None:
        autopilot, value = self._autopilot, self._parameters.number
        kinds = int(value("FENCE_TYPE"))
        north, east, down = (
            point - home for point, home in zip(autopilot.position, autopilot.home.position, strict=True)
        )
        if kinds & FENCE_ALTITUDE and -down > value("FENCE_ALT_MAX"):
            return "Max Alt"
        if kinds & FENCE_CIRCLE and math.hypot(north, east) > value("FENCE_RADIUS"):
            return "Circle"
        return None

    def _change(self, mode: CopterMode) -> None:
        """The failsafe's mode, or LAND where that one needs a position."""
        blind = not self._autopilot.position_valid and mode not in WITHOUT_POSITION
        self._autopilot.change_mode(CopterMode.LAND if blind else mode)

    def _send_text(self, text: str) -> None:
        self._autopilot.texts.append(Text(WARNING, text))
