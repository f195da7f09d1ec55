"""The simulated differences between PX4's releases. Everything else is v1.17's behaviour."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class SticksCheck(Enum):
    """When a fallback to a mode of sticks is replaced by NAV_RCL_ACT, because there are no sticks."""

    NEVER = "never"  # the mode is entered, and the vehicle sinks: until v1.16
    SETPOINTS_LOST = "setpoints lost"  # not after a loss of the position: v1.17
    ALWAYS = "always"  # since v1.18


@dataclass(frozen=True, slots=True)
class Release:
    """One release of PX4.

    Attributes:
        name: "1.17".
        software_version: AUTOPILOT_VERSION's, `major << 24 | minor << 16 | patch << 8 | type`.
        acknowledges_modes_twice: DO_SET_MODE is accepted at once by the MAVLink receiver, before Commander's
            own answer (v1.16 and v1.17; PX4's commit 01abe35563).
        has_parameter_errors: an invalid parameter request is answered by PARAM_ERROR (since v1.17); before,
            it is not answered.
        joins_ftp_paths: MAVLink FTP takes a path without a leading "/" from its root (since v1.16); before,
            in SITL, there is no such file. Its metadata is announced without one.
        checks_sticks: in the fallback of a mode that is no longer possible.
        has_current_mode: CURRENT_MODE is sent (since v1.15).
        override_by_speed: MAN_OVERRIDE_SPD is the pilot's override by sticks, in every mode (since v1.18);
            before, COM_RC_OVERRIDE and COM_RC_STICK_OV are.
    """

    name: str
    software_version: int
    acknowledges_modes_twice: bool
    has_parameter_errors: bool
    checks_sticks: SticksCheck
    has_current_mode: bool = True
    joins_ftp_paths: bool = True
    override_by_speed: bool = False


# FIRMWARE_VERSION_TYPE: 255 is a release, 128 a beta.
RELEASES = {
    release.name: release
    for release in (
        Release("1.14", 0x010E00FF, False, False, SticksCheck.NEVER, False, False),
        Release("1.15", 0x010F00FF, False, False, SticksCheck.NEVER, joins_ftp_paths=False),
        Release("1.16", 0x011000FF, True, False, SticksCheck.NEVER),
        Release("1.17", 0x011100FF, True, True, SticksCheck.SETPOINTS_LOST),
        Release("1.18", 0x01120080, False, True, SticksCheck.ALWAYS, override_by_speed=True),
    )
}
NEWEST = "1.17"  # the newest one that is released


def release_named(name: str) -> Release:
    """The release of this name. Raises ValueError for an unknown one."""
    try:
        return RELEASES[name]
    except KeyError:
        raise ValueError(f"PX4 {name!r} is unknown; expected one of {', '.join(RELEASES)}") from None
