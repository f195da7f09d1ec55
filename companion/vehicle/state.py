"""The vehicle's state at one moment. World frame: local NED. Body frame: FRD.

A reset of the autopilot's estimator shifts its local coordinates of every point on the ground. Here, and in
everything above the drivers, local NED is the frame at the first connection: `telemetry` subtracts the sum of
all resets (`VehicleState.reset_offset_ned_m`) from every received position, and a driver adds it to every
position that it sends. So goals, paths, targets, tracks and pose histories stay fixed on the ground, and none
of them handles resets. The autopilot keeps home in its own coordinates, so here home moves at a reset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from companion.vehicle.clock_sync import ClockOffset
from companion.vehicle.commander import Commander, ForeignSetpoint
from companion.vehicle.gimbal import Address, GimbalState
from companion.vehicle.ground import GROUND_MAX_AGE_S, GroundLevel
from companion.vehicle.report import WARNING, Report
from companion.vehicle.vehicle_type import AUTOPILOT_NAMES, VtolState, autopilot_text, why_not_flown

__all__ = [
    "HEARTBEAT_MAX_AGE_S",
    "TELEMETRY_MAX_AGE_S",
    "FlightMode",
    "HeightSource",
    "LandedState",
    "Odometry",
    "Quaternion",
    "Vector3",
    "VehicleState",
    "with_fields",
]

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

# A multirotor's position older than this is not used for control.
TELEMETRY_MAX_AGE_S = 0.5
# HEARTBEAT is sent once a second; three missing ones are the usual criterion of a lost link.
HEARTBEAT_MAX_AGE_S = 3.0


class FlightMode(StrEnum):
    """Flight modes, named as PX4 names them."""

    UNKNOWN = "unknown"
    MANUAL = "manual"
    ALTITUDE = "altitude"
    POSITION = "position"
    ACRO = "acro"
    STABILIZED = "stabilized"
    OFFBOARD = "offboard"
    READY = "ready"
    TAKEOFF = "takeoff"
    HOLD = "hold"
    MISSION = "mission"
    RETURN = "return"
    LAND = "land"
    FOLLOW = "follow"
    PRECISION_LAND = "precision_land"


class LandedState(StrEnum):
    """MAV_LANDED_STATE of EXTENDED_SYS_STATE."""

    UNKNOWN = "unknown"
    ON_GROUND = "on_ground"
    IN_AIR = "in_air"
    TAKING_OFF = "taking_off"
    LANDING = "landing"


class HeightSource(StrEnum):
    """What the height above the ground is measured by."""

    HOME = "home"
    DISTANCE_SENSOR = "distance_sensor"


@dataclass(frozen=True, slots=True)
class Odometry:
    """The newest ODOMETRY, the reference for measuring the next reset.

    Attributes:
        time_us: the message's own stamp. reset_counter: 0..255.
        position_ned_m: with `VehicleState.reset_offset_ned_m` of that time subtracted.
        velocity_ned_mps: the newest of LOCAL_POSITION_NED.
    """

    time_us: int
    reset_counter: int
    position_ned_m: Vector3
    velocity_ned_mps: Vector3


@dataclass(frozen=True)
class VehicleState:
    """A snapshot. Every group of values has the stamp of its newest message (CLOCK_MONOTONIC ns, 0: never).

    Stamps are those of the measurement once the autopilot's clock is known, before that of the arrival.

    Attributes:
        position_ned_m: metres from the local origin, north, east, down.
        position_boot_ms: the autopilot's own stamp of it.
        position_valid: whether the estimator reports position and velocity as usable; None on an autopilot
            that does not report it (ESTIMATOR_STATUS, EKF_STATUS_REPORT).
        reset_count: number of resets larger than the estimate's own drift.
        reset_offset_ned_m: sum of those resets in the autopilot's local coordinates. Its own position is
            `position_ned_m` plus this.
        odometry: reference for measuring the next reset; None without ODOMETRY.
        velocity_ned_mps: metres a second, north, east, down.
        attitude: (w, x, y, z), rotates body FRD into NED.
        angular_velocity_frd_radps: body rates.
        latitude_deg, longitude_deg, altitude_amsl_m: global position, NaN when unknown.
        home_altitude_amsl_m, home_position_ned_m: of the home position; None until received.
        ground: by the range finder that looks down; None without one.
        range_finder_height: `height_m` may come from it; else it is always that above home.
        horizontal_sigma_m, vertical_sigma_m: one sigma of the position as the estimator states it; None: not
            stated.
        battery_fraction: 0..1, None when unknown.
        ready_to_arm: the autopilot's own pre-arm checks pass, in its current mode.
        failsafe: the autopilot reports MAV_STATE_CRITICAL or EMERGENCY.
        custom_mode: the autopilot's own number of `mode`, as it reports it.
        mode_restored: in words, the newest request to return to a pilot's mode that a message of ours had
            overridden; empty: none.
        sticks_present: the autopilot has valid input of a pilot's sticks.
        intended_mode: the mode chosen last by the pilot or a command. A failsafe changes only `mode`.
        intended_beside: the `mode` reported together with the intended one. Both are UNKNOWN on an autopilot
            that does not report it (CURRENT_MODE: PX4 1.15 and newer).
        clock: the autopilot's boot clock against CLOCK_MONOTONIC; None until synchronised.
        gimbal: attitude and control of the gimbal; None until one is received.
        reports: the newest text reports, the newest last.
        autopilot: "PX4" or "ArduPilot", None until its first heartbeat.
        mav_type, mav_autopilot: MAV_TYPE and MAV_AUTOPILOT of the newest heartbeat; None until the first.
        vtol_state: None until EXTENDED_SYS_STATE is received.
        is_plane: whether an ArduPilot has a parameter of Plane, whatever type it reports; None: not known.
        missing_streams: names of required messages received below half of their rate.
        other_commanders: other companion services received on the link, of any age.
        own_address: system and component id of our messages.
        address_shared_ns: when another program last sent with our address, as far as known.
        foreign_command_ns: when the autopilot last acknowledged, to our address, a motion command of another.
        foreign_setpoint: the newest setpoint of another program that it followed beside ours; None: none.
        alters_velocities: its fence or proximity sensors are enabled, which alter velocities (ArduPilot).
    """

    heartbeat_ns: int = 0
    attitude_ns: int = 0
    position_ns: int = 0
    global_ns: int = 0
    battery_ns: int = 0
    armed: bool = False
    mode: FlightMode = FlightMode.UNKNOWN
    landed: LandedState = LandedState.UNKNOWN
    ready_to_arm: bool = False
    failsafe: bool = False
    sticks_present: bool = False
    intended_mode: FlightMode = FlightMode.UNKNOWN
    intended_beside: FlightMode = FlightMode.UNKNOWN
    position_ned_m: Vector3 | None = None
    velocity_ned_mps: Vector3 | None = None
    attitude: Quaternion | None = None
    angular_velocity_frd_radps: Vector3 | None = None
    latitude_deg: float = math.nan
    longitude_deg: float = math.nan
    altitude_amsl_m: float = math.nan
    home_altitude_amsl_m: float | None = None
    home_position_ned_m: Vector3 | None = None
    position_boot_ms: int = 0
    position_valid: bool | None = None
    reset_count: int = 0
    reset_offset_ned_m: Vector3 = (0.0, 0.0, 0.0)
    odometry: Odometry | None = None
    ground: GroundLevel | None = field(default=None, metadata={"recorded": False})
    range_finder_height: bool = field(default=False, metadata={"recorded": False})
    horizontal_sigma_m: float | None = None
    vertical_sigma_m: float | None = None
    battery_fraction: float | None = None
    clock: ClockOffset | None = None
    gimbal: GimbalState | None = None
    reports: tuple[Report, ...] = ()
    custom_mode: int = field(default=0, metadata={"recorded": False})
    mode_restored: str = field(default="", metadata={"recorded": False})
    autopilot: str | None = None
    mav_type: int | None = None
    mav_autopilot: int | None = None
    vtol_state: VtolState | None = None
    is_plane: bool | None = None
    missing_streams: tuple[str, ...] = ()
    other_commanders: tuple[Commander, ...] = ()
    own_address: Address = (1, 191)
    address_shared_ns: int = 0
    foreign_command_ns: int = 0
    foreign_setpoint: ForeignSetpoint | None = field(default=None, metadata={"recorded": False})
    alters_velocities: bool = field(default=False, metadata={"recorded": False})

    @property
    def yaw_rad(self) -> float | None:
        """Heading, clockwise from north, -π..π."""
        if self.attitude is None:
            return None
        w, x, y, z = self.attitude
        return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    @property
    def in_flight(self) -> bool:
        """Armed, and not known to be on the ground."""
        return self.armed and self.landed is not LandedState.ON_GROUND

    @property
    def altitude_m(self) -> float | None:
        """Height above home (above the local origin while home is unknown), metres, up positive."""
        if self.position_ned_m is None:
            return None
        home_down = self.home_position_ned_m[2] if self.home_position_ned_m else 0.0
        return home_down - self.position_ned_m[2]

    @property
    def ground_height_m(self) -> float | None:
        """Height above the ground by the range finder; None while that has not met it in the last 5 s."""
        ground, position = self.ground, self.position_ned_m
        if ground is None or position is None or not ground.measured_ns:
            return None
        if self.position_ns - ground.measured_ns > GROUND_MAX_AGE_S * 1e9:
            return None
        return ground.position_ned_m[2] - position[2]

    @property
    def height_m(self) -> float | None:
        """Height above the ground, for ranges to objects, by `height_source`."""
        by_sensor = self.height_source is HeightSource.DISTANCE_SENSOR
        return self.ground_height_m if by_sensor else self.altitude_m

    @property
    def height_source(self) -> HeightSource | None:
        """Source of `height_m`; None while that is unknown."""
        if self.position_ned_m is None:
            return None
        measured = self.range_finder_height and self.ground_height_m is not None
        return HeightSource.DISTANCE_SENSOR if measured else HeightSource.HOME

    @property
    def height_disagreement_m(self) -> float:
        """Between the level of `height_m` and others measured by the range finder; 0 without one."""
        if self.ground is None or not self.range_finder_height:
            return 0.0
        level = self.home_position_ned_m[2] if self.home_position_ned_m else 0.0
        if self.height_source is HeightSource.DISTANCE_SENSOR:
            level = self.ground.position_ned_m[2]
        return self.ground.disagreement_m(level, self.position_ns)

    @property
    def not_flown(self) -> str | None:
        """Why this vehicle gets no flight command, in words; None: it is flown, or not known yet."""
        if self.mav_type is None or self.mav_autopilot is None:
            return None
        reported = AUTOPILOT_NAMES.get(self.mav_autopilot)
        if self.autopilot is not None and reported != self.autopilot:
            now = autopilot_text(self.mav_autopilot)
            return (
                f"the autopilot was {self.autopilot} and is {now} now: another vehicle; restart the service"
            )
        return why_not_flown(self.mav_type, self.mav_autopilot, self.vtol_state, is_plane=self.is_plane)

    def connected(self, now_ns: int) -> bool:
        """Whether a heartbeat was received within `HEARTBEAT_MAX_AGE_S`."""
        return self.heartbeat_ns > 0 and now_ns - self.heartbeat_ns <= HEARTBEAT_MAX_AGE_S * 1e9

    def position_fresh(self, now_ns: int) -> bool:
        """Whether position and attitude are known and at most `TELEMETRY_MAX_AGE_S` old."""
        limit_ns = TELEMETRY_MAX_AGE_S * 1e9
        return (
            self.position_ned_m is not None
            and self.attitude is not None
            and now_ns - self.position_ns <= limit_ns
            and now_ns - self.attitude_ns <= limit_ns
        )

    def position_fault(self, now_ns: int) -> str | None:
        """Return why position and attitude are not usable, as text; None if they are. Fresh is not valid."""
        if self.position_ned_m is None or self.attitude is None:
            return "not received"
        if not self.position_fresh(now_ns):
            return f"{(now_ns - min(self.position_ns, self.attitude_ns)) / 1e9:.1f} s old"
        if self.position_valid is False:
            return "the autopilot's estimator reports it as not valid"
        return None

    def home_fault(self) -> str | None:
        """Return why the height of a take-off is not known, as text; None if it is.

        PX4 takes an altitude AMSL, so home's is needed. ArduPilot takes a height above the home that it sets.
        """
        if self.home_altitude_amsl_m is not None or self.autopilot == "ArduPilot":
            return None
        return "not received: wait for the position estimate, or set home or the EKF origin"

    def reset_words(self, before: VehicleState) -> str:
        """Return the reset of the estimate since another snapshot, as text."""
        north, east, down = (
            now - then for now, then in zip(self.reset_offset_ned_m, before.reset_offset_ned_m, strict=True)
        )
        return f"reset by {north:.1f} m north, {east:.1f} m east, {down:.1f} m down"

    def warnings_since(self, stamp_ns: int) -> list[Report]:
        """Return the reports of level warning or worse since a time (CLOCK_MONOTONIC)."""
        return [report for report in self.reports if report.stamp_ns >= stamp_ns and report.level <= WARNING]


if TYPE_CHECKING:
    # The type checker knows the fields of `replace`.
    from dataclasses import replace as with_fields
else:

    def with_fields(state: VehicleState, /, **changes: Any) -> VehicleState:
        """`dataclasses.replace` in a hundredth of its time: a hundred messages a second make a state each.

        Raises:
            TypeError: a change is of no field.
        """
        values = state.__dict__ | changes
        if len(values) > len(state.__dict__):
            raise TypeError(
                f"VehicleState has no field {', '.join(sorted(changes.keys() - state.__dict__.keys()))}"
            )
        new = object.__new__(VehicleState)
        new.__dict__.update(values)
        return new
