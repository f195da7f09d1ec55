"""The nodes on zenoh that the service starts: `python -m companion.ros2 OPTIONS`, as JSON."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from threading import Event

import zenoh

from companion.bus.client import NoAnswerError, client_settings, open_client, settings_in_child
from companion.bus.config import BusError
from companion.host.child_process import EXIT_REFUSED, on_parent_end
from companion.recording import LISTENING, PAUSED
from companion.ros2.dialect import NodeName, ZenohNode
from companion.ros2.gateway import Gateway, ServiceClock, follow_service, namespace_of
from companion.ros2.messages import OUTPUT_TOPICS, Messages, frame_prefix
from companion.ros2.requests import Requests
from companion.settings import Settings, ZenohSection

_RETRY_S, _WATCH_S = 2.0, 0.5
_LARGEST_DOMAIN = 232


class _DomainError(ValueError):
    """ROS_DOMAIN_ID is no domain."""


def main(argument: str) -> int:
    """Work until the parent ends; returns the exit code."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, as a closed terminal is
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    ending = Event()
    on_parent_end(ending.set)
    options = json.loads(argument)
    settings = Settings.model_validate({"vehicle": {"name": options["vehicle"]}, "ros2": options["settings"]})
    try:
        name = NodeName(_domain_id(settings), namespace_of(settings), settings.ros2.node_name)
        _run(settings, settings_in_child(options["zenoh"]), name, ending)
    except (BusError, _DomainError) as error:
        _say(str(error))
        return EXIT_REFUSED
    return 0


def _run(settings: Settings, section: ZenohSection, name: NodeName, ending: Event) -> None:
    ros2, vehicle = settings.ros2, settings.vehicle.name
    no_router = f"no zenoh router at {ros2.router}"
    with ExitStack() as stack:
        bus = _open(stack, section, ending)
        session = _open(stack, client_settings(ZenohSection(), (ros2.router,)), ending, no_router)
        if bus is None or session is None:
            return
        clock = ServiceClock(section)
        gateway = Gateway(bus, vehicle, Messages(frame_prefix(name.namespace), clock.ros_time_ns), _say)
        stack.callback(gateway.close)
        plain = [kind for kind, used in ((False, ros2.rmw_zenoh), (True, ros2.plain_keys)) if used]
        nodes = [ZenohNode(session, name, plain=kind, want=gateway.want, say=_say) for kind in plain]

        def publish_result(cdr: bytes) -> None:
            for node in nodes:
                node.send("~/result", cdr)

        def offer(cameras: Sequence[str]) -> None:
            for camera in set(cameras) - known:
                known.add(camera)
                for node in nodes:
                    node.offer([topic for topic in OUTPUT_TOPICS if topic.source.of_camera], camera)

        known: set[str] = set()
        requests = Requests(bus, vehicle, commands=ros2.commands, publish_result=publish_result, say=_say)
        for node in nodes:
            node.declare(*requests.topics())
            node.offer(OUTPUT_TOPICS, None)
        stack.callback(follow_service(bus, vehicle, clock, offer).clear)
        routed = None
        while not ending.is_set():
            if (now := bool(session.info.routers_zid())) is not routed:
                routed = now
                _say(
                    f"{LISTENING}at {ros2.router}"
                    if now
                    else f"{PAUSED}{no_router}{_other(session)}; retrying"
                )
            ending.wait(_WATCH_S)


def _domain_id(settings: Settings) -> int:
    if settings.ros2.domain_id is not None:
        return settings.ros2.domain_id
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not re.fullmatch("[0-9]{1,3}", text) or int(text) > _LARGEST_DOMAIN:
        raise _DomainError(f"ROS_DOMAIN_ID is {text!r}, expected 0 to {_LARGEST_DOMAIN}")
    return int(text)


def _open(stack: ExitStack, section: ZenohSection, ending: Event, missing: str = "") -> zenoh.Session | None:
    """Open a session, however late its node comes; None: ended before. `missing`: why there is none."""
    said = False
    while not ending.is_set():
        try:
            return stack.enter_context(open_client(section, timeout_s=0.0))
        except NoAnswerError as error:
            if not said:
                _say(f"{PAUSED}{missing or error}; retrying")
            said = True
        ending.wait(_RETRY_S)
    return None


def _other(session: zenoh.Session) -> str:
    peers = list(session.info.peers_zid())
    return ", but a peer: is it zenoh.listen of a service?" if peers else ""


def _say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
