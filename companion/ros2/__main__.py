"""The nodes on zenoh that the service starts: `python -m companion.ros2`, options as JSON."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from contextlib import ExitStack

import zenoh

from companion.bus.child_client import LISTENING, PAUSED, ChildClient, open_patiently, run_child
from companion.bus.client import client_settings
from companion.ros2.dialect import NodeName, ZenohNode
from companion.ros2.gateway import Gateway, ServiceClock, follow_service, namespace_of
from companion.ros2.messages import OUTPUT_TOPICS, Messages, frame_prefix
from companion.ros2.requests import Requests
from companion.settings import Settings, ZenohSection

_WATCH_S = 0.5
_LARGEST_DOMAIN = 232


class _DomainError(ValueError):
    """ROS_DOMAIN_ID is no domain."""


def _work(client: ChildClient) -> None:
    options = client.options
    settings = Settings.model_validate({"vehicle": {"name": options["vehicle"]}, "ros2": options["settings"]})
    name = NodeName(_domain_id(settings), namespace_of(settings), settings.ros2.node_name)
    _run(settings, client, name)


def _run(settings: Settings, client: ChildClient, name: NodeName) -> None:
    ros2, vehicle = settings.ros2, settings.vehicle.name
    say, no_router = client.say, f"no zenoh router at {ros2.router}"
    with ExitStack() as stack:
        bus = stack.enter_context(client.open_bus())
        router = client_settings(ZenohSection(), (ros2.router,))
        session = stack.enter_context(open_patiently(router, client.ending, say, no_router))
        if bus is None or session is None:
            return
        clock = ServiceClock(client.zenoh)
        gateway = Gateway(bus, vehicle, Messages(frame_prefix(name.namespace), clock.ros_time_ns), say)
        stack.callback(gateway.close)
        plain = [kind for kind, used in ((False, ros2.rmw_zenoh), (True, ros2.plain_keys)) if used]
        nodes = [ZenohNode(session, name, plain=kind, want=gateway.want, say=say) for kind in plain]

        def publish_result(cdr: bytes) -> None:
            for node in nodes:
                node.send("~/result", cdr)

        def offer(cameras: Sequence[str]) -> None:
            for camera in set(cameras) - known:
                known.add(camera)
                for node in nodes:
                    node.offer([topic for topic in OUTPUT_TOPICS if topic.source.of_camera], camera)

        known: set[str] = set()
        requests = Requests(bus, vehicle, commands=ros2.commands, publish_result=publish_result, say=say)
        for node in nodes:
            node.declare(*requests.topics())
            node.offer(OUTPUT_TOPICS, None)
        stack.callback(follow_service(bus, vehicle, clock, offer).clear)
        routed = None
        while not client.ending.is_set():
            if (now := bool(session.info.routers_zid())) is not routed:
                routed = now
                say(
                    f"{LISTENING}at {ros2.router}"
                    if now
                    else f"{PAUSED}{no_router}{_other(session)}; retrying"
                )
            client.ending.wait(_WATCH_S)


def _domain_id(settings: Settings) -> int:
    if settings.ros2.domain_id is not None:
        return settings.ros2.domain_id
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not re.fullmatch("[0-9]{1,3}", text) or int(text) > _LARGEST_DOMAIN:
        raise _DomainError(f"ROS_DOMAIN_ID is {text!r}, expected 0 to {_LARGEST_DOMAIN}")
    return int(text)


def _other(session: zenoh.Session) -> str:
    peers = list(session.info.peers_zid())
    return ", but a peer: is it zenoh.listen of a service?" if peers else ""


if __name__ == "__main__":
    sys.exit(run_child(_work, refused=(_DomainError,)))
