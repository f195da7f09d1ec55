"""The table of published topics and queryables: key, body, rate, maximum age, quality of service.

A topic's key is `companion/<vehicle>/<name>`. A reader that uses a topic for control must refuse messages
older than `max_age_s`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import zenoh

from companion.bus.bodies.frames import (
    CameraInfoBody,
    CloudBody,
    DepthBody,
    DepthImageBody,
    DetectionsBody,
    ImageBody,
    MarkersBody,
    TracksBody,
    TransformsBody,
)
from companion.bus.bodies.service import CommandStateBody, EventBody, StatusBody
from companion.bus.bodies.vehicle import ObstaclesBody, PoseBody, SetpointsBody, VehicleBody, VelocityBody

ROOT = "companion"
LARGEST_JSON_BYTES = 256 * 1024
LARGEST_BINARY_BYTES = 64 * 1024 * 1024
"""Of point clouds and depth images; a preview image has at most `LARGEST_IMAGE_BYTES`."""
LARGEST_IMAGE_BYTES = 8 * 1024 * 1024

_JSON = zenoh.Encoding.APPLICATION_JSON
_REAL_TIME = zenoh.Priority.REAL_TIME
# Not DATA, the priority of queries: a reply to a frozen reader is sent with BLOCK and holds that queue.
_TELEMETRY = zenoh.Priority.DATA_HIGH
# A queue of its own: a recorder that is late delays nothing else.
_RECORD = zenoh.Priority.DATA_LOW


@dataclass(frozen=True, slots=True)
class Topic:
    """One stream.

    Attributes:
        body: type of the payload; of `LARGE_TOPICS` that of the attachment.
        published: when, in words.
        rate_hz: nominal; None if it follows the camera or is irregular.
        max_age_s: max age of a valid message; None if it does not age (events).
        largest_bytes: readers ignore a larger message, without a copy of it.
        of_camera: published by every camera.
        cached: number of newest messages kept for late subscribers; 0: none are, and nothing is encoded
            without a subscriber.
        encoding: of the payload.
        priority, express: zenoh's quality of service. Congestion control is DROP for every topic: with BLOCK
            one frozen reader stops the guidance loop for seconds.
    """

    name: str
    body: Any
    description: str
    published: str
    rate_hz: float | None = None
    max_age_s: float | None = None
    largest_bytes: int = LARGEST_JSON_BYTES
    of_camera: bool = False
    cached: int = 0
    encoding: zenoh.Encoding = field(default_factory=lambda: _JSON)
    priority: zenoh.Priority = field(default_factory=lambda: _TELEMETRY)
    express: bool = False

    def key(self, vehicle: str, view: str | None = None) -> str:
        """Return the zenoh key of one vehicle's stream; views other than the first use the view's name."""
        return f"{ROOT}/{vehicle}/{self.path(view)}"

    def path(self, view: str | None = None) -> str:
        """Return the part of the key after the vehicle's name."""
        return self.name if view is None else f"cameras/{view}/{self.name}"


DETECTIONS: Final = Topic(
    "detections",
    DetectionsBody,
    "the detections of one frame, with tracks and positions",
    "per processed frame",
    max_age_s=0.5,
    of_camera=True,
    priority=_REAL_TIME,
    express=True,
)
LABELS: Final = Topic(
    "labels",
    str,
    "class names, comma separated, or `no objects detected`",
    "per processed frame",
    max_age_s=0.5,
    of_camera=True,
    encoding=zenoh.Encoding.TEXT_PLAIN,
)
TRACKS: Final = Topic(
    "tracks",
    TracksBody,
    "track events: new, update, lost, end",
    "per frame with track events",
    of_camera=True,
    cached=100,
)
MARKERS: Final = Topic(
    "markers",
    MarkersBody,
    "the markers in a frame and their positions",
    "per processed frame, if marker detection is on",
    max_age_s=0.5,
    of_camera=True,
    priority=_REAL_TIME,
    express=True,
)
DEPTH: Final = Topic(
    "depth",
    DepthBody,
    "distance at the image's centre and of each detection, share of pixels with depth",
    "per processed frame with depth",
    max_age_s=0.5,
    of_camera=True,
)
TRANSFORMS: Final = Topic(
    "transforms",
    TransformsBody,
    "NED, body, gimbal and camera at the capture",
    "per processed frame with a known attitude",
    max_age_s=0.5,
    of_camera=True,
    priority=_REAL_TIME,
    express=True,
)
CAMERA_INFO: Final = Topic(
    "camera_info",
    CameraInfoBody,
    "lens and mount of the camera",
    "1 Hz after the first frame",
    rate_hz=1.0,
    of_camera=True,
    cached=1,
)
IMAGE: Final = Topic(
    "image",
    ImageBody,
    "a frame, with `preview.annotate` its detections; the attachment has its number",
    "at most `preview.rate_hz`",
    rate_hz=15.0,
    max_age_s=1.0,
    largest_bytes=LARGEST_IMAGE_BYTES,
    of_camera=True,
    encoding=zenoh.Encoding.IMAGE_JPEG,
    priority=zenoh.Priority.BACKGROUND,
)
DEPTH_IMAGE: Final = Topic(
    "depth_image",
    DepthImageBody,
    "the depth image of the same frame as `image`; the attachment has its size",
    "at most `preview.rate_hz`",
    rate_hz=15.0,
    max_age_s=1.0,
    largest_bytes=LARGEST_BINARY_BYTES,
    of_camera=True,
    encoding=zenoh.Encoding.APPLICATION_OCTET_STREAM,
    priority=zenoh.Priority.BACKGROUND,
)
CLOUD: Final = Topic(
    "cloud",
    CloudBody,
    "the points of a depth image with their colours; the attachment has their number and frame",
    "at most `preview.cloud_rate_hz`",
    rate_hz=2.0,
    max_age_s=1.0,
    largest_bytes=LARGEST_BINARY_BYTES,
    of_camera=True,
    encoding=zenoh.Encoding.APPLICATION_OCTET_STREAM,
    priority=zenoh.Priority.BACKGROUND,
)
VEHICLE: Final = Topic(
    "vehicle",
    VehicleBody,
    "state of the vehicle",
    "10 Hz",
    rate_hz=10.0,
    max_age_s=0.5,
    express=True,
)
SETPOINT: Final = Topic(
    "setpoint",
    SetpointsBody,
    "the requested setpoint and the one sent",
    "10 Hz while in command",
    rate_hz=10.0,
    max_age_s=0.5,
    express=True,
)
POSE: Final = Topic(
    "pose",
    PoseBody,
    "global pose, for other vehicles",
    "10 Hz while known",
    rate_hz=10.0,
    max_age_s=1.0,
    largest_bytes=16 * 1024,
    priority=_REAL_TIME,
    express=True,
)
OBSTACLES: Final = Topic(
    "obstacles",
    ObstaclesBody,
    "distance of the nearest obstacle in 72 horizontal directions, from north",
    "per depth image of the steering camera",
    max_age_s=0.5,
    priority=_REAL_TIME,
    express=True,
)
STATUS: Final = Topic(
    "status",
    StatusBody,
    "state of every part of the service",
    "1 Hz",
    rate_hz=1.0,
    max_age_s=3.0,
    largest_bytes=64 * 1024,
    cached=1,
)
EVENTS: Final = Topic(
    "events",
    EventBody,
    "modes, behaviours, losses and recoveries",
    "on occurrence",
    cached=100,
)

COMMAND_STATE: Final = Topic(
    "command_state",
    CommandStateBody,
    "how far a command of any sender is, and why it ended",
    "on occurrence",
    cached=100,
)

# Received by the service.
VELOCITY: Final = Topic(
    "velocity",
    VelocityBody,
    "a velocity to fly, for the command `velocity`",
    "by the program that steers, at least twice a second",
    max_age_s=0.5,
    largest_bytes=1024,
    priority=_REAL_TIME,
    express=True,
)

# Published only while a recorder listens. A key part with @ matches no wildcard: no other reader gets them.
RUN: Final = Topic(
    "@record/run",
    dict[str, Any],
    "version and settings of the service, for a replay",
    "1 Hz",
    rate_hz=1.0,
    largest_bytes=LARGEST_BINARY_BYTES,
    priority=_RECORD,
)
GUIDANCE_INPUT: Final = Topic(
    "@record/guidance_input",
    dict[str, Any],
    "the input of each step of guidance",
    "per step",
    largest_bytes=LARGEST_BINARY_BYTES,
    priority=_RECORD,
)
GUIDANCE_OUTPUT: Final = Topic(
    "@record/guidance_output",
    dict[str, Any],
    "the output of each step of guidance",
    "per step",
    largest_bytes=LARGEST_BINARY_BYTES,
    priority=_RECORD,
)
MAVLINK: Final = Topic(
    "@record/mavlink",
    bytes,
    "the bytes on the autopilot's link, both ways (`recording.tap`)",
    "20 Hz",
    largest_bytes=LARGEST_BINARY_BYTES,
    encoding=zenoh.Encoding.APPLICATION_OCTET_STREAM,
    priority=_RECORD,
)

TOPICS: Final = (
    DETECTIONS,
    LABELS,
    TRACKS,
    MARKERS,
    DEPTH,
    TRANSFORMS,
    CAMERA_INFO,
    IMAGE,
    DEPTH_IMAGE,
    CLOUD,
    VEHICLE,
    SETPOINT,
    OBSTACLES,
    POSE,
    STATUS,
    EVENTS,
    COMMAND_STATE,
)

# Those that the service receives.
INPUT_TOPICS: Final = (VELOCITY,)

# Large ones, of which a reader chooses whether it wants them; their body is that of the attachment.
LARGE_TOPICS: Final = (IMAGE, DEPTH_IMAGE, CLOUD)

# Topics published by every view.
VIEW_TOPICS: Final = tuple(topic for topic in TOPICS if topic.of_camera)

RECORDER_TOPICS: Final = (RUN, GUIDANCE_INPUT, GUIDANCE_OUTPUT, MAVLINK)

# The last part of the key of the queryable that executes a command and returns its result.
COMMAND: Final = "command"

# The same of the queryable that answers and changes a few settings.
SETTINGS: Final = "settings"


def command_id(service: str, number: int) -> str:
    """Return the `id` of a command: `service` of its service's status, and its number there."""
    return f"{service}-{number}"


NO_OBJECTS = "no objects detected"


def command_key(vehicle: str) -> str:
    """Return the key of the queryable for one vehicle's commands."""
    return f"{ROOT}/{vehicle}/{COMMAND}"


def client_key(vehicle: str, name: str) -> str:
    """Return the key of a client's liveliness token: the service makes an event of its end."""
    return f"{ROOT}/{vehicle}/clients/{name}"


def settings_key(vehicle: str) -> str:
    """Return the key of the queryable for one vehicle's settings that can be changed."""
    return f"{ROOT}/{vehicle}/{SETTINGS}"


def alive_key(vehicle: str) -> str:
    """Return the key of one service's liveliness token; zenoh removes the token when the service ends."""
    return f"{ROOT}/{vehicle}/alive"
