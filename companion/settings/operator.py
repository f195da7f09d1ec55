"""The settings of dashboard, recordings, Foxglove, metrics, log and plug-ins."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from companion.settings.perception import VideoSection
from companion.settings.section import Section
from companion.settings.texts import (
    HOST_AND_PORT,
    HOST_AND_PORT_OR_EMPTY,
    HTTP_URL,
    MQTT_PREFIX,
    MQTT_PREFIX_OR_EMPTY,
    MQTT_URL,
    ROS_NAME,
    ROS_NAMESPACE,
    STATION_URL,
    PageHost,
    ZenohEndpoint,
)


class DashboardSection(Section):
    """The web page of the vehicle."""

    listen: Annotated[str, HOST_AND_PORT_OR_EMPTY] = "127.0.0.1:8088"
    """HOST:PORT of the page; empty: none"""
    token_file: str | None = None
    """file with the token, readable by its owner only; required if other computers can reach the page"""
    hosts: tuple[PageHost, ...] = ()
    """names under which a proxy such as nginx serves the page, as in a browser's address"""


class RecordingSection(VideoSection):
    """Recordings on disk: the annotated video, and everything as MCAP."""

    directory: str = ""
    """folder of the MCAP recordings, one per run (extra `recording`); empty: none"""
    content: tuple[Literal["jpeg", "png", "depth", "clouds"], ...] = ("jpeg",)
    """what is recorded beside messages; jpeg: preview images, or png: whole processed frames"""
    max_file_mb: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    """size at which the next file begins, megabytes; it also begins after an hour"""
    max_total_mb: Annotated[int, Field(ge=1, le=100_000_000)] = 10_000
    """size of all recordings in the folder, megabytes; the oldest are removed"""

    @model_validator(mode="after")
    def _one_kind_of_images(self) -> Self:
        if {"jpeg", "png"} <= set(self.content):
            raise ValueError("content: jpeg and png are the same images: remove one of them")
        return self

    @property
    def images(self) -> bool:
        """Whether images are recorded, of either kind."""
        return not {"jpeg", "png"}.isdisjoint(self.content)


class FoxgloveSection(Section):
    """Live data for Foxglove."""

    listen: Annotated[str | None, HOST_AND_PORT] = None
    """HOST:PORT of Foxglove's WebSocket, such as 127.0.0.1:8765 (extra `recording`); unset: disabled"""


class Ros2Section(Section):
    """ROS 2: the node of `companion ros2 node`, and rmw_zenoh from the service itself."""

    namespace: Annotated[str | None, ROS_NAMESPACE] = None
    """of node and topics, and before the names of frames; empty: none; unset: the vehicle's name"""
    node_name: Annotated[str, ROS_NAME] = "companion"
    """name of the node"""
    domain_id: Annotated[int | None, Field(ge=0, le=232)] = None
    """domain of ROS; unset: that of the variable ROS_DOMAIN_ID, else 0"""
    commands: bool = False
    """execute object_to_seek and ~/command; cmd_vel acts under the command `velocity` alone"""
    rmw_zenoh: bool = False
    """a node for rmw_zenoh_cpp, from the service itself: without ROS on this computer"""
    router: ZenohEndpoint = "tcp/127.0.0.1:7447"
    """zenoh router of rmw_zenoh and of the bridge; not an endpoint of zenoh.listen"""
    plain_keys: bool = False
    """the same on the keys of zenoh-bridge-ros2dds"""


class MqttSection(Section):
    """Events of objects, the vehicle's state and Home Assistant by MQTT; events by webhooks. Extra `mqtt`."""

    url: Annotated[str | None, MQTT_URL] = None
    """broker, such as mqtt://192.168.1.5:1883, or mqtts:// for TLS; unset: none"""
    username: str | None = None
    """of the broker"""
    password_file: str | None = None
    """file with the password, readable by its owner only"""
    ca_file: str | None = None
    """certificates that sign the broker's, PEM; unset: the system's"""
    prefix: Annotated[str, MQTT_PREFIX] = "companion"
    """first part of the topics; the vehicle's name is the second"""
    discovery_prefix: Annotated[str, MQTT_PREFIX_OR_EMPTY] = "homeassistant"
    """where Home Assistant looks for devices; empty: no discovery"""
    commands: bool = False
    """execute what is published on PREFIX/NAME/command: whoever can publish there can fly"""
    webhooks: tuple[Annotated[str, HTTP_URL], ...] = ()
    """addresses to which events of objects are posted as JSON"""


class GroundStationSection(Section):
    """Ground stations: the cameras over MAVLink, video, warnings."""

    url: Annotated[str | None, STATION_URL] = None
    """MAVLink endpoint of the station or router, udpout://10.0.0.2:14550; unset: no cameras are announced"""
    video_listen: Annotated[str | None, HOST_AND_PORT] = None
    """HOST:PORT of the video (RTSP), such as 0.0.0.0:8554; unset: no video"""
    video_host: str | None = None
    """this computer's name in the addresses of videos; unset: its address towards the station"""
    video_token_file: str | None = None
    """file with the token, readable by its owner only; required if other computers can reach video_listen"""
    track_follows: bool = False
    """true: a click of a station selects an object and follows it; false: it only selects"""
    target_relative: bool = False
    """send the selected object's position to the autopilot, as TARGET_RELATIVE"""


class MetricsSection(Section):
    """Metrics for a monitoring system."""

    listen: Annotated[str | None, HOST_AND_PORT] = None
    """HOST:PORT of the Prometheus endpoint /metrics (extra `service`); unset: disabled"""


class LogSection(Section):
    """The log on standard error."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    """minimum level of printed lines"""


class PluginsSection(Section):
    """Third-party behaviours, detectors and sources. Only the modules named here are loaded."""

    modules: tuple[str, ...] = ()
    """modules on the Python path, or names of installed plug-ins (entry points `companion.plugins`)"""
