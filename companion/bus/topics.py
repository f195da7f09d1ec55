"""The one table of what is published: key, encoding, rate, maximum age, quality of service.

A topic's key is `companion/<vehicle>/<name>`. Readers that steer by a topic must refuse it past `max_age_s`.
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
        rate_hz: nominal; None where it follows the camera or happens on occasion.
        max_age_s: past this a value says nothing of the present; None where it does not age (events).
        encoding: of the payload.
        priority, express: zenoh's quality of service. Congestion control is DROP for every topic: with BLOCK
            one frozen reader stops the loop that steers, for seconds.
    """

    name: str
    rate_hz: float | None
    max_age_s: float | None
    encoding: zenoh.Encoding
    priority: zenoh.Priority
    express: bool
    description: str

    def key(self, vehicle: str, view: str | None = None) -> str:
        """The zenoh key of one vehicle's stream; of a view other than the first, under that view's name."""
        return f"{ROOT}/{vehicle}/{self.path(view)}"

    def path(self, view: str | None = None) -> str:
        """The key behind the vehicle's name."""
        return self.name if view is None else f"cameras/{view}/{self.name}"


_JSON = zenoh.Encoding.APPLICATION_JSON
_REAL_TIME = zenoh.Priority.REAL_TIME
_DATA = zenoh.Priority.DATA

DETECTIONS: Final = Topic(
    "detections", None, 0.5, _JSON, _REAL_TIME, True, "what one frame shows, one message a frame"
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
    "what happened to tracks at one frame: new, update, lost, end",
)
MARKERS: Final = Topic(
    "markers", None, 0.5, _JSON, _REAL_TIME, True, "the markers in one frame, and where they are"
)
VEHICLE: Final = Topic("vehicle", 10.0, 0.5, _JSON, _DATA, True, "state of the vehicle")
SETPOINT: Final = Topic("setpoint", 10.0, 0.5, _JSON, _DATA, True, "the setpoint asked for and the one sent")
POSE: Final = Topic("pose", 10.0, 1.0, _JSON, _REAL_TIME, True, "where on earth it is, for other vehicles")
OBSTACLES: Final = Topic(
    "obstacles", None, 0.5, _JSON, _REAL_TIME, True, "distance of the nearest obstacle in 72 directions"
)
STATUS: Final = Topic("status", 1.0, 3.0, _JSON, _DATA, False, "how every part of the service is")
EVENTS: Final = Topic(
    "events",
    None,
    None,
    _JSON,
    _DATA,
    False,
    "what happened: modes, behaviours, parts lost and found",
)

IMAGE: Final = Topic(
    "image",
    5.0,
    1.0,
    zenoh.Encoding.IMAGE_JPEG,
    zenoh.Priority.BACKGROUND,
    False,
    "a frame with its detections drawn, JPEG; made only while somebody subscribes",
)

# What every view publishes of its own.
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

# The last name of the queryable that takes a command and answers with its outcome.
COMMAND: Final = "command"

NO_OBJECTS = "no objects detected"


def everybodys_key(topic: Topic) -> str:
    """The key expression of one stream of all vehicles."""
    return topic.key("*")


def command_key(vehicle: str) -> str:
    """The queryable that takes commands for one vehicle."""
    return f"{ROOT}/{vehicle}/{COMMAND}"


def alive_key(vehicle: str) -> str:
    """The liveliness token of one vehicle's service; it goes when the service goes, however it goes."""
    return f"{ROOT}/{vehicle}/alive"
