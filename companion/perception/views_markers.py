"""Markers of all views: the newest of each view, missing conditions, and the published message."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from companion.guidance.targets.from_detections import HistoryError, StateHistory, mount_at
from companion.guidance.targets.from_markers import MarkerSight, MarkerTarget, looks_down, marker_targets
from companion.perception.views import View
from vision.markers import Marker
from vision.pipeline import PerceptionResult

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Seen:
    captured_ns: int
    targets: tuple[MarkerTarget, ...]
    looks_down: bool


class MarkerTracker:
    """The markers of all views with marker detection; not only the steering view may look down."""

    def __init__(self, views: Sequence[View]) -> None:
        self._detecting = tuple(view for view in views if view.settings.markers.dictionary is not None)
        self._on_pads = {
            view.name: {marker.identifier: marker for marker in view.settings.markers.pad_markers()}
            for view in self._detecting
        }
        self._seen: dict[str | None, _Seen] = {}

    def localize(
        self, view: View, result: PerceptionResult, history: StateHistory, vehicle: str, published_ns: int
    ) -> dict[str, Any]:
        """Localize the markers of one frame; returns the message to publish."""
        markers, camera = result.markers or (), view.settings.camera
        error_text, down = "", False
        targets: tuple[MarkerTarget, ...] = ()
        try:
            # The mount first: whether the camera looks down does not depend on the vehicle's position.
            mount = mount_at(camera.mount(), history, result.captured_ns)
            down = looks_down(camera.model(result.width, result.height), mount)
            targets = marker_targets(markers, result.captured_ns, mount, history, self._on_pads[view.name])
        except HistoryError as error:
            # As with detections: without an attitude at the capture they are published, but not targets.
            error_text = str(error)
        self._seen[view.name] = _Seen(result.captured_ns, targets, down)
        localized: Sequence[MarkerTarget | None] = targets or [None] * len(markers)
        return {
            "vehicle": vehicle,
            "camera": view.name,
            "sequence": result.sequence,
            "captured_ns": result.captured_ns,
            "published_ns": published_ns,
            "width": result.width,
            "height": result.height,
            "localization_error": error_text,
            "markers": [_message(*pair) for pair in zip(markers, localized, strict=True)],
        }

    def sight(self, now_ns: int, max_age_s: float) -> MarkerSight:
        """Return the markers of the views that look down, for behaviours."""
        if not self._detecting:
            return MarkerSight()
        down = [seen for seen in self._seen.values() if seen.looks_down]
        if self._seen and not down:
            return MarkerSight(missing=self._no_camera_below())
        if not down:
            return MarkerSight(missing="")
        newest_ns = max(seen.captured_ns for seen in down)
        age_s = (now_ns - newest_ns) / 1e9
        fresh = [seen for seen in down if now_ns - seen.captured_ns <= max_age_s * 1e9]
        targets = tuple(target for seen in fresh for target in seen.targets)
        return MarkerSight(targets, newest_ns, age_s, bool(fresh), "")

    def _no_camera_below(self) -> str:
        cameras = ", ".join(
            ("camera" if view.name is None else f"cameras.{view.name}.camera")
            + (
                "'s gimbal does not look down, or its attitude is unknown: use gimbal pitch=-90"
                if view.settings.camera.on_gimbal
                else f".mount_pitch_deg is {view.settings.camera.mount_pitch_deg:g}"
            )
            for view in self._detecting
        )
        return f"a camera that sees straight down ({cameras})"


def _message(marker: Marker, target: MarkerTarget | None) -> dict[str, Any]:
    """Create one marker's message; metres, radians, local NED, pixels. Not localized: image fields only."""
    message: dict[str, Any] = {
        "id": marker.identifier,
        "size_m": marker.size_m,
        "corners_px": [[round(float(value), 2) for value in corner] for corner in marker.corners_px],
        "position_camera_m": [round(float(value), 4) for value in marker.position_camera_m],
        "reprojection_px": round(marker.reprojection_px, 3),
        "ambiguity": round(marker.ambiguity, 3),
    }
    fields = {} if target is None else asdict(target)
    for name in ("pad", "bearing_rad", "elevation_rad", "distance_m", "ground_range_m", "heading_rad"):
        message[name] = None if target is None else round(fields[name], 4)
    for name in ("position_ned_m", "pad_ned_m"):
        message[name] = None if target is None else [round(value, 3) for value in fields[name]]
    return message
