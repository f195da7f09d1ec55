"""Merges the `camera` settings with a camera's own calibration: its lens and mount."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from pydantic import ValidationError

from companion.settings.perception import CameraSection
from vision.camera_model import CameraCalibration, CameraModel, CameraMount

_LENS = frozenset(("calibration_file", "horizontal_fov_deg", "lens"))
_SAME_SHARE, _SAME_M, _SAME_DEG, _SAME_DISTORTION = 0.005, 0.001, 0.1, 1e-4
"""Tolerances of agreement: share of the frame's width for a lens, mount position and angle, coefficient."""


class AdoptedCamera(NamedTuple):
    """The merged settings, and the given values that differ from the camera's."""

    camera: CameraSection
    conflict: str


def adopt_calibration(section: CameraSection, calibration: CameraCalibration) -> AdoptedCamera:
    """Use the camera's lens and mount, except for keys given in the settings, which take precedence.

    The lens is one unit: a given calibration or field of view replaces the camera's. The same holds for the
    reference of the mount's angles (`stabilized`, `on_gimbal`): if it differs, the angles come from the
    settings too. `conflict` lists each given value that differs, with the camera's; empty: none.

    Raises:
        ValueError: the camera's calibration is not what the settings accept. The message is one line.
    """
    given = section.model_fields_set
    changes: dict[str, Any] = {}
    conflicts: list[str] = []
    _adopt_lens(section, calibration.model, given, changes, conflicts)
    if calibration.mount is not None:
        _adopt_mount(section, calibration.mount, given, changes, conflicts)
    values = {key: getattr(section, key) for key in given} | changes
    try:
        camera = CameraSection.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key, got = ".".join(map(str, first["loc"])), "" if not first["loc"] else f", got {first['input']}"
        raise ValueError(
            f"the camera's own calibration cannot be used: {key or 'lens'}: {first['msg']}{got}; correct it "
            "in the program that shares the frames, or set camera.calibration_file"
        ) from None
    return AdoptedCamera(camera, "; ".join(conflicts))


def _adopt_lens(
    section: CameraSection, lens: CameraModel, given: set[str], changes: dict[str, Any], conflicts: list[str]
) -> None:
    if not given & _LENS:
        changes["lens"] = lens
        return
    own = section.model(lens.width, lens.height)
    if any(
        abs(getattr(own, name) - getattr(lens, name)) > _SAME_SHARE * lens.width
        for name in ("fx", "fy", "cx", "cy")
    ):
        conflicts.append(f"lens {_lens_text(own)} (camera: {_lens_text(lens)})")
    if own.distortion_model != lens.distortion_model:
        conflicts.append(f"distortion_model {own.distortion_model} (camera: {lens.distortion_model})")
        return
    own_terms, terms = (tuple(d) + (0.0,) * (8 - len(d)) for d in (own.distortion, lens.distortion))
    if any(abs(a - b) > _SAME_DISTORTION for a, b in zip(own_terms, terms, strict=True)):
        conflicts.append(f"distortion {own.distortion} (camera: {lens.distortion})")


def _lens_text(model: CameraModel) -> str:
    across_deg = math.degrees(2 * math.atan(model.width / 2 / model.fx))
    numbers = ", ".join(f"{value:.1f}" for value in (model.fx, model.fy, model.cx, model.cy))
    return f"{across_deg:.1f}° across, fx fy cx cy {numbers} px"


def _adopt_mount(
    section: CameraSection, mount: CameraMount, given: set[str], changes: dict[str, Any], conflicts: list[str]
) -> None:
    own: dict[str, Any] = {
        "mount_forward_m": mount.forward_m,
        "mount_right_m": mount.right_m,
        "mount_down_m": mount.down_m,
    }
    reference = {"stabilized": mount.stabilized, "on_gimbal": mount.on_gimbal}
    differing = [key for key, value in reference.items() if getattr(section, key) != value]
    if differing and given & reference.keys():
        conflicts += [f"{key} {getattr(section, key)} (camera: {reference[key]})" for key in differing]
    else:
        own |= reference | {
            "mount_roll_deg": math.degrees(mount.roll_rad),
            "mount_pitch_deg": math.degrees(mount.pitch_rad),
            "mount_yaw_deg": math.degrees(mount.yaw_rad),
        }
    for key, value in own.items():
        if key not in given:
            changes[key] = value
        elif abs(getattr(section, key) - value) > (_SAME_DEG if key.endswith("_deg") else _SAME_M):
            conflicts.append(f"{key} {getattr(section, key):g} (camera: {value:.6g})")
