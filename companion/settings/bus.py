"""The settings of the network."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import model_validator

from companion.settings.section import Section
from companion.settings.texts import ZenohEndpoint


class ZenohSection(Section):
    """The network on which detections are published and commands are received."""

    mode: Literal["peer", "client"] = "peer"
    """peer: connects to others directly; client: through the router at `connect`"""
    connect: tuple[ZenohEndpoint, ...] = ()
    """endpoints to connect to, e.g. tcp/192.168.1.5:7447; retried until connected"""
    listen: tuple[ZenohEndpoint, ...] = ("tcp/127.0.0.1:7447",)
    """endpoints to listen on (peer only); tcp/0.0.0.0:7447 is open to the whole network"""
    multicast_scouting: bool = False
    """find other peers on the local network by multicast"""
    config_file: str | None = None
    """zenoh's configuration file (JSON5): TLS, access control; its keys replace defaults of those above"""
    child_config_file: str | None = None
    """the same for dashboard, recorder, Foxglove and ROS 2 of the service; unset: config_file"""

    @model_validator(mode="after")
    def _reachable(self) -> Self:
        if self.mode == "client" and not self.connect and not self.multicast_scouting:
            raise ValueError("a client needs an endpoint in connect, or multicast_scouting = true")
        return self
