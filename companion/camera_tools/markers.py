"""`companion markers`: the markers in a source's frames, one line per marker and board."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2

from companion.bus.messages import board_body, marker_body
from companion.guidance.objects.from_detections import StateHistory
from companion.guidance.objects.from_markers import BoardTarget, MarkerTarget, board_targets, marker_targets
from companion.perception.assembly import marker_finder
from companion.settings import Settings
from companion.settings.calibration import adopt_calibration
from companion.vehicle.state import VehicleState
from vision.annotate import annotate_markers
from vision.attitude import euler_from_quaternion
from vision.sources import Source

NO_MARKERS = "no markers"


def print_markers(
    source: Source,
    settings: Settings,
    *,
    limit: int | None = None,
    save: Path | None = None,
    as_json: bool = False,
    write: Callable[[str], None],
) -> int:
    """Detect markers in a source's frames, at most `limit` of them, for a level vehicle that heads north.

    Args:
        settings: `markers.dictionary` is set; `camera` has the lens and the mount. A source with its own
            calibration is preferred where the settings do not give one.
        save: folder for `<sequence>.jpg`, annotated.
        as_json: one JSON object per frame instead of readable lines.
        write: called with each line.

    Returns:
        Number of frames.

    Raises:
        OSError: an image cannot be written.
    """
    if source.calibration is not None:
        camera = adopt_calibration(settings.camera, source.calibration).camera
        settings = settings.model_copy(update={"camera": camera})
    find, mount = marker_finder(settings), settings.camera.mount()
    assert find is not None
    on_pads = {marker.identifier: marker for marker in settings.markers.pad_markers()}
    if save is not None:
        save.mkdir(parents=True, exist_ok=True)
    processed = 0
    for frame in source:
        markers, boards = find(frame)
        stamp_ns = frame.captured_ns if frame.media_s is None else round(frame.media_s * 1e9)
        history = _level_at(stamp_ns)
        # Each frame by itself: the camera's own motion between frames is unknown.
        targets = marker_targets(markers, stamp_ns, mount, history, on_pads)
        located = board_targets(boards, stamp_ns, mount, history)
        if as_json:
            message: dict[str, Any] = {
                "sequence": frame.sequence,
                "captured_ns": frame.captured_ns,
                "width": frame.width,
                "height": frame.height,
                "markers": [marker_body(*both) for both in zip(markers, targets, strict=True)],
                "boards": [board_body(board) for board in located],
            }
            write(json.dumps(message))
        else:
            lines = [_line(target) for target in targets] + [_line(board) for board in located]
            for line in lines or [NO_MARKERS]:
                write(f"{frame.sequence:6d}  {line}")
        if save is not None:
            path = save / f"{frame.sequence:06d}.jpg"
            camera_model = settings.camera.model(frame.width, frame.height)
            if not cv2.imwrite(str(path), annotate_markers(frame.image, markers, camera_model)):
                raise OSError(f"cannot write {path}: check free disk space and write permission")
        processed += 1
        if processed == limit:
            break
    return processed


def _level_at(stamp_ns: int) -> StateHistory:
    """A level vehicle at the origin that heads north, as there is none here."""
    history = StateHistory()
    history.add(
        VehicleState(
            attitude_ns=stamp_ns + 1,
            position_ns=stamp_ns + 1,
            attitude=(1.0, 0.0, 0.0, 0.0),
            position_ned_m=(0.0, 0.0, 0.0),
            home_position_ned_m=(0.0, 0.0, 0.0),
        )
    )
    return history


def _line(target: MarkerTarget | BoardTarget) -> str:
    return "  ".join(_parts(target))


def _parts(target: MarkerTarget | BoardTarget) -> Iterator[str]:
    forward, right, down = target.body.position_m
    if isinstance(target, MarkerTarget):
        yield f"id {target.identifier}"
    else:
        yield f"board {target.name}"
    yield f"{math.hypot(forward, right, down):.3f} m +- {target.body.range_sigma_m:.3f}"
    yield f"bearing {math.degrees(math.atan2(right, forward)):+.1f}"
    yield f"elevation {math.degrees(math.atan2(-down, math.hypot(forward, right))):+.1f} deg"
    yield f"forward {forward:.3f} right {right:.3f} down {down:.3f} m"
    roll, pitch, yaw = (math.degrees(angle) for angle in euler_from_quaternion(target.body.rotation))
    sigma = math.degrees(target.body.angle_sigma_rad)
    yield f"roll {roll:.1f} pitch {pitch:.1f} yaw {yaw:.1f} deg +- {sigma:.1f}"
    if isinstance(target, BoardTarget):
        yield f"{len(target.identifiers)} markers"
    if target.ambiguous if isinstance(target, BoardTarget) else not target.resolved:
        yield "ambiguous"
