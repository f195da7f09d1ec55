"""The nodes on zenoh that the service starts: `python -m companion.ros2`, options as JSON."""

from __future__ import annotations

import os
import re
import sys
from contextlib import ExitStack

import zenoh

from companion.bus.child_client import LISTENING, PAUSED, ChildClient, open_patiently, run_child
from companion.bus.client import client_settings
from companion.ros2.dialect import NodeName, ZenohNode
from companion.ros2.gateway import ServiceClock
from companion.ros2.wiring import connected, namespace_of
from companion.settings import Settings, ZenohSection

_WATCH_S = 0.5
_LARGEST_DOMAIN = 232


class _DomainError(ValueError):
    """ROS_DOMAIN_ID is no domain."""


def _work(client: ChildClient) -> None:
    """Run the nodes until the service ends."""
    options = client.options
    settings = Settings.model_validate({"vehicle": {"name": options["vehicle"]}, "ros2": options["settings"]})
    ros2, say, namespace = settings.ros2, client.say, namespace_of(settings)
    name, no_router = (
        NodeName(_domain_id(settings), namespace, ros2.node_name),
        f"no zenoh router at {ros2.router}",
    )
    with ExitStack() as stack:
        bus = stack.enter_context(client.open_bus())
        router = client_settings(ZenohSection(), (ros2.router,))
        session = stack.enter_context(open_patiently(router, client.ending, say, no_router))
        if bus is None or session is None:
            return
        plain = [kind for kind, used in ((False, ros2.rmw_zenoh), (True, ros2.plain_keys)) if used]
        nodes = [ZenohNode(session, name, plain=kind, say=say) for kind in plain]
        stack.enter_context(connected(bus, settings, namespace, ServiceClock(), nodes, say))
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
