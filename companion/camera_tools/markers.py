"""The markers that `companion detect --markers` prints and draws, one line per marker and board."""

from __future__ import annotations

import math
from collections.abc import Iterator

from companion.bus.messages import board_body, marker_body
from companion.camera_tools.detect import Image, PlainPart, Seen, Shown
from companion.guidance.objects.from_detections import StateHistory
from companion.guidance.objects.from_markers import BoardTarget, MarkerTarget, board_targets, marker_targets
from companion.settings import Settings
from companion.vehicle.state import VehicleState
from vision.annotate import annotate_markers
from vision.attitude import euler_from_quaternion

NO_MARKERS = "no markers"


class Markers(PlainPart):
    """Range, bearing and pose of markers and boards, for a level vehicle that heads north.

    Args:
        settings: `markers.dictionary` is set; `camera` has the lens and the mount.
    """

    def __init__(self, settings: Settings) -> None:
        self._camera = settings.camera
        self._on_pads = {marker.identifier: marker for marker in settings.markers.pad_markers()}

    def show(self, seen: Seen) -> Shown:
        """The markers and boards of the frame."""
        markers, mount, stamp_ns = seen.result.markers or (), self._camera.mount(), seen.frame.captured_ns
        # Each frame by itself: the camera's own motion between frames is unknown.
        history = _level_at(stamp_ns)
        targets = marker_targets(markers, stamp_ns, mount, history, self._on_pads)
        located = board_targets(seen.result.boards, stamp_ns, mount, history)
        message = {
            "markers": [marker_body(*both) for both in zip(markers, targets, strict=True)],
            "boards": [board_body(board) for board in located],
        }
        lines = [_line(target) for target in targets] + [_line(board) for board in located]
        return Shown(message, lines or [NO_MARKERS])

    def draw(self, seen: Seen, image: Image) -> Image:
        """Outlines and axes."""
        lens = self._camera.model(seen.frame.width, seen.frame.height)
        return annotate_markers(image, seen.result.markers or (), lens)


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
