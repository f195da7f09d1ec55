"""Addresses of ROS 2 image topics, `ros://camera/image_raw`, and the shared memory that holds their frames.

`companion ros2 node` receives the messages and writes the frames (`companion.ros2.images`). Who reads them
needs no ROS.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from hashlib import blake2b
from urllib.parse import parse_qsl

from vision.sources.source import SourceError

SCHEME = "ros://"
_TOPIC = re.compile(r"(?:/[A-Za-z_][A-Za-z0-9_]*)+", re.ASCII)
_LONGEST_TOPIC = 247  # rmw/validate_full_topic_name.h
_SHOWN = 100  # characters of the topic in the name of the shared memory


@dataclass(frozen=True, slots=True)
class RosAddress:
    """What a `ros://` address names: full names of topics, which begin with a slash.

    Attributes:
        image: images, colour or depth. depth: depth of the pixels of `image`, or None. It is a source of its
            own, `RosAddress(depth)`, and paired with `image` like any other.
        info: `sensor_msgs/CameraInfo` of `image`, or None.
    """

    image: str
    depth: str | None = None
    info: str | None = None

    def __str__(self) -> str:
        names = {"depth": self.depth, "info": self.info}
        query = "&".join(f"{key}={topic}" for key, topic in names.items() if topic is not None)
        return f"ros:/{self.image}" + (f"?{query}" if query else "")

    @property
    def segment(self) -> str:
        """The name of the shared memory (`vision.shared_frame`) with the images, and the lens of `info`."""
        digest = blake2b(f"{self.image} {self.info}".encode(), digest_size=4).hexdigest()
        return f"ros{self.image.replace('/', '.')[:_SHOWN]}-{digest}"


def parse_ros_address(uri: str) -> RosAddress:
    """Read `ros://TOPIC[?depth=TOPIC&info=TOPIC]`. Topics are absolute, with or without the first slash.

    Raises:
        SourceError: it is no such address, or names something that is not the name of a topic.

    >>> parse_ros_address("ros://camera/image_raw?info=/camera/camera_info")
    RosAddress(image='/camera/image_raw', depth=None, info='/camera/camera_info')
    """
    if not uri.startswith(SCHEME):
        raise SourceError(f"{uri}: expected ros://TOPIC")
    image, _, query = uri.removeprefix(SCHEME).partition("?")
    others = parse_qsl(query, keep_blank_values=True)
    keys = [key for key, _ in others]
    if len(set(keys)) < len(keys) or not {"depth", "info"}.issuperset(keys) or (query and not keys):
        raise SourceError(f"{uri}: expected ros://TOPIC[?depth=TOPIC&info=TOPIC], each once, got {query!r}")
    topics = {key: _topic(uri, topic) for key, topic in others}
    address = RosAddress(_topic(uri, image), **topics)
    if address.image in topics.values() or len(set(topics.values())) < len(topics):
        raise SourceError(f"{uri}: image, depth and info must be different topics")
    return address


def _topic(uri: str, name: str) -> str:
    topic = "/" + name.removeprefix("/")
    if not _TOPIC.fullmatch(topic) or len(topic) > _LONGEST_TOPIC:
        raise SourceError(
            f"{uri}: {name!r} is no name of a topic: words of letters, digits and _ that do not begin with a "
            f"digit, with a slash between two, at most {_LONGEST_TOPIC} characters; ros2 topic list has them"
        )
    return topic
