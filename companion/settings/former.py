"""Keys of former versions: what they are called now, or what to do instead; settings in older recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from companion.settings.perception import cloud_voxel_m, starting_confidence

VERSION = "0.2.0"
"""In which all of these were renamed or removed."""

RENAMED = {
    "camera.gimbal": "camera.on_gimbal",
    "camera.mount_levelled": "camera.stabilized",
    "detector.known_heights": "detector.class_heights_m",
    "guidance.unknown_speed_mps": "guidance.max_speed_unobserved_mps",
    "guidance.view": "guidance.camera",
    "tracker.end_s": "tracker.max_age_s",
    "tracker.lost_s": "tracker.coast_timeout_s",
    "tracker.true_frames": "tracker.min_hits",
    "tracker.true_score": "tracker.confirm_score",
}
"""Former key → key."""


class Removed(NamedTuple):
    """A key that was removed.

    Attributes:
        instead: what to do, in words.
        now: what holds without it, by the other keys of a recorded section.
    """

    instead: str
    now: Callable[[Mapping[str, Any]], Any]


_LENS_FILE = "write a calibration file, and set camera.calibration_file"
LENS: dict[str, Any] = {
    "fx_px": None,
    "fy_px": None,
    "cx_px": None,
    "cy_px": None,
    "calibrated_width": None,
    "calibrated_height": None,
    "distortion": [],
    "distortion_model": "plumb_bob",
}
"""Former key of a lens in `camera` → its default. `lens_line` has what replaces them all."""


def _same(value: Any) -> Callable[[Mapping[str, Any]], Any]:
    return lambda _: value


_CONTENT = 'recording.content lists what is recorded beside the messages: "jpeg" or "png", "depth", "clouds"'
REMOVED = {
    **{f"camera.{name}": Removed(_LENS_FILE, _same(was)) for name, was in LENS.items()},
    "detector.every": Removed(
        "set detector.rate_hz to the source's rate divided by it; 1 is the default", _same(1)
    ),
    "detector.max_age_s": Removed(
        "remove it: guidance.perception_max_age_s limits the age of detections in flight", _same(None)
    ),
    "detector.tile_overlap": Removed("remove it: tiles overlap by 0.2 of their side", _same(0.2)),
    "detector.tile_size": Removed(
        "remove it: a tile has the size of the network's input, detector.image_size",
        lambda detector: detector["image_size" if detector.get("tiles") else "tile_size"],
    ),
    "preview.cloud_voxel_m": Removed(
        "set preview.cloud_range_m: a point is of a cube whose side is 1/200 of it",
        lambda preview: cloud_voxel_m(preview["cloud_range_m"]),
    ),
    "preview.quality": Removed(
        "remove it: images have JPEG quality 80; preview.width and preview.rate_hz reduce the data",
        _same(80),
    ),
    "recording.clouds": Removed(_CONTENT, lambda recording: recording["clouds"]),
    "recording.depth": Removed(_CONTENT, lambda recording: recording["depth"]),
    "recording.image_format": Removed(_CONTENT, lambda recording: recording["image_format"]),
    "recording.images": Removed(_CONTENT, lambda recording: recording["images"]),
    "recording.max_file_minutes": Removed(
        "remove it: the next file begins after an hour, or earlier at recording.max_file_mb", _same(60)
    ),
    "source.realtime": Removed(
        "set source.every_frame, its opposite: true reads a file as fast as its frames are processed",
        _same(True),
    ),
    "tracker.camera_motion": Removed(
        "remove it: the camera's rotation is compensated wherever the vehicle's attitude is known; "
        "vehicle.url = none for a recorded video",
        _same(True),
    ),
    "tracker.high_confidence": Removed(
        "set tracker.confirm_score: a track starts from there, at most from 0.35",
        lambda tracker: starting_confidence(tracker["confirm_score"]),
    ),
    "tracker.low_confidence": Removed("remove it: a track goes on with detections from 0.1", _same(0.1)),
    "vehicle.component_id": Removed(
        "remove it: the service takes 191, or another one of 192 to 194 where a program has it", _same(191)
    ),
}
"""Former key → what to do instead."""


class Changed(NamedTuple):
    """A key that means more than it did.

    Attributes:
        as_before: whether a value means what it did.
        now: what it means now, in words.
    """

    as_before: Callable[[Any], bool]
    now: str


def _is(*values: Any) -> Callable[[Any], bool]:
    return lambda value: value in values


CHANGED = {
    "guidance.perception_max_age_s": Changed(
        _is(0.5), "it limits the age of depth too, which was 0.5 s: the vehicle brakes later or earlier"
    ),
    "source.every_frame": Changed(
        _is(False), "true holds for files too, which are then read as fast as their frames are processed"
    ),
    "vehicle.connect_timeout_s": Changed(_is(30.0), "the service waits for the autopilot without a limit"),
    "vehicle.driver": Changed(
        _is("mavsdk", "pymavlink"), 'auto is pymavlink for PX4 too; "mavsdk" is what it was'
    ),
}
"""Key → what it means since this version; said of a file that has former keys, and is of 0.1 therefore."""


def lens_line(values: Mapping[str, Any]) -> str:
    """Return a calibration file of one line for former keys of a lens, with words for what is not given."""
    given = {name: str(value) for name, value in values.items() if name in LENS}
    fx, fy, cx, cy = (given.get(f"{name}_px", name.upper()) for name in ("fx", "fy", "cx", "cy"))
    terms = given.get("distortion", "").strip("()[]").rstrip(",") or "0, 0, 0, 0, 0"
    return (
        f"{{image_width: {given.get('calibrated_width', 'WIDTH')}, "
        f"image_height: {given.get('calibrated_height', 'HEIGHT')}, "
        f"camera_matrix: {{data: [{fx}, 0, {cx}, 0, {fy}, {cy}, 0, 0, 1]}}, "
        f"distortion_model: {given.get('distortion_model', 'plumb_bob')}, "
        f"distortion_coefficients: {{data: [{terms}]}}}}"
    )


def without_removed(sections: Mapping[str, Any], changed: list[str], prefix: str = "") -> dict[str, Any]:
    """Return recorded sections, JSON-able, without removed keys; those of a lens become `camera.lens`.

    Args:
        changed: gets a line for each removed key whose value was not what holds now.
        prefix: of the keys in these lines: `cameras.NAME.`.
    """
    kept: dict[str, Any] = {}
    for section, content in sections.items():
        if section == "cameras":
            names = {name: without_removed(own, changed, f"cameras.{name}.") for name, own in content.items()}
            kept[section] = names
            continue
        kept[section] = _with_lens(content) if section == "camera" else dict(content)
        for name, value in content.items():
            removed = REMOVED.get(f"{section}.{name}")
            if (
                removed is not None
                and name in kept[section]
                and kept[section].pop(name) != removed.now(content)
            ):
                changed.append(f"recorded with {prefix}{section}.{name} = {value}: {removed.instead}")
    return kept


def _with_lens(camera: Mapping[str, Any]) -> dict[str, Any]:
    if camera.get("fx_px") is None:
        return dict(camera)
    kept = {name: value for name, value in camera.items() if name not in LENS}
    lens = {"width": camera["calibrated_width"], "height": camera["calibrated_height"]}
    lens |= {name: camera[f"{name}_px"] for name in ("fx", "fy", "cx", "cy")}
    lens |= {name: camera.get(name, LENS[name]) for name in ("distortion", "distortion_model")}
    return kept | {"lens": lens}
