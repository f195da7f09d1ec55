"""Multi-object tracking: detections to tracks with stable ids."""

from vision.tracking.byte_track import TrackedFrame, Tracker
from vision.tracking.camera_motion import AttitudeHistory, CameraView
from vision.tracking.tracks import Track, TrackerSettings, TrackEvent, TrackEventKind, TrackState

__all__ = [
    "AttitudeHistory",
    "CameraView",
    "Track",
    "TrackEvent",
    "TrackEventKind",
    "TrackState",
    "TrackedFrame",
    "Tracker",
    "TrackerSettings",
]
