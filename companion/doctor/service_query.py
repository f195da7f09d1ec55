"""Looks for a running service, and collects what it publishes. Nothing but queries is sent."""

from __future__ import annotations

import contextlib
import re
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Self, cast

import zenoh
from zenoh import ext

from companion.bus.bodies.service import EventBody, PortParametersBody, StatusBody
from companion.bus.bodies.vehicle import VehicleBody
from companion.bus.client import (
    NoAnswerError,
    RefusedError,
    alive_vehicles,
    client_settings,
    open_client,
    subscribe_kept,
)
from companion.bus.config import BusError
from companion.bus.topics import EVENTS, LARGEST_JSON_BYTES, ROOT, STATUS, VEHICLE, Topic
from companion.doctor.check import Check, fault, ok, unknown, warning
from companion.doctor.facts import Service
from companion.host.peer_data import PeerDataError, copy_payload, parse_object
from companion.settings import Settings, ZenohSection

_CONNECT_S = 1.0
# `status` comes once a second; a second service of the same name is seen within this time.
_LEAST_S, _MOST_S = 1.3, 3.0
_QUERY_S = 1.5
# Of 12 parameters that an autopilot does not have, and of the others.
_PORTS_S = 5.5
_POLL_S = 0.05
_STATUSES = 5


@dataclass(frozen=True, slots=True)
class Found:
    """What was found where a service may be.

    Attributes:
        service: the running one. settings: its own; None: not known.
        instead: what was found instead; None: the service.
    """

    service: Service | None = None
    settings: Settings | None = None
    instead: Check | None = None


def find_service(zenoh_section: ZenohSection, named: str | None) -> Found:
    """Look for the running service.

    Args:
        named: the vehicle's name; None: the only one alive.
    """
    try:
        client = client_settings(zenoh_section)
        where = ", ".join(client.connect) or "the local network"
        with open_client(client, timeout_s=_CONNECT_S) as session:
            names = alive_vehicles(session)
            chosen = named if named is not None else names[0] if len(names) == 1 else None
            if chosen in names and chosen is not None:
                with ServiceWatch(session, chosen, here=all(map(is_here, client.connect))) as watch:
                    # It answers while the rest is collected.
                    replies = session.get(f"{ROOT}/{chosen}/port_parameters", timeout=_PORTS_S)
                    service, settings = watch.collect(), settings_of(session, chosen)
                    return Found(replace(service, ports=_ports_of(replies)), settings)
            return Found(instead=_not_chosen(names, named, where))
    except RefusedError as error:
        hangs = "if it is a service that hangs, on the ground: sudo systemctl restart companion"
        return Found(instead=fault("service", str(error), hangs))
    except NoAnswerError:
        return Found(instead=ok("service", f"none runs at {where}"))
    except BusError as error:
        return Found(instead=fault("service", str(error), "correct zenoh.config_file"))


def _not_chosen(names: list[str], named: str | None, where: str) -> Check:
    if named is not None and names:
        found = f"no service of vehicle {named!r}; alive are {', '.join(names)}"
        return warning("service", found, f"companion doctor --vehicle-name {names[0]}")
    if names:
        found = f"{len(names)} vehicles are alive: {', '.join(names)}"
        return unknown("service", found, f"companion doctor --vehicle-name {names[0]} looks at one of them")
    return warning(
        "service", f"a zenoh node answers at {where}, and no service", "sudo systemctl start companion"
    )


class ServiceWatch:
    """What a service publishes, from now on and the kept messages before. A context manager.

    Attributes:
        vehicle: its name.
    """

    def __init__(self, session: zenoh.Session, vehicle: str, *, here: bool) -> None:
        self.vehicle, self._here = vehicle, here
        self._lock = threading.Lock()
        self._statuses: deque[StatusBody] = deque(maxlen=_STATUSES)
        self._received_s: float | None = None
        self._events: deque[EventBody] = deque(maxlen=EVENTS.cached)
        self._state: VehicleBody | None = None
        self._subscribers: list[zenoh.Subscriber[None] | ext.AdvancedSubscriber[None]] = [
            subscribe_kept(session, STATUS.key(vehicle), self._into(STATUS, self._on_status)),
            subscribe_kept(session, EVENTS.key(vehicle), self._into(EVENTS, self._on_event)),
            session.declare_subscriber(VEHICLE.key(vehicle), self._into(VEHICLE, self._on_state)),
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]

    @property
    def silent_s(self) -> float | None:
        """Time since the newest status, seconds; None: none was received."""
        with self._lock:
            return None if self._received_s is None else time.monotonic() - self._received_s

    def now(self) -> Service:
        """Return what was received so far."""
        with self._lock:
            return Service(
                self.vehicle,
                self._here,
                tuple(sorted(self._statuses, key=lambda status: status["stamp_ns"])),
                self._state,
                tuple(sorted(self._events, key=lambda event: event["stamp_ns"])),
            )

    def collect(self) -> Service:
        """Return what is received within at most 3 s: two statuses, and the state of the vehicle."""
        began_s = time.monotonic()
        while (waited_s := time.monotonic() - began_s) < _MOST_S:
            service = self.now()
            if waited_s > _LEAST_S and len(service.statuses) > 1 and service.state is not None:
                break
            time.sleep(_POLL_S)
        return self.now()

    def _into(self, topic: Topic, keep: Callable[[Any], None]) -> Callable[[zenoh.Sample], None]:
        def receive(sample: zenoh.Sample) -> None:  # on a zenoh thread
            with contextlib.suppress(PeerDataError), self._lock:
                keep(parse_object(copy_payload(sample.payload, topic.largest_bytes)))

        return receive

    def _on_status(self, body: StatusBody) -> None:
        # The kept one may be received again.
        if all(body["stamp_ns"] != known["stamp_ns"] for known in self._statuses):
            self._statuses.append(body)
            self._received_s = time.monotonic()

    def _on_event(self, body: EventBody) -> None:
        self._events.append(body)

    def _on_state(self, body: VehicleBody) -> None:
        self._state = body


def settings_of(session: zenoh.Session, vehicle: str) -> Settings | None:
    """Return the settings of a running service, without secrets; None: they cannot be read here."""
    with contextlib.suppress(PeerDataError, ValueError, OSError, zenoh.ZError):
        for reply in session.get(f"{ROOT}/{vehicle}/config", timeout=_QUERY_S):
            if reply.ok is not None:
                return Settings.from_json(parse_object(copy_payload(reply.ok.payload, LARGEST_JSON_BYTES)))
    return None


def _ports_of(replies: Iterable[zenoh.Reply]) -> PortParametersBody | None:
    with contextlib.suppress(PeerDataError, zenoh.ZError):
        for reply in replies:
            if reply.ok is not None:
                body = parse_object(copy_payload(reply.ok.payload, LARGEST_JSON_BYTES))
                return cast(PortParametersBody, body)
    return None


def is_here(endpoint: str) -> bool:
    """Whether an endpoint of zenoh is an address of this computer."""
    match = re.match(r"[a-z]+/(.+):\d+", endpoint)
    if match is None:
        return endpoint.startswith("unix")
    try:
        family, kind, _, _, address = socket.getaddrinfo(match[1].strip("[]"), 0, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind) as trial:
            trial.bind(address)  # only to an address of an interface of ours
    except OSError:
        return False
    return True
