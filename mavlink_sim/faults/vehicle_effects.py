"""Effects on the vehicle itself: position, estimate, battery, rotors, wind, camera, pilot, modes, reboot."""

from __future__ import annotations

import math
import random
from functools import partial

from mavlink_sim.autopilot.commander import TEMPORARILY_REJECTED
from mavlink_sim.camera.freeze import CameraFreeze
from mavlink_sim.faults.context import ActiveFault, FaultTarget
from mavlink_sim.faults.grammar import FaultError
from mavlink_sim.flight.tasks import Trajectory
from mavlink_sim.physics.fallible_estimate import ZERO
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.modes import Mode, mode_of
from mavlink_sim.wire.announcements import Text

DEAD_RECKONING_S = 5.0  # EKF2_NOAID_TOUT
REACQUISITION_S = 1.0  # from the first fix to a position that is fused again
DEAD_RECKONING_BIAS_MPS2 = 0.03  # of an accelerometer, after PX4 learnt most of it
GUST_S = 4.0
# Between PX4's default thresholds (BAT_LOW_THR 0.15, BAT_CRIT_THR 0.07, BAT_EMERGEN_THR 0.05).
CHARGE_OF_WARNING = {"low": 0.14, "critical": 0.065, "emergency": 0.04}
WARNING, INFO = 4, 6  # MAV_SEVERITY

# Commands that are a request for a mode; DO_SET_MODE (176) names it in its parameters.
_MODE_OF_COMMAND = {
    20: Mode.RTL,
    21: Mode.LAND,
    22: Mode.TAKEOFF,
    34: Mode.ORBIT,
    186: Mode.HOLD,
    192: Mode.HOLD,
    300: Mode.MISSION,
}
_DO_SET_MODE = 176


# ---- position and estimate


def gps_loss(vehicle: FaultTarget, one: ActiveFault) -> None:
    """No fix: dead reckoning drifts for 5 s, then the position is invalid until shortly after the end.

    While vision is fused nothing drifts, and the 5 s begin after it.
    """
    estimate, faults = vehicle.estimate, vehicle.faults
    angle = random.Random(one.seed).uniform(0.0, math.tau)
    north, east = DEAD_RECKONING_BIAS_MPS2 * math.cos(angle), DEAD_RECKONING_BIAS_MPS2 * math.sin(angle)
    began_s, drifted_m = faults.now_s, 0.0
    estimate.fix_lost += 1
    vehicle.autopilot.texts.append(Text(WARNING, "GNSS data fusion stopped\t"))

    def each_step(dt_s: float) -> None:
        nonlocal began_s, drifted_m
        since_s = faults.now_s - began_s
        drift = drifted_m + since_s * since_s / 2.0
        if vehicle.vision.position_fused:
            if since_s > dt_s:
                drifted_m = min(drift, drifted_m + DEAD_RECKONING_S**2 / 2.0)
            began_s = faults.now_s
            vehicle.estimate.set_error(one.number, (north * drifted_m, east * drifted_m, 0.0))
        elif since_s < DEAD_RECKONING_S:
            error = (north * drift, east * drift, 0.0)
            vehicle.estimate.set_error(one.number, error, (north * since_s, east * since_s, 0.0))
        elif estimate.held_xy_m is None:
            x, y, _ = estimate.position
            estimate.held_xy_m = (x, y)  # from here on EKF2 fuses an assumed standstill
            estimate.count_reset(2)
            estimate.position_valid = vehicle.autopilot.position_valid = False

    def undo() -> None:
        estimate.fix_lost -= 1
        vehicle.after(REACQUISITION_S, partial(_fuse_again, vehicle, one.number))

    one.each_step = each_step
    one.undo.append(undo)


def _fuse_again(vehicle: FaultTarget, number: int) -> None:
    estimate = vehicle.estimate
    estimate.set_error(number, None)
    if estimate.fix_lost:
        return
    vehicle.vision.on_gnss()
    if estimate.held_xy_m is not None:
        estimate.held_xy_m = None
        estimate.position_valid = vehicle.autopilot.position_valid = True
    _jumped(vehicle, 2)
    vehicle.autopilot.texts.append(Text(INFO, "GNSS data fusion started\t"))


def gps_drift(vehicle: FaultTarget, one: ActiveFault) -> None:
    """The receiver's position drifts; the estimate follows, and the vehicle holds the estimate."""
    values = one.fault.values
    angle = _direction(values["towards"], one.seed)
    drifted_m = 0.0

    def each_step(dt_s: float) -> None:
        nonlocal drifted_m
        speed = values["speed"] if drifted_m < values["limit"] else 0.0
        drifted_m = min(drifted_m + speed * dt_s, values["limit"])
        north, east = math.cos(angle), math.sin(angle)
        error = (drifted_m * north, drifted_m * east, 0.0)
        vehicle.estimate.gps_drift[one.number] = error
        vehicle.estimate.set_error(one.number, error, (speed * north, speed * east, 0.0))

    def undo() -> None:
        vehicle.estimate.gps_drift.pop(one.number, None)
        vehicle.estimate.set_error(one.number, None)
        _jumped(vehicle)

    one.each_step = each_step
    one.undo.append(undo)


def height_drift(vehicle: FaultTarget, one: ActiveFault) -> None:
    """The estimated height drifts to an error, without a counted reset."""
    up_m, over_s = one.fault.values["up"], one.fault.values["over"]
    share = 0.0

    def each_step(dt_s: float) -> None:
        nonlocal share
        share = min(share + dt_s / over_s, 1.0)
        vehicle.estimate.set_error(one.number, (0.0, 0.0, -share * up_m))

    one.each_step = each_step
    one.undo.append(lambda: vehicle.estimate.set_error(one.number, None))


def ekf_reset(vehicle: FaultTarget, one: ActiveFault) -> None:
    """The estimate jumps, and jumps back at the end of the fault."""
    values = one.fault.values
    error = (values["north"], values["east"], values["down"])
    yaw_rad = math.radians(values["yaw"])
    vehicle.estimate.set_error(one.number, error, ZERO, yaw_rad)
    _jumped(vehicle, (error != ZERO) + (yaw_rad != 0.0), yaw_rad)

    def undo() -> None:
        vehicle.estimate.set_error(one.number, None)
        _jumped(vehicle, (error != ZERO) + (yaw_rad != 0.0), -yaw_rad)

    one.undo.append(undo)


def _jumped(vehicle: FaultTarget, resets: int = 1, yaw_rad: float = 0.0) -> None:
    """React to resets as PX4: count them, and continue planning from the new estimate.

    An absolute goal is unchanged, so the vehicle then flies the difference.
    """
    vehicle.estimate.update(0.0)
    vehicle.estimate.count_reset(resets)
    for trajectory in _trajectories(vehicle.autopilot.task):
        trajectory.position = vehicle.estimate.position
        trajectory.yaw_rad = math.remainder(trajectory.yaw_rad + yaw_rad, math.tau)


def _trajectories(task: object) -> list[Trajectory]:
    """The trajectories of a flight task and of the task within it (Return has one for its landing)."""
    found = []
    for value in vars(task).values() if task is not None else ():
        if isinstance(value, Trajectory):
            found.append(value)
        elif value is not None and any(isinstance(inner, Trajectory) for inner in _attributes(value)):
            found += [inner for inner in _attributes(value) if isinstance(inner, Trajectory)]
    return found


def _attributes(value: object) -> list[object]:
    return list(getattr(value, "__dict__", {}).values())


# ---- power and rotors


def battery(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Set the charge: a number is discharged further while armed, a warning's name is held.

    Warnings are active even where CBRK_SUPPLY_CHK switches them off, as it does by default.
    """
    cells = vehicle.autopilot.supervision.battery
    remaining = one.fault.values["remaining"]
    cells.forced_charge_holds = remaining in CHARGE_OF_WARNING
    cells.forced_charge = CHARGE_OF_WARNING.get(remaining, remaining)
    cells.settle()

    def undo() -> None:
        cells.forced_charge = None
        cells.settle()

    one.undo.append(undo)


def motor_failure(vehicle: FaultTarget, one: ActiveFault) -> None:
    """The rotor stops; it turns again when the fault ends."""
    motor = one.fault.values["motor"]
    vehicle.airframe.fail_motor(motor - 1)

    one.undo.append(partial(vehicle.airframe.fail_motor, motor - 1, 1.0))


# ---- air


def wind(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Add wind."""
    values = one.fault.values
    vehicle.faults.winds[one.number] = _blowing(values["speed"], _direction(values["from"], one.seed))
    one.undo.append(partial(_calm, vehicle, one))


def gust(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Add one gust of `for` seconds (4 if not given): the wind rises and falls as 1 - cos."""
    values = one.fault.values
    angle = _direction(values["from"], one.seed)
    began_s = vehicle.faults.now_s
    if math.isinf(one.ends_s):
        one.ends_s = began_s + GUST_S
    length_s = one.ends_s - began_s

    def each_step(dt_s: float) -> None:
        phase = math.tau * (vehicle.faults.now_s - began_s) / length_s
        vehicle.faults.winds[one.number] = _blowing(values["speed"] * (1.0 - math.cos(phase)) / 2.0, angle)

    one.each_step = each_step
    one.undo.append(partial(_calm, vehicle, one))


def _direction(degrees: float | None, seed: int) -> float:
    return random.Random(seed).uniform(0.0, math.tau) if degrees is None else math.radians(degrees)


def _blowing(speed_mps: float, from_rad: float) -> Vector:
    return (-speed_mps * math.cos(from_rad), -speed_mps * math.sin(from_rad), 0.0)


def _calm(vehicle: FaultTarget, one: ActiveFault) -> None:
    vehicle.faults.winds.pop(one.number, None)
    vehicle.reload_wind(vehicle.faults.winds.values())


# ---- camera

_FROZEN = {
    "all": CameraFreeze.IMAGE | CameraFreeze.DEPTH,
    "image": CameraFreeze.IMAGE,
    "depth": CameraFreeze.DEPTH,
}


def camera_freeze(vehicle: FaultTarget, one: ActiveFault) -> None:
    """The camera's last images are repeated, with the stamps of the new ones."""
    frozen = _FROZEN[one.fault.values["what"]]
    if one.fault.values["clock"] == "yes":
        frozen |= CameraFreeze.CLOCK
    vehicle.faults.frozen_camera[one.number] = frozen
    one.undo.append(partial(vehicle.faults.frozen_camera.pop, one.number))


# ---- command


def pilot_takeover(vehicle: FaultTarget, one: ActiveFault) -> None:
    """A pilot's sticks become valid and the mode is switched; at the end the sticks are lost, the mode stays.

    Where a remote control is used (COM_RC_IN_MODE other than 4), NAV_RCL_ACT follows then.
    """
    mode = Mode[one.fault.values["mode"]]
    had_sticks = vehicle.autopilot.supervision.pilot_attached
    if vehicle.autopilot.pilot_takes_over(mode) != 0:
        vehicle.autopilot.pilot_has_sticks = had_sticks
        raise FaultError(f"pilot_takeover: mode {mode.name} cannot be flown now")

    def undo() -> None:
        vehicle.autopilot.pilot_has_sticks = had_sticks

    one.undo.append(undo)


def requested_mode(command: int, parameters: tuple[float, ...]) -> Mode | None:
    """The mode that a command requests; None if it requests none."""
    if command != _DO_SET_MODE:
        return _MODE_OF_COMMAND.get(command)
    main, sub = parameters[1:3]
    return mode_of(int(main), int(sub)) if math.isfinite(main) and math.isfinite(sub) else None


def refuse_mode(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Refuse requests for the mode, all or the given number."""
    values = one.fault.values
    left = math.inf if values["count"] == "all" else int(values["count"])

    def check(command: int, parameters: tuple[float, ...]) -> int | None:
        nonlocal left
        mode = requested_mode(command, parameters)
        if mode is None or values["mode"] not in ("any", mode.name):
            return None
        left -= 1
        if left <= 0:
            vehicle.faults.finish(one.number)
        return TEMPORARILY_REJECTED

    vehicle.faults.command_checks[one.number] = check
    one.undo.append(partial(vehicle.faults.command_checks.pop, one.number))


def reboot(vehicle: FaultTarget, one: ActiveFault) -> None:
    """A short power loss: `Vehicle.reboot`, without any traffic until PX4 has started."""
    faults = vehicle.faults
    one.ends_s = min(one.ends_s, faults.now_s + one.fault.values["seconds"])
    faults.deaf = True
    vehicle.reboot()

    def undo() -> None:
        faults.deaf = any(each.fault.kind.name == "reboot" for each in faults.active)

    one.undo.append(undo)
