"""A client of the bus, for the command line and tests: sends commands, subscribes to topics."""

from __future__ import annotations

import json
import logging
import queue
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import zenoh
from pydantic import ValidationError
from zenoh import ext

from companion.bus.command_order import CommandOrder, Turn
from companion.bus.config import read_config_file
from companion.bus.connection_fault import connection_fault
from companion.bus.session import zenoh_config
from companion.bus.topics import (
    IMAGE,
    INPUT_TOPICS,
    LARGEST_JSON_BYTES,
    ROOT,
    STATUS,
    TOPICS,
    Topic,
    alive_key,
    command_key,
    settings_key,
)
from companion.host.peer_data import PeerDataError, copy_payload, parse_object
from companion.settings import ZenohSection

_DISCOVERY_S = 2.0
# After the service has gone its last answer may still arrive.
_LAST_ANSWER_S = 0.3
# `status` comes once a second. A service without it this long does not answer.
SILENT_S = 4.0
# Of a command in the answer to it.
_LONGEST_SHOWN = 200

logger = logging.getLogger(__name__)


class NoAnswerError(TimeoutError):
    """No service answered. The message is one line."""


class RefusedError(NoAnswerError):
    """Something is there, and opens no session: TLS, a password, another program, a service that hangs."""


def client_settings(settings: ZenohSection, connect: tuple[str, ...] = ()) -> ZenohSection:
    """Return the client settings to reach the service with these settings: by its router, or directly.

    A client, since two peers of one router do not see each other (by default zenoh does not route between
    peers).

    Raises:
        NoAnswerError: there is no valid endpoint.
    """
    given = connect or settings.connect
    endpoints = given or settings.listen
    try:
        section = ZenohSection(
            mode="client",
            connect=tuple(endpoint.replace("0.0.0.0", "127.0.0.1") for endpoint in endpoints),
            listen=(),
            multicast_scouting=settings.multicast_scouting,
            config_file=settings.config_file,
        )
        # Endpoints that were not given may be replaced by those of the configuration file.
        explicit = {"mode"} | ({"connect"} if given else set())
        return ZenohSection.model_construct(explicit, **dict(section))
    except ValidationError as error:
        where = ", ".join(endpoints) or "no address"
        raise NoAnswerError(
            f"no valid endpoint ({where}): set --connect to an endpoint such as tcp/127.0.0.1:7447"
        ) from error


def settings_for_child(zenoh: ZenohSection) -> dict[str, Any]:
    """Return the settings of a client in a child process as JSON-able data.

    Raises:
        NoAnswerError: as `client_settings`.
        BusError: the file `child_config_file` cannot be read.
    """
    if zenoh.child_config_file is not None:
        read_config_file("child_config_file", zenoh.child_config_file)
    file = zenoh.child_config_file or zenoh.config_file
    client = client_settings(zenoh.model_copy(update={"config_file": file}))
    return {"values": client.model_dump(mode="json"), "given": sorted(client.model_fields_set)}


def settings_in_child(data: dict[str, Any]) -> ZenohSection:
    """Return the settings that `settings_for_child` gave; those not given may be in `zenoh.config_file`."""
    section = ZenohSection.model_validate_json(json.dumps(data["values"]))
    return ZenohSection.model_construct(set(data["given"]), **dict(section))


def no_node_text(where: str) -> str:
    """Return what is said where no service is reached at an endpoint."""
    return f"no zenoh node at {where}: is `companion run` or `companion play` running there?"


@contextmanager
def open_client(settings: ZenohSection, *, timeout_s: float = 2.0) -> Iterator[zenoh.Session]:
    """Open a session that is connected to at least one node.

    Raises:
        NoAnswerError: no node within `timeout_s`, or one that refuses (`connection_fault`).
    """
    session = _open(settings, time.monotonic() + timeout_s)
    try:
        yield session
    finally:
        with suppress(zenoh.ZError):  # the node does not answer: its process is stopped
            session.close()  # type: ignore[no-untyped-call]


def _open(settings: ZenohSection, deadline: float) -> zenoh.Session:
    while True:
        config = zenoh_config(settings)
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            if time.monotonic() > deadline:
                where = ", ".join(settings.connect) or "the local network"
                missing = f"{no_node_text(where)} (--connect selects another endpoint)"
                if (why := connection_fault(config)) is not None:
                    raise RefusedError(why) from error
                raise NoAnswerError(missing) from error
        time.sleep(0.1)


def alive_vehicles(session: zenoh.Session) -> list[str]:
    """Return the names of the vehicles whose service runs, as the node of this session knows them."""
    replies = session.liveliness().get(alive_key("*"), timeout=_DISCOVERY_S)
    return sorted(str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok is not None)


def only_vehicle(session: zenoh.Session) -> str | None:
    """Return the name of the only vehicle whose service runs; None: there is none.

    Raises:
        ValueError: there are several. The message lists them.
    """
    names = alive_vehicles(session)
    if len(names) > 1:
        raise ValueError(
            f"{len(names)} vehicles are alive: {', '.join(names)}; choose one with --vehicle-name NAME, in "
            "Python with vehicle=NAME"
        )
    return names[0] if names else None


def check_alive(session: zenoh.Session, vehicle: str) -> None:
    """Check that a vehicle's service runs. Its token may arrive shortly after connecting.

    Raises:
        NoAnswerError: there is none.
    """
    until_s = time.monotonic() + _DISCOVERY_S
    while vehicle not in alive_vehicles(session):
        if time.monotonic() > until_s:
            raise _no_service(vehicle)
        time.sleep(0.05)


def _no_service(vehicle: str) -> NoAnswerError:
    return NoAnswerError(
        f"no service for vehicle {vehicle!r}: check vehicle.name; `companion echo 'companion/*/status'` "
        "lists the services"
    )


class SettingsRefusedError(RuntimeError):
    """A service does not change its settings so. The message is one line."""


class LastStatus:
    """What a service has said last about its vehicle, for the time when it says nothing any more."""

    def __init__(self, session: zenoh.Session, vehicle: str) -> None:
        self._vehicle = vehicle
        self._newest: tuple[str, float] | None = None  # the sentence, and when it was received
        self._subscriber = subscribe_kept(session, STATUS.key(vehicle), self._on_status)

    @property
    def silent_s(self) -> float:
        """Time since the newest status; 0 before the first."""
        return 0.0 if self._newest is None else time.monotonic() - self._newest[1]

    def gone_text(self, before: str = "") -> str:
        """Return what a service that has gone leaves, and what to do. `before`: what it was to send."""
        early = f" before {before}" if before else ""
        return (
            f"the service of vehicle {self._vehicle!r} has gone{early}: it was stopped or killed, or the "
            f"network was lost. {self._vehicle_text()}"
        )

    def silent_text(self) -> str:
        """Return the same of a service that is there and silent."""
        return (
            f"the service of vehicle {self._vehicle!r} has been silent for {self.silent_s:.0f} s. "
            f"{self._vehicle_text()}"
        )

    def close(self) -> None:
        """End the subscription."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _vehicle_text(self) -> str:
        said = "What the vehicle does now is not known here"
        if self._newest is not None:
            said = f"By its last status, {self.silent_s:.0f} s ago: {self._newest[0]}"
        return (
            f"{said}. Be ready to take over with the remote control or a ground station. The service's log "
            "says more: journalctl -u companion"
        )

    def _on_status(self, sample: zenoh.Sample) -> None:
        """Runs on a zenoh thread. An older service's status lacks the sentence."""
        with suppress(PeerDataError, KeyError, TypeError):
            status = parse_object(copy_payload(sample.payload, STATUS.largest_bytes))
            self._newest = str(status["vehicle"]["without_service"]), time.monotonic()


def send_command(
    session: zenoh.Session,
    vehicle: str,
    text: str,
    *,
    timeout_s: float = 120.0,
    on_silent: Callable[[str], None] = logger.warning,
    turn: Turn | None = None,
) -> dict[str, Any]:
    """Send one command and wait for its result: {"success": bool, "reason": str, ...}.

    Args:
        on_silent: called once, with a sentence, if the service is there and silent meanwhile.
        turn: when it is sent, of a program that may send several at once: of its `CommandOrder`, taken in the
            order of the commands, not in the threads that call this. It ends once the command is sent or
            cannot be. A command that must not be sent any more, such as one before a `stop`, is answered here
            without success.

    Raises:
        NoAnswerError: no service for this vehicle, it has gone meanwhile, or no answer within `timeout_s`.
        PeerDataError: the answer cannot be used.
    """
    with CommandOrder().turn(vehicle, text) if turn is None else turn as own_turn:
        received: queue.SimpleQueue[zenoh.Sample | zenoh.Reply | None] = queue.SimpleQueue()
        status = LastStatus(session, vehicle)
        # The service's liveliness token shows whether it is there (it may arrive shortly after connecting),
        # and when it has gone: a query to a killed service stays pending until its timeout.
        watching = session.liveliness().declare_subscriber(alive_key(vehicle), received.put, history=True)
        try:
            try:
                while not _is(received.get(timeout=_DISCOVERY_S), zenoh.SampleKind.PUT):
                    pass
            except queue.Empty:
                raise _no_service(vehicle) from None
            if (not_sent := own_turn.wait()) is not None:
                first_line = text.strip().partition("\n")[0][:_LONGEST_SHOWN]
                return {"command": first_line, "state": "ended", "success": False, "reason": not_sent}
            # Sent once: a command without an answer may be in progress.
            deadline_s = time.monotonic() + timeout_s
            replies = zenoh.handlers.Callback(received.put, lambda: received.put(None))
            # The service limits the rate of each sender.
            sender = str(session.zid())
            session.get(command_key(vehicle), replies, payload=text, attachment=sender, timeout=timeout_s)
            own_turn.end()
            return _answer(received, vehicle, text, timeout_s, deadline_s, status, on_silent)
        finally:
            status.close()
            watching.undeclare()  # type: ignore[no-untyped-call]


def set_settings(
    session: zenoh.Session,
    vehicle: str,
    values: dict[str, Any] | None = None,
    *,
    timeout_s: float = 5.0,
    turn: Turn | None = None,
) -> dict[str, Any]:
    """Change settings of a running service, all or none; returns key → `LiveSettingBody` of all that can be.

    Args:
        values: key → value; None: change none. turn: as of `send_command`.

    Raises:
        SettingsRefusedError: by the service. NoAnswerError: no answer, or not sent. PeerDataError: it cannot
        be used.
    """
    payload = None if values is None else json.dumps(values)
    with CommandOrder().turn(vehicle, None) if turn is None else turn as own_turn:
        if (not_sent := own_turn.wait()) is not None:
            raise NoAnswerError(f"settings of vehicle {vehicle!r}: {not_sent}")
        replies = session.get(settings_key(vehicle), payload=payload, timeout=timeout_s)
    for reply in replies:
        if reply.ok is not None:
            return parse_object(copy_payload(reply.ok.payload, LARGEST_JSON_BYTES))
        if reply.err is not None:
            refused = parse_object(copy_payload(reply.err.payload, LARGEST_JSON_BYTES))
            raise SettingsRefusedError(str(refused.get("reason")))
    raise NoAnswerError(f"no settings of vehicle {vehicle!r} within {timeout_s:g} s: check vehicle.name")


def _answer(
    received: queue.SimpleQueue[zenoh.Sample | zenoh.Reply | None],
    vehicle: str,
    text: str,
    timeout_s: float,
    deadline_s: float,
    status: LastStatus,
    on_silent: Callable[[str], None],
) -> dict[str, Any]:
    """Return the first answer to a query. None in the queue: no more replies. `deadline_s`: of the query."""
    until_s = deadline_s + _LAST_ANSWER_S
    ended = gone = reported = False
    while True:
        now_s = time.monotonic()
        if not reported and not gone and status.silent_s > SILENT_S:
            reported = True
            on_silent(f"{text!r}: {status.silent_text()}")
        # Until the status may be silent, or, before the first one has come, it is looked again.
        look_s = until_s if reported else min(until_s, now_s + max(SILENT_S - status.silent_s, 0.0) + 0.1)
        try:
            item = received.get(timeout=max(look_s - now_s, 0.0))
        except queue.Empty:
            if time.monotonic() < until_s:
                continue
            item = None
        if isinstance(item, zenoh.Reply) and item.ok is not None:
            return _checked(parse_object(copy_payload(item.ok.payload, LARGEST_JSON_BYTES)), text)
        soon_s = time.monotonic() + _LAST_ANSWER_S
        if _is(item, zenoh.SampleKind.DELETE):
            until_s, gone = soon_s, True  # an answer may have been sent just before
        elif _is(item, zenoh.SampleKind.PUT):
            until_s, gone = deadline_s + _LAST_ANSWER_S, False  # the network was interrupted
        elif item is None and time.monotonic() >= deadline_s:
            raise NoAnswerError(
                f"{text!r}: no answer within {timeout_s:g} s; `companion echo status` shows its state"
            )
        elif item is None and not ended and not gone:
            until_s, ended = soon_s, True  # the token of a killed service may disappear just after
        elif item is None and not gone:
            raise NoAnswerError(
                f"{text!r}: refused: zenoh's access control may not allow this client to send commands "
                f"to vehicle {vehicle!r}"
            )
        elif item is None:
            raise NoAnswerError(f"{text!r}: {status.gone_text('its answer')}")


def _checked(reply: dict[str, Any], text: str) -> dict[str, Any]:
    """Return a reply with `success` and `reason`. Raises PeerDataError: another version's, without them."""
    for key, kind in (("success", bool), ("reason", str)):
        if not isinstance(reply.get(key), kind):
            raise PeerDataError(
                f"{text!r}: the service's answer cannot be used: expected {key}: {kind.__name__}, got "
                f"{reply.get(key)!r:.80}; are both programs of the same version?"
            )
    return reply


def _is(item: zenoh.Sample | zenoh.Reply | None, kind: zenoh.SampleKind) -> bool:
    return isinstance(item, zenoh.Sample) and item.kind == kind


def check_topic(key: str) -> None:
    """Raise ValueError for a single word that is not a topic: nothing would ever be received."""
    names = [topic.name for topic in (*TOPICS, *INPUT_TOPICS)]
    if not set("/*") & set(key) and key not in names:
        raise ValueError(
            f"unknown topic {key!r}: expected one of {', '.join(names)}, or a zenoh key with / or wildcards"
        )


def listen(
    session: zenoh.Session,
    key: str,
    on_message: Callable[[str, str], None],
    *,
    vehicle: str | None = None,
    history: bool = False,
) -> zenoh.Subscriber[None] | ext.AdvancedSubscriber[None]:
    """Call back, on a zenoh thread, with (key, text) of every message on `key` (wildcards allowed).

    For binary data such as images, the text has the encoding, the length and the attachment.

    Args:
        key: a topic, or a key with `companion/` in front, which names the vehicle itself.
        vehicle: whose topic; None: of every vehicle.
        history: begin with the messages that the service has kept (`Topic.cached`), and recover lost ones.
            The subscription ends when the returned object is dropped.
    """
    full = key if key.startswith(f"{ROOT}/") else f"{ROOT}/{vehicle or '*'}/{key}"

    def receive(sample: zenoh.Sample) -> None:
        on_message(str(sample.key_expr), _text_of(sample))

    return subscribe_kept(session, full, receive) if history else session.declare_subscriber(full, receive)


def subscribe_kept(
    session: zenoh.Session, key: str, receive: Callable[[zenoh.Sample], None]
) -> ext.AdvancedSubscriber[None]:
    """Subscribe to a key and begin with the kept messages; those lost on the way are fetched again."""
    return ext.declare_advanced_subscriber(
        session,
        key,
        receive,
        history=ext.HistoryConfig(detect_late_publishers=True),
        recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
    )


def message_of(sample: zenoh.Sample, topic: Topic) -> tuple[bytes, bytes | None]:
    """Return payload and attachment of a message. Raises PeerDataError: too large for its topic."""
    attachment = sample.attachment
    about = None if attachment is None else copy_payload(attachment, LARGEST_JSON_BYTES)
    return copy_payload(sample.payload, topic.largest_bytes), about


def image_of(sample: zenoh.Sample) -> tuple[bytes, dict[str, Any]]:
    """Return a preview image, JPEG, and its attachment. Raises PeerDataError: too large, or not valid."""
    jpeg, about = message_of(sample, IMAGE)
    if about is None:
        raise PeerDataError("an image without an attachment")
    return jpeg, parse_object(about)


def _text_of(sample: zenoh.Sample) -> str:
    """Return a text message, or what is known of one that is binary or too large for any topic of text."""
    size, attachment = len(sample.payload), sample.attachment
    binary = sample.encoding in (zenoh.Encoding.IMAGE_JPEG, zenoh.Encoding.APPLICATION_OCTET_STREAM)
    if not binary and size <= LARGEST_JSON_BYTES:
        return copy_payload(sample.payload, LARGEST_JSON_BYTES).decode(errors="replace")
    if attachment is None or len(attachment) > LARGEST_JSON_BYTES:
        return f"<{sample.encoding}, {size} bytes>"
    about = copy_payload(attachment, LARGEST_JSON_BYTES).decode(errors="replace")
    return f"<{sample.encoding}, {size} bytes> {about}"
