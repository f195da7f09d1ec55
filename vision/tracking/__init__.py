"""From detections to tracks: which box is which object, and whether it counts as true."""

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
