"""The simulated differences between PX4's releases. Everything else is v1.17's behaviour."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Release:
    """One release of PX4.

    Attributes:
        name: "1.17".
        software_version: AUTOPILOT_VERSION's, `major << 24 | minor << 16 | patch << 8 | type`.
        acknowledges_modes_twice: DO_SET_MODE is accepted at once by the MAVLink receiver, before Commander's
            own answer (since v1.16; PX4's commit 01abe35563).
        has_parameter_errors: an invalid parameter request is answered by PARAM_ERROR (since v1.17); before,
            it is not answered.
        joins_ftp_paths: MAVLink FTP takes a path without a leading "/" from its root (since v1.16); before,
            in SITL, there is no such file. Its metadata is announced without one.
    """

    name: str
    software_version: int
    acknowledges_modes_twice: bool
    has_parameter_errors: bool
    joins_ftp_paths: bool = True


# FIRMWARE_VERSION_TYPE: 64 is an alpha, as was the v1.17 that was measured; 255 is a release.
RELEASES = {
    release.name: release
    for release in (
        Release("1.14", 0x010E00FF, False, False, joins_ftp_paths=False),
        Release("1.15", 0x010F00FF, False, False, joins_ftp_paths=False),
        Release("1.16", 0x011000FF, True, False),
        Release("1.17", 0x01110040, True, True),
    )
}
NEWEST = "1.17"


def release_named(name: str) -> Release:
    """The release of this name. Raises ValueError for an unknown one."""
    try:
        return RELEASES[name]
    except KeyError:
        raise ValueError(f"PX4 {name!r} is unknown; expected one of {', '.join(RELEASES)}") from None
