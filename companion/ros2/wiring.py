"""Connects the nodes of one vehicle with its service."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

import zenoh

from companion.bus.client import message_of, subscribe_kept
from companion.bus.topics import STATUS
from companion.host.peer_data import parse_object
from companion.ros2.gateway import Gateway, Node, ServiceClock
from companion.ros2.messages import Messages, frame_prefix, ros_name
from companion.ros2.requests import Requests
from companion.settings import Settings


def namespace_of(settings: Settings) -> str:
    """Return the namespace of a vehicle's topics, without an outer `/`; empty: none."""
    given = settings.ros2.namespace
    return ros_name(settings.vehicle.name) if given is None else given


@contextmanager
def connected(
    bus: zenoh.Session,
    settings: Settings,
    namespace: str,
    clock: ServiceClock,
    nodes: Sequence[Node],
    say: Callable[[str], None],
) -> Iterator[None]:
    """Publish in the nodes meanwhile what they want of the vehicle, and pass on what they receive.

    Args:
        namespace: as `namespace_of`; begins the names of frames.
        clock: is kept by the status of the service, which names the further cameras too.
        say: called with a line, from any thread.
    """

    known: set[str] = set()
    owners: dict[str, str] = {}  # name in ROS: camera

    def publish_result(cdr: bytes) -> None:
        for node in nodes:
            node.send("~/result", cdr)

    def on_status(sample: zenoh.Sample) -> None:
        with suppress(ValueError, KeyError, TypeError):  # of another version
            status = parse_object(message_of(sample, STATUS)[0])
            clock.on_status(int(status["unix_offset_ns"]))
            for camera in sorted(status["cameras"].keys() - known):
                known.add(camera)
                if (owner := owners.setdefault(ros_name(camera), camera)) == camera:
                    gateway.offer(camera)
                else:
                    say(f"camera {camera!r} is left out: its topics are those of {owner!r}; rename one")

    vehicle = settings.vehicle.name
    gateway = Gateway(bus, vehicle, Messages(frame_prefix(namespace), clock.ros_time_ns), nodes, say)
    requests = Requests(bus, vehicle, commands=settings.ros2.commands, publish_result=publish_result, say=say)
    for node in nodes:
        node.declare(*requests.topics())
    gateway.offer(None)
    following = subscribe_kept(bus, STATUS.key(vehicle), on_status)
    try:
        yield
    finally:
        following.undeclare()  # type: ignore[no-untyped-call]
        gateway.close()
