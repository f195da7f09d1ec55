"""The table of published topics: key, encoding, rate, maximum age, quality of service.

A topic's key is `companion/<vehicle>/<name>`. A reader that uses a topic for control must refuse messages
older than `max_age_s`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import zenoh

ROOT = "companion"


@dataclass(frozen=True, slots=True)
class Topic:
    """One stream.

    Attributes:
        rate_hz: nominal; None if it follows the camera or is irregular.
        max_age_s: max age of a valid message; None if it does not age (events).
        encoding: of the payload.
        priority, express: zenoh's quality of service. Congestion control is DROP for every topic: with BLOCK
            one frozen reader stops the guidance loop for seconds.
    """

    name: str
    rate_hz: float | None
    max_age_s: float | None
    encoding: zenoh.Encoding
    priority: zenoh.Priority
    express: bool
    description: str

    def key(self, vehicle: str, view: str | None = None) -> str:
        """Return the zenoh key of one vehicle's stream; views other than the first use the view's name."""
        return f"{ROOT}/{vehicle}/{self.path(view)}"

    def path(self, view: str | None = None) -> str:
        """Return the part of the key after the vehicle's name."""
        return self.name if view is None else f"cameras/{view}/{self.name}"


_JSON = zenoh.Encoding.APPLICATION_JSON
_REAL_TIME = zenoh.Priority.REAL_TIME
_DATA = zenoh.Priority.DATA

DETECTIONS: Final = Topic(
    "detections", None, 0.5, _JSON, _REAL_TIME, True, "the detections of one frame, one message per frame"
)
LABELS: Final = Topic(
    "labels",
    None,
    0.5,
    zenoh.Encoding.TEXT_PLAIN,
    _DATA,
    False,
    "the class names of one frame, comma separated",
)
TRACKS: Final = Topic(
    "tracks",
    None,
    None,
    _JSON,
    _DATA,
    False,
    "the track events of one frame: new, update, lost, end",
)
MARKERS: Final = Topic(
    "markers", None, 0.5, _JSON, _REAL_TIME, True, "the markers in one frame, with their positions"
)
VEHICLE: Final = Topic("vehicle", 10.0, 0.5, _JSON, _DATA, True, "state of the vehicle")
SETPOINT: Final = Topic("setpoint", 10.0, 0.5, _JSON, _DATA, True, "the requested setpoint and the one sent")
POSE: Final = Topic("pose", 10.0, 1.0, _JSON, _REAL_TIME, True, "global pose, for other vehicles")
OBSTACLES: Final = Topic(
    "obstacles", None, 0.5, _JSON, _REAL_TIME, True, "distance of the nearest obstacle in 72 directions"
)
STATUS: Final = Topic("status", 1.0, 3.0, _JSON, _DATA, False, "state of every part of the service")
EVENTS: Final = Topic(
    "events",
    None,
    None,
    _JSON,
    _DATA,
    False,
    "events: modes, behaviours, losses and recoveries",
)

IMAGE: Final = Topic(
    "image",
    5.0,
    1.0,
    zenoh.Encoding.IMAGE_JPEG,
    zenoh.Priority.BACKGROUND,
    False,
    "a frame with its detections drawn, JPEG; only while there is a subscriber",
)

# Topics published by every view.
VIEW_TOPICS: Final = (DETECTIONS, LABELS, TRACKS, MARKERS, IMAGE)

TOPICS: Final = (
    DETECTIONS,
    LABELS,
    TRACKS,
    MARKERS,
    IMAGE,
    VEHICLE,
    SETPOINT,
    OBSTACLES,
    POSE,
    STATUS,
    EVENTS,
)

# The last part of the key of the queryable that executes a command and returns its result.
COMMAND: Final = "command"

NO_OBJECTS = "no objects detected"


def all_vehicles_key(topic: Topic) -> str:
    """Return the key expression of one stream of all vehicles."""
    return topic.key("*")


def command_key(vehicle: str) -> str:
    """Return the key of the queryable for one vehicle's commands."""
    return f"{ROOT}/{vehicle}/{COMMAND}"


def alive_key(vehicle: str) -> str:
    """Return the key of one service's liveliness token; zenoh removes the token when the service ends."""
    return f"{ROOT}/{vehicle}/alive"
