"""The client of one vehicle's service, and the connection to it."""

from __future__ import annotations

import asyncio
import json
import threading
import time
import uuid
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from functools import cache, partial
from typing import Any

import zenoh
from pydantic import TypeAdapter, ValidationError

from companion.bus import topics
from companion.bus.bodies.frames import DepthBody, DetectionsBody, MarkersBody, TracksBody
from companion.bus.bodies.service import CommandStateBody, EventBody, StatusBody
from companion.bus.bodies.vehicle import ObstaclesBody, VehicleBody, VelocityBody
from companion.bus.client import (
    NoAnswerError,
    alive_vehicles,
    client_settings,
    only_vehicle,
    open_client,
    send_command,
)
from companion.bus.command_order import CommandOrder
from companion.client.commands import NON_FLIGHT, Commands, Reply
from companion.client.endings import Endings
from companion.client.stream import Stream
from companion.host.peer_data import copy_payload, parse_json, parse_object
from companion.settings import ZenohSection

# Longer than any command; a caller's `asyncio.timeout` ends it earlier.
_COMMAND_TIMEOUT_S = 24 * 3600.0
_STOP_TIMEOUT_S = 5.0
# After `stop`, the outcome of the stopped command arrives within this.
_STOPPED_WITHIN_S = 1.0
_DISCOVERY_S = 2.0
_QUERY_S = 10.0


class CommandFailedError(RuntimeError):
    """The command was refused or failed. `reply`: the service's reply; the message is its reason."""

    def __init__(self, reply: Reply) -> None:
        super().__init__(f"{reply.get('command', '')}: {reply.get('reason', '')}")
        self.reply = reply


class Steering:
    """Sends velocities under the command `velocity`."""

    def __init__(self, publisher: zenoh.Publisher, source: str) -> None:
        self._publisher, self.source = publisher, source
        self._ended: Callable[[], CommandStateBody | None] = lambda: None

    def send(
        self,
        forward: float = 0.0,
        right: float = 0.0,
        up: float = 0.0,
        turn: float = 0.0,
        *,
        lifetime: float = 0.5,
    ) -> None:
        """Fly this velocity until the next one, for at most its lifetime; then the vehicle brakes and holds.

        Nothing repeats it: a program that hangs or ends stops the vehicle.

        Args:
            forward, right, up: m/s, in the level frame. turn: rad/s, clockwise seen from above.
            lifetime: seconds, at most 0.5.

        Raises:
            ValueError: a value is not finite or out of range.
            CommandFailedError: the command has ended; its reason says why.
        """
        if (ended := self._ended()) is not None:
            raise CommandFailedError({**ended, "success": False, "reason": f"ended: {ended['reason']}"})
        self._put(forward, right, up, turn, lifetime)

    def end(self) -> None:
        """Replace the last velocity, which may still be valid, by zero."""
        self._put(0.0, 0.0, 0.0, 0.0, 0.5)

    def _put(self, forward: float, right: float, up: float, turn: float, lifetime: float) -> None:
        body: VelocityBody = {
            "source": self.source,
            "stamp_ns": time.monotonic_ns(),
            "forward_mps": float(forward),
            "right_mps": float(right),
            "up_mps": float(up),
            "turn_radps": float(turn),
            "lifetime_s": float(lifetime),
        }
        try:
            _velocity_body().validate_python(body)
        except ValidationError as error:
            first = error.errors()[0]
            name = str(first["loc"][0]).partition("_")[0]
            raise ValueError(f"{name}: {first['msg']}, got {first['input']}") from None
        self._publisher.put(json.dumps(body))


@cache
def _velocity_body() -> TypeAdapter[VelocityBody]:
    return TypeAdapter(VelocityBody)


class Drone(Commands):
    """One vehicle. Its commands wait until they have ended; an endless one until the vehicle flies it, and
    `ended` waits for its end.

    Commands are sent in the order of their calls. `stop` is sent at once; those before it that are not yet
    sent then fail. Cancelling a waiting command sends `stop`. A command that is refused or fails raises
    CommandFailedError.

    Attributes:
        name: `vehicle.name` of its service.
    """

    def __init__(self, session: zenoh.Session, name: str) -> None:
        self._session, self.name = session, name
        self._order = CommandOrder()
        # One for all its steering: the last message of the one before is still valid at the next.
        self._source = f"client-{uuid.uuid4().hex[:8]}"
        self._steering: Steering | None = None
        self._endings: Endings | None = None

    @property
    def session(self) -> zenoh.Session:
        """The connection, for other keys."""
        return self._session

    def other(self, name: str) -> Drone:
        """Another vehicle on the same connection."""
        drone = Drone(self._session, name)
        drone._order = self._order
        return drone

    async def vehicles(self) -> list[str]:
        """The names of all vehicles whose service runs."""
        return await asyncio.to_thread(alive_vehicles, self._session)

    async def command(self, text: str) -> Reply:
        """Send any command, a plug-in's too; for a mission, its file's lines may follow the first line.

        Raises:
            CommandFailedError: it was refused or failed. NoAnswerError: no service, or it has gone.
        """
        outcome = self._send(text, _COMMAND_TIMEOUT_S)
        try:
            reply = await asyncio.shield(outcome)
        except asyncio.CancelledError:
            word = text.lower().split()[:1]
            if word and word[0] not in NON_FLIGHT:
                await asyncio.shield(self._stop(outcome))
            raise
        if not reply["success"]:
            raise CommandFailedError(reply)
        return reply

    async def ended(self, reply: Reply) -> CommandStateBody:
        """Wait until a command has ended; returns its last message, with `success` and `reason`.

        An endless command ends when another one replaces it, by `stop`, or when the vehicle is flown by
        something else: a pilot, a failsafe. Raises nothing for such an end. While the service is there and
        silent, a warning in the log says so once, as it does for a command that waits.

        Args:
            reply: of the command, as its method has returned it.

        Raises:
            NoAnswerError: the service has gone meanwhile.
        """
        return await self._watched().wait(str(reply["id"]))

    def ending(self, reply: Reply) -> CommandStateBody | None:
        """How a command has ended, as `ended` returns it; None: it has not, as far as known here."""
        return self._watched().of(str(reply.get("id")))

    async def _stop(self, outcome: asyncio.Future[Reply]) -> None:
        """End a command: `stop`, again if the command reached the service, or became active, after it."""
        for _ in range(3):
            answered = outcome.done()
            if answered and (outcome.exception() is not None or not outcome.result()["success"]):
                return
            with suppress(NoAnswerError):
                await self._send("stop", _STOP_TIMEOUT_S)
                if answered:  # with success: an endless one is active
                    return
            await asyncio.wait([outcome], timeout=_STOPPED_WITHIN_S)

    def _send(self, text: str, timeout_s: float) -> asyncio.Future[Reply]:
        """Send a command from a thread of its own: a pool would let endless ones delay a `stop`."""
        self._watched()
        turn = self._order.turn(self.name, text)
        loop = asyncio.get_running_loop()
        outcome: asyncio.Future[Reply] = loop.create_future()
        outcome.add_done_callback(lambda done: done.cancelled() or done.exception())  # it may not be awaited

        def finish(reply: Reply | None, error: Exception | None) -> None:
            if error is not None:
                outcome.set_exception(error)
            elif reply is not None:
                outcome.set_result(reply)

        def send() -> None:
            reply: Reply | None = None
            failure: Exception | None = None
            try:
                reply = send_command(self._session, self.name, text, timeout_s=timeout_s, turn=turn)
            except (NoAnswerError, ValueError, zenoh.ZError) as error:
                failure = error
            with suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(finish, reply, failure)

        threading.Thread(target=send, name=f"command {self.name}", daemon=True).start()
        return outcome

    def _watched(self) -> Endings:
        if self._endings is None:
            self._endings = Endings(self._session, self.name)
        return self._endings

    @asynccontextmanager
    async def steer(self) -> AsyncIterator[Steering]:
        """Begin the command `velocity` for this program's messages; afterwards the vehicle brakes and holds.

        Raises:
            CommandFailedError: it is refused, for example while another sender steers.
            NoAnswerError: as `command`. RuntimeError: this Drone is being steered already.
        """
        if self._steering is not None:
            raise RuntimeError(f"{self.name} is being steered already: use one `steer()` at a time")
        topic = topics.VELOCITY
        with self._session.declare_publisher(
            topic.key(self.name),
            encoding=topic.encoding,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=topic.priority,
            express=topic.express,
        ) as publisher:
            self._steering = steering = Steering(publisher, self._source)
            try:
                begun = await self.velocity(source=self._source)
                steering._ended = partial(self._watched().of, str(begun.get("id")))
                try:
                    yield steering
                finally:
                    steering.end()
            finally:
                self._steering = None

    async def query(self, path: str) -> Any:
        """Ask one of the queryables status, config, models, commands.

        Raises:
            NoAnswerError: no answer within 10 s. PeerDataError: the answer cannot be used.
        """

        def ask() -> Any:
            for reply in self._session.get(f"{topics.ROOT}/{self.name}/{path}", timeout=_QUERY_S):
                if reply.ok is not None:
                    return parse_json(copy_payload(reply.ok.payload, topics.LARGEST_JSON_BYTES))
            raise NoAnswerError(f"{path}: no answer from vehicle {self.name!r} within {_QUERY_S:g} s")

        return await asyncio.to_thread(ask)

    # --- messages: the bodies of docs/messages.md

    def detections(self, camera: str | None = None, *, size: int = 1) -> Stream[DetectionsBody]:
        """Detections of each frame. `camera`: one of the settings' table; None: the first."""
        return self._stream(topics.DETECTIONS, camera, size)

    def tracks(self, camera: str | None = None, *, size: int = 100) -> Stream[TracksBody]:
        """Events of tracks, the kept ones first."""
        return self._stream(topics.TRACKS, camera, size)

    def markers(self, camera: str | None = None, *, size: int = 1) -> Stream[MarkersBody]:
        """Markers of each frame."""
        return self._stream(topics.MARKERS, camera, size)

    def depth(self, camera: str | None = None, *, size: int = 1) -> Stream[DepthBody]:
        """Distances of each frame with depth."""
        return self._stream(topics.DEPTH, camera, size)

    def vehicle(self, *, size: int = 1) -> Stream[VehicleBody]:
        """State of the vehicle, 10 times a second."""
        return self._stream(topics.VEHICLE, None, size)

    def obstacles(self, *, size: int = 1) -> Stream[ObstaclesBody]:
        """The nearest obstacle in 72 directions, per depth image."""
        return self._stream(topics.OBSTACLES, None, size)

    def status(self, *, size: int = 1) -> Stream[StatusBody]:
        """State of the service, once a second, the kept one first."""
        return self._stream(topics.STATUS, None, size)

    def events(self, *, size: int = 100) -> Stream[EventBody]:
        """Events of the service, the kept ones first."""
        return self._stream(topics.EVENTS, None, size)

    def command_states(self, *, size: int = 100) -> Stream[CommandStateBody]:
        """States of the commands of every sender, the kept ones first."""
        return self._stream(topics.COMMAND_STATE, None, size)

    def image(self, camera: str | None = None, *, size: int = 1) -> Stream[bytes]:
        """Preview images, JPEG."""
        return self._stream(topics.IMAGE, camera, size)

    def _stream(self, topic: topics.Topic, camera: str | None, size: int) -> Stream[Any]:
        key = topic.key(self.name, camera)
        decode = bytes if topic is topics.IMAGE else parse_object
        return Stream(self._session, topic, key, decode, size=size, max_age_s=topic.max_age_s)


@asynccontextmanager
async def connect(
    endpoint: str = "tcp/127.0.0.1:7447", vehicle: str | None = None, *, config_file: str | None = None
) -> AsyncIterator[Drone]:
    """Connect to the service at a zenoh endpoint, or through its router.

    Args:
        endpoint: `zenoh.listen` of the service, or its router.
        vehicle: `vehicle.name` of the service; None: the only one there.
        config_file: zenoh's configuration file, for TLS.

    Raises:
        NoAnswerError: no service there. ValueError: several vehicles, and no name was given.
        BusError: the file cannot be used.

    >>> from companion import connect
    >>> async def main() -> None:
    ...     async with connect("tcp/127.0.0.1:7447") as drone:
    ...         await drone.takeoff(3)
    ...         async for frame in drone.detections():
    ...             print([found["class_name"] for found in frame["detections"]])
    """
    settings = client_settings(ZenohSection(config_file=config_file), (endpoint,))
    opened = open_client(settings)
    session = await asyncio.to_thread(opened.__enter__)
    try:
        if vehicle is None:
            vehicle = await asyncio.to_thread(_only_vehicle, session, endpoint)
        yield Drone(session, vehicle)
    finally:
        await asyncio.to_thread(opened.__exit__, None, None, None)


def _only_vehicle(session: zenoh.Session, endpoint: str) -> str:
    until_s = time.monotonic() + _DISCOVERY_S
    while (name := only_vehicle(session)) is None:
        if time.monotonic() > until_s:
            raise NoAnswerError(f"no service at {endpoint}: is `companion run` running?")
        time.sleep(0.05)
    return name
