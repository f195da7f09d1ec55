"""From the bus to the broker and the webhooks: state, events of objects, snapshots, commands."""

from __future__ import annotations

import asyncio
import json
import math
import os
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial
from importlib.metadata import version
from threading import Thread
from typing import Any

import zenoh

from companion.bus.child_client import LISTENING, ChildClient
from companion.bus.client import (
    SILENT_S,
    NoAnswerError,
    image_of,
    message_of,
    send_command,
    subscribe_kept,
)
from companion.bus.command_order import CommandOrder, Turn, is_stop
from companion.bus.topics import IMAGE, STATUS, TRACKS, VEHICLE, Topic
from companion.host.peer_data import PeerDataError, parse_object
from companion.host.tasks import error_text
from companion.mqtt.broker import OFFLINE, ONLINE, BrokerLink, broker_of
from companion.mqtt.home_assistant import discovery, discovery_topic, snapshot_path
from companion.mqtt.object_events import ObjectEvent, ObjectEvents
from companion.mqtt.webhooks import Webhook
from companion.settings.operator import MqttSection

_TICK_S = 0.1
_COMMAND_TIMEOUT_S, _STOP_TIMEOUT_S = 3600.0, 10.0
# That wait for their outcome; `stop` has a separate allowance of the same size.
_MOST_COMMANDS = 4


class _Publisher:
    """From the bus to the broker and the webhooks. All methods run in the asyncio loop."""

    def __init__(self, client: ChildClient, bus: zenoh.Session) -> None:
        section = MqttSection.model_validate(client.options["mqtt"], strict=False)
        self._bus, self._say = bus, client.say
        self._loop, self._vehicle = asyncio.get_running_loop(), client.options["vehicle"]
        self._base = f"{section.prefix}/{self._vehicle}"
        self._events = ObjectEvents(self._want_image)
        self._images: dict[str | None, zenoh.Subscriber[None]] = {}
        self._webhooks = [Webhook(url, client.say) for url in section.webhooks]
        self._place: dict[str, Any] = {}
        self._status_s = -math.inf
        self._commands: Counter[bool] = Counter()  # that wait for their outcome, by whether it is `stop`
        self._order = CommandOrder()
        self._link: BrokerLink | None = None
        if section.url is None:
            client.say(f"{LISTENING}{len(self._webhooks)} webhooks")
            return
        commands = f"{self._base}/command" if section.commands else None
        available = f"{self._base}/available"
        self._link = BrokerLink(broker_of(section), available, client.say, commands, self._on_command)
        self._link.state(available, OFFLINE.encode())
        if section.discovery_prefix:
            cameras = (None, *client.options["cameras"])
            found = discovery(self._vehicle, self._base, cameras, version("mavlink-companion"))
            self._link.state(discovery_topic(section.discovery_prefix, self._vehicle), _json(found))

    async def run(self, client: ChildClient) -> None:
        """Work until the parent ends."""
        cameras = (None, *client.options["cameras"])
        receivers = [(TRACKS, camera, self._on_tracks) for camera in cameras]
        receivers += [(STATUS, None, self._on_status), (VEHICLE, None, self._on_vehicle)]
        with ExitStack() as stack:
            for topic, camera, receive in receivers:
                key, hop = topic.key(self._vehicle, camera), partial(self._hop, topic, receive)
                # Of the kept messages only a status is wanted: older events were sent, or are too old.
                subscribe = subscribe_kept if topic is STATUS else zenoh.Session.declare_subscriber
                stack.callback(subscribe(self._bus, key, hop).undeclare)
            works = [self._tick(), *(webhook.run() for webhook in self._webhooks)]
            if self._link is not None:
                works.append(self._link.run())
            async with asyncio.TaskGroup() as group:
                tasks = [group.create_task(work) for work in works]
                await client.ended()
                for task in tasks:
                    task.cancel()

    def _hop(self, topic: Topic, receive: Callable[[dict[str, Any]], None], sample: zenoh.Sample) -> None:
        """From a thread of zenoh into the loop."""
        try:
            body = parse_object(message_of(sample, topic)[0])
        except PeerDataError as error:
            self._say(f"{topic.name}: {error}")
            return
        self._loop.call_soon_threadsafe(self._receive, topic, receive, body)

    def _receive(self, topic: Topic, receive: Callable[[dict[str, Any]], None], body: dict[str, Any]) -> None:
        try:
            receive(body)
        except (
            LookupError,
            TypeError,
            ValueError,
            ArithmeticError,
        ) as error:  # of a peer, not of the service
            self._say(f"{topic.name}: not valid: {error_text(error)}")

    async def _tick(self) -> None:
        while True:
            now_ns = time.monotonic_ns()
            self._send(self._events.due(now_ns))
            if self._link is not None and 0.0 < time.monotonic() - self._status_s - SILENT_S < math.inf:
                self._status_s = -math.inf
                self._link.state(f"{self._base}/available", OFFLINE.encode())
            await asyncio.sleep(_TICK_S)

    def _on_tracks(self, body: dict[str, Any]) -> None:
        self._send(self._events.on_tracks(body, time.monotonic_ns()))

    def _on_image(self, camera: str | None, captured_ns: int, jpeg: bytes) -> None:
        self._send(self._events.on_image(camera, captured_ns, jpeg))

    def _want_image(self, camera: str | None, wanted: bool) -> None:
        if not wanted:
            self._images.pop(camera).undeclare()  # type: ignore[no-untyped-call]
            return

        def receive(sample: zenoh.Sample) -> None:
            try:
                jpeg, about = image_of(sample)
                captured_ns = int(about["captured_ns"])
            except (PeerDataError, KeyError, TypeError, ValueError) as error:
                self._say(f"image: {error}")
                return
            self._loop.call_soon_threadsafe(self._on_image, camera, captured_ns, jpeg)

        self._images[camera] = self._bus.declare_subscriber(IMAGE.key(self._vehicle, camera), receive)

    def _send(self, events: list[ObjectEvent]) -> None:
        for event in events:
            if self._webhooks:
                body = _json(event.body(with_snapshot=True))
                for webhook in self._webhooks:
                    webhook.put(event.about["event_id"], body)
            if self._link is not None:
                if event.snapshot is not None:
                    self._link.state(f"{self._base}/{snapshot_path(event.camera)}", event.snapshot)
                self._link.event(f"{self._base}/objects", _json(event.body(with_snapshot=False)))

    def _on_vehicle(self, body: dict[str, Any]) -> None:
        self._place = body

    def _on_status(self, body: dict[str, Any]) -> None:
        if self._link is None:
            return
        place, state = (
            self._place,
            _json(state_of(body, self._place)),
        )  # before anything of a wrong body is sent
        # Each time: the broker may publish the will of a connection that was lost long after the next began.
        self._link.state(f"{self._base}/available", ONLINE.encode())
        self._status_s = time.monotonic()
        self._link.state(f"{self._base}/state", state)
        if place.get("latitude_deg") is not None:
            names = {"latitude": "latitude_deg", "longitude": "longitude_deg", "altitude": "altitude_amsl_m"}
            self._link.state(f"{self._base}/place", _json({name: place[key] for name, key in names.items()}))

    def _on_command(self, text: str) -> None:
        stop = is_stop(text)
        if self._commands[stop] >= _MOST_COMMANDS:
            self._answer(text, {"success": False, "reason": f"{_MOST_COMMANDS} commands are in progress"})
            return
        self._commands[stop] += 1
        turn = self._order.turn(self._vehicle, text)
        # Not of the loop's pool, whose end would wait for it.
        Thread(target=self._execute, args=(text, turn), name="MQTT command", daemon=True).start()

    def _execute(self, text: str, turn: Turn) -> None:
        """Runs in a thread of its own."""
        timeout_s = _STOP_TIMEOUT_S if turn.is_stop else _COMMAND_TIMEOUT_S
        try:
            reply = send_command(
                self._bus, self._vehicle, text, timeout_s=timeout_s, on_silent=self._say, turn=turn
            )
        except (NoAnswerError, PeerDataError, zenoh.ZError) as error:
            reply = {"success": False, "reason": str(error)}
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._on_reply, text, reply)

    def _on_reply(self, text: str, reply: dict[str, Any]) -> None:
        self._commands[is_stop(text)] -= 1
        self._answer(text, reply)

    def _answer(self, text: str, reply: dict[str, Any]) -> None:
        assert self._link is not None
        self._link.event(f"{self._base}/result", _json({"command": text[:200], **reply}))


def state_of(status: dict[str, Any], vehicle: dict[str, Any]) -> dict[str, Any]:
    """Return the state of a vehicle from the topics `status` and `vehicle`; the latter may be empty."""
    pilot, autopilot = status["pilot"], status["vehicle"]
    battery, yaw_rad = vehicle.get("battery_fraction"), vehicle.get("yaw_rad")
    altitude_m = vehicle.get("altitude_m")
    return {
        "connected": autopilot["connected"],
        "armed": autopilot["armed"],
        "mode": autopilot["mode"],
        "failsafe": autopilot["failsafe"],
        "behaviour": pilot["behaviour"],
        "in_command": pilot["in_command"],
        "problem": not status["healthy"],
        "problems": status["unhealthy"],
        "battery_percent": None if battery is None else round(100.0 * battery, 1),
        "altitude_m": None if altitude_m is None else round(altitude_m, 2),
        "heading_deg": None if yaw_rad is None else round(math.degrees(yaw_rad) % 360.0, 1),
        "objects": sum(each["tracks"] for each in (status["perception"], *status["cameras"].values())),
    }


def _json(body: dict[str, Any]) -> bytes:
    return json.dumps(body, ensure_ascii=False, allow_nan=False).encode()


def publish(client: ChildClient) -> None:
    """Publish until the parent ends. Raises MqttError: something in the settings cannot be used."""
    with client.open_bus() as bus:
        if bus is not None:
            asyncio.run(_publish(client, bus))


async def _publish(client: ChildClient, bus: zenoh.Session) -> None:
    await _Publisher(client, bus).run(client)
    os._exit(0)  # without waiting for a thread that still connects to a broker
