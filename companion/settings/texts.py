"""Text formats of settings: names, endpoints, markers; and their descriptions for messages."""

from __future__ import annotations

from typing import Annotated

from pydantic import StringConstraints

# One word of a zenoh key expression: no `/`, and none of its wildcards and separators `* $ ? # @`.
KEY_WORD = StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=64)
KeyWord = Annotated[str, KEY_WORD]
HOST_AND_PORT = StringConstraints(pattern=r"^[^\s:]+:[0-9]{1,5}$", max_length=300)
# Names of ROS 2: https://design.ros2.org/articles/topic_and_service_names.html
ROS_NAME = StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$", max_length=64)
ROS_NAMESPACE = StringConstraints(
    pattern=r"^([A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*)?$", max_length=200
)
HTTP_URL = StringConstraints(pattern=r"^https?://[^\s/]+(/\S*)?$", max_length=300)
# Without a password, which others could read in the command line of the process.
MQTT_URL = StringConstraints(
    pattern=r"^mqtts?://([^\s/@:]+|\[[0-9A-Fa-f:.]+\])(:[0-9]{1,5})?/?$", max_length=300
)
MQTT_PREFIX = StringConstraints(pattern=r"^[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*$", max_length=200)
MQTT_PREFIX_OR_EMPTY = StringConstraints(pattern=r"^([A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*)?$", max_length=200)
HOST_AND_PORT_OR_EMPTY = StringConstraints(pattern=r"^([^\s:]+:[0-9]{1,5})?$", max_length=300)
# As a browser sends it in `Host`: of https://NAME:PORT/path the middle, without the default port.
PageHost = Annotated[
    str,
    StringConstraints(
        pattern=r"^([A-Za-z0-9]([A-Za-z0-9._-]*[A-Za-z0-9])?|\[[0-9A-Fa-f:.]+\])(:[0-9]{1,5})?$",
        max_length=300,
    ),
]
# The same without a dot, since `cameras.NAME.source` is a key.
CAMERA_NAME = StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", max_length=64)
CameraName = Annotated[str, CAMERA_NAME]
VehicleUrl = Annotated[
    str,
    StringConstraints(pattern=r"^(none|(udpin|udpout|udp|tcp|tcpin|tcpout|serial)://.+)$", max_length=400),
]
STATION_URL = StringConstraints(pattern=r"^(udpin|udpout|tcp|serial)://.+$", max_length=400)
# CLASS:METRES.
HEIGHT_TEXT = StringConstraints(pattern=r"^.+:[0-9]*\.?[0-9]+$", max_length=80)
# ID:SIZE of a marker; with @PAD if it is on a pad, and :RIGHT:UP if it is off the pad's centre.
MARKER_TEXT = StringConstraints(pattern=r"^[0-9]+:[0-9.]+(@[0-9]+(:-?[0-9.]+:-?[0-9.]+)?)?$", max_length=80)
ZenohEndpoint = Annotated[
    str,
    StringConstraints(pattern=r"^(tcp|udp|tls|quic|ws|serial|unixsock-stream|unixpipe|vsock)/.+$"),
]

# Pattern → description, for messages about values that do not match.
PATTERN_MEANINGS = {
    r"^[A-Za-z0-9][A-Za-z0-9_.-]*$": "a word of letters, digits, `_`, `-` and `.`",
    r"^[^\s:]+:[0-9]{1,5}$": "HOST:PORT such as 127.0.0.1:9100",
    r"^[A-Za-z_][A-Za-z0-9_]*$": "a word of letters, digits and `_` that does not begin with a digit",
    r"^([A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*)?$": (
        "names of letters, digits and `_`, separated by `/`, such as drone1; or empty"
    ),
    r"^https?://[^\s/]+(/\S*)?$": "an address such as http://127.0.0.1:11434",
    r"^([^\s:]+:[0-9]{1,5})?$": "HOST:PORT such as 127.0.0.1:8088, or empty",
    r"^mqtts?://([^\s/@:]+|\[[0-9A-Fa-f:.]+\])(:[0-9]{1,5})?/?$": "an address such as mqtt://192.168.1.5:1883",
    r"^[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*$": "words of letters, digits, `_`, `-` and `.`, separated by `/`",
    r"^([A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*)?$": (
        "words of letters, digits, `_`, `-` and `.`, separated by `/`; or empty"
    ),
    r"^([A-Za-z0-9]([A-Za-z0-9._-]*[A-Za-z0-9])?|\[[0-9A-Fa-f:.]+\])(:[0-9]{1,5})?$": (
        "a host without scheme and path, such as drone.example.org or drone.example.org:8443"
    ),
    r"^[A-Za-z0-9][A-Za-z0-9_-]*$": "a word of letters, digits, `_` and `-`",
    r"^(none|(udpin|udpout|udp|tcp|tcpin|tcpout|serial)://.+)$": (
        "udpin://HOST:PORT, udpout://HOST:PORT, tcp://HOST:PORT, serial://DEVICE:BAUD or none"
    ),
    r"^(udpin|udpout|tcp|serial)://.+$": (
        "udpout://HOST:PORT, udpin://HOST:PORT, tcp://HOST:PORT or serial://DEVICE:BAUD"
    ),
    r"^.+:[0-9]*\.?[0-9]+$": "CLASS:METRES such as person:1.7",
    r"^[0-9]+:[0-9.]+(@[0-9]+(:-?[0-9.]+:-?[0-9.]+)?)?$": (
        "ID:SIZE, ID:SIZE@PAD or ID:SIZE@PAD:RIGHT:UP such as 17:0.15@4:0.75:0"
    ),
    r"^(tcp|udp|tls|quic|ws|serial|unixsock-stream|unixpipe|vsock)/.+$": (
        "a zenoh endpoint such as tcp/192.168.1.5:7447"
    ),
}
