"""What was read from the autopilot when the link opened or returned: its firmware version and parameters.

One frozen value. Whoever needs a parameter takes it from here, so that it is read once for each connection,
reported once where it cannot be read, and recorded for replay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

RELEASE = 255  # FIRMWARE_VERSION_TYPE_OFFICIAL
RELEASE_CANDIDATE = 192  # FIRMWARE_VERSION_TYPE_RC; below: development, alpha and beta versions
_KINDS = {0: "dev", 64: "alpha", 128: "beta", RELEASE_CANDIDATE: "rc"}
# PX4's default of NAV_MC_ALT_RAD, where it could not be read.
DEFAULT_ACCEPTANCE_M = 0.8
# COM_RC_IN_MODE: PX4 ignores all stick input.
STICKS_DISABLED = 4
_OFFBOARD_OVERRIDE = 2  # bit of COM_RC_OVERRIDE
_OVERRIDE_SPEED = "MAN_OVERRIDE_SPD"  # by source of v1.18.0-beta1; negative: off
_IGNORE_PILOT_YAW = 4  # bit of GUID_OPTIONS
_DO_NOT_STABILIZE_VELOCITY = 32  # bit of GUID_OPTIONS: Copter then reports the velocity that it has reached
# Since then POSITION_TARGET_LOCAL_NED is the setpoint as it was sent. PX4: flown with v1.14.4, v1.16.2 and
# v1.18.0-beta1. Copter: flown with 4.7; by source since 2021, and not in 4.0.
_EXACT_ECHO = {"PX4": (1, 14), "ArduPilot": (4, 2)}

PX4_PARAMETERS = (
    "COM_OF_LOSS_T",
    "COM_OBL_RC_ACT",
    "COM_RC_IN_MODE",
    "NAV_RCL_ACT",
    "NAV_MC_ALT_RAD",
    "MPC_XY_VEL_MAX",
    "MPC_Z_VEL_MAX_UP",
    "MPC_Z_VEL_MAX_DN",
)
ARDUPILOT_PARAMETERS = ("GUID_TIMEOUT", "GUID_OPTIONS", "FS_GCS_ENABLE", "FS_GCS_TIMEOUT")


@dataclass(frozen=True, slots=True, order=True)
class FirmwareVersion:
    """AUTOPILOT_VERSION.flight_sw_version. `kind`: FIRMWARE_VERSION_TYPE, 255 is a release."""

    major: int
    minor: int
    patch: int = 0
    kind: int = RELEASE

    @classmethod
    def of(cls, flight_sw_version: int) -> FirmwareVersion:
        """Return the version encoded in AUTOPILOT_VERSION."""
        return cls(*flight_sw_version.to_bytes(4, "big"))

    def __str__(self) -> str:
        kind = "" if self.kind == RELEASE else f"-{_KINDS.get(self.kind, str(self.kind))}"
        return f"{self.major}.{self.minor}.{self.patch}{kind}"


@dataclass(frozen=True, slots=True)
class AutopilotParameters:
    """The autopilot's own settings that matter here.

    Attributes:
        autopilot: "PX4" or "ArduPilot"; None: nothing was read yet.
        version: of the firmware; None: it did not answer.
        system_id: of the vehicle; our messages have the same one.
        values: name and value of every parameter that could be read.
    """

    autopilot: str | None = None
    version: FirmwareVersion | None = None
    system_id: int = 1
    values: tuple[tuple[str, float], ...] = ()

    def get(self, name: str) -> float | None:
        """Return a parameter; None: it was not read, or is not a finite number."""
        return next((value for key, value in self.values if key == name and math.isfinite(value)), None)

    @property
    def firmware(self) -> str:
        """Autopilot and version, as text."""
        return f"{self.autopilot or 'autopilot'} {self.version or '(version unknown)'}"

    @property
    def altitude_acceptance_m(self) -> float | None:
        """How far below its goal PX4 ends a climb (NAV_MC_ALT_RAD); None: not known."""
        return self.get("NAV_MC_ALT_RAD")

    @property
    def exact_echo(self) -> bool:
        """Whether the autopilot is known to report the setpoint that it follows as it was sent."""
        since = _EXACT_ECHO.get(self.autopilot or "")
        if since is None or self.version is None or (self.version.major, self.version.minor) < since:
            return False
        if self.autopilot == "PX4":
            return True
        options = self.get("GUID_OPTIONS")
        return options is not None and not int(options) & _DO_NOT_STABILIZE_VELOCITY

    @property
    def sticks_text(self) -> str | None:
        """What a pilot's sticks do while the vehicle follows our setpoints; None: nothing was read yet."""
        if self.autopilot is None:
            return None
        if self.autopilot == "ArduPilot":
            yaw = "the yaw stick turns the vehicle"
            if (options := self.get("GUID_OPTIONS")) is None:
                yaw = "GUID_OPTIONS could not be read: the yaw stick may turn the vehicle"
            elif int(options) & _IGNORE_PILOT_YAW:
                yaw = "the yaw stick too (GUID_OPTIONS)"
            return f"sticks do nothing in GUIDED, {yaw}; a pilot takes over by selecting a mode"
        if self.get("COM_RC_IN_MODE") == STICKS_DISABLED:
            return "PX4 ignores all sticks (COM_RC_IN_MODE 4)"
        name = stick_override_name(self.version)
        override = self.get(name)
        if override is None:
            return f"{name} could not be read: sticks may do nothing in OFFBOARD"
        if name == _OVERRIDE_SPEED:
            quickly, taking_over, needed = "quickly ", override >= 0.0, 1
        else:
            quickly, taking_over = "", bool(int(override) & _OFFBOARD_OVERRIDE)
            needed = int(override) | _OFFBOARD_OVERRIDE
        if taking_over:
            return f"moving the sticks {quickly}takes over from OFFBOARD ({name} {override:g})"
        return (
            f"sticks do nothing in OFFBOARD ({name} {override:g}): a pilot takes over by selecting a mode; "
            f"{needed} lets {quickly}moved sticks take over"
        )


NOTHING_READ = AutopilotParameters()


def parameter_names(autopilot: str | None, version: FirmwareVersion | None) -> tuple[str, ...]:
    """Return the names to read from an autopilot, as its version has them."""
    if autopilot == "PX4":
        return (*PX4_PARAMETERS, stick_override_name(version))
    if autopilot == "ArduPilot":
        return (*ARDUPILOT_PARAMETERS, ground_station_name(version))
    return ()


def stick_override_name(version: FirmwareVersion | None) -> str:
    """Return PX4's parameter with what moved sticks do in OFFBOARD."""
    by_speed = version is not None and (version.major, version.minor) >= (1, 18)
    return _OVERRIDE_SPEED if by_speed else "COM_RC_OVERRIDE"


def ground_station_name(version: FirmwareVersion | None) -> str:
    """Return ArduPilot's parameter with the system id of its ground station."""
    renamed = version is not None and (version.major, version.minor) >= (4, 7)
    return "MAV_GCS_SYSID" if renamed else "SYSID_MYGCS"
