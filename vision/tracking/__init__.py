"""Multi-object tracking: detections to tracks with stable ids."""

from vision.tracking.byte_track import TrackedFrame, Tracker
from vision.tracking.camera_motion import AttitudeHistory, CameraView
from vision.tracking.selection import TARGET_CLASS, ObjectSelection, Selected, SelectRequest
from vision.tracking.tracks import Track, TrackerSettings, TrackEvent, TrackEventKind, TrackState

__all__ = [
    "TARGET_CLASS",
    "AttitudeHistory",
    "CameraView",
    "ObjectSelection",
    "SelectRequest",
    "Selected",
    "Track",
    "TrackEvent",
    "TrackEventKind",
    "TrackState",
    "TrackedFrame",
    "Tracker",
    "TrackerSettings",
]
