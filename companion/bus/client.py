"""The other side of the bus, for the command line and for tests: send a command, listen to topics."""

from __future__ import annotations

import json
import queue
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import zenoh
from pydantic import ValidationError

from companion.bus.session import zenoh_config
from companion.bus.topics import ROOT, TOPICS, alive_key, command_key
from companion.settings import ZenohSection

_DISCOVERY_S = 2.0
# After the service has gone an answer of its may still be on its way.
_LAST_ANSWER_S = 0.3


class NoAnswerError(TimeoutError):
    """No service answered. The message is one line for a person."""


def client_settings(settings: ZenohSection, connect: tuple[str, ...] = ()) -> ZenohSection:
    """How to reach the service that has these settings: as a client of its router, or of itself.

    A client, as two peers of one router do not see each other (zenoh routes between peers only if told to).

    Raises:
        NoAnswerError: there is no endpoint, or what is given is none.
    """
    endpoints = connect or settings.connect or settings.listen
    try:
        return ZenohSection(
            mode="client",
            connect=tuple(endpoint.replace("0.0.0.0", "127.0.0.1") for endpoint in endpoints),
            listen=(),
            multicast_scouting=settings.multicast_scouting,
        )
    except ValidationError as error:
        where = ", ".join(endpoints) or "no address"
        raise NoAnswerError(
            f"cannot look for the service at {where}: give --connect an endpoint such as tcp/127.0.0.1:7447"
        ) from error


@contextmanager
def open_client(settings: ZenohSection, *, timeout_s: float = 2.0) -> Iterator[zenoh.Session]:
    """A session connected to somebody.

    Raises:
        NoAnswerError: nobody was there within `timeout_s`.
    """
    session = _open(settings, time.monotonic() + timeout_s)
    try:
        yield session
    finally:
        session.close()  # type: ignore[no-untyped-call]


def _open(settings: ZenohSection, deadline: float) -> zenoh.Session:
    while True:
        try:
            return zenoh.open(zenoh_config(settings))
        except zenoh.ZError as error:
            if time.monotonic() > deadline:
                where = ", ".join(settings.connect) or "the local network"
                raise NoAnswerError(
                    f"no zenoh node answers at {where}: is `companion run` running? "
                    "(--connect names another place)"
                ) from error
        time.sleep(0.1)


def send_command(
    session: zenoh.Session, vehicle: str, text: str, *, timeout_s: float = 120.0
) -> dict[str, Any]:
    """Send one command and wait for its outcome: {"success": bool, "reason": str, ...}.

    Raises:
        NoAnswerError: no service for this vehicle, it has gone meanwhile, or it did not end in `timeout_s`.
    """
    heard: queue.SimpleQueue[zenoh.Sample | zenoh.Reply | None] = queue.SimpleQueue()
    # The service's own token tells that it is there (just after connecting it may still be on its way), and
    # that it has gone: a query to a service that was killed is pending until its time is over.
    watching = session.liveliness().declare_subscriber(alive_key(vehicle), heard.put, history=True)
    try:
        try:
            while not _is(heard.get(timeout=_DISCOVERY_S), zenoh.SampleKind.PUT):
                pass
        except queue.Empty:
            raise NoAnswerError(
                f"no service for vehicle {vehicle!r} here: is that its vehicle.name? "
                "`companion echo status` shows who is there"
            ) from None
        # Sent once: a command that was heard and not answered may be flying.
        over_s = time.monotonic() + timeout_s
        replies = zenoh.handlers.Callback(heard.put, lambda: heard.put(None))
        session.get(command_key(vehicle), replies, payload=text, timeout=timeout_s)
        return _answer(heard, vehicle, text, timeout_s, over_s)
    finally:
        watching.undeclare()  # type: ignore[no-untyped-call]


def _answer(
    heard: queue.SimpleQueue[zenoh.Sample | zenoh.Reply | None],
    vehicle: str,
    text: str,
    timeout_s: float,
    over_s: float,
) -> dict[str, Any]:
    """The first answer to a query. None in the queue: no more will come. `over_s`: when the query ends."""
    wait_s = timeout_s + _LAST_ANSWER_S
    while True:
        try:
            news = heard.get(timeout=wait_s)
        except queue.Empty:
            news = None
        if isinstance(news, zenoh.Reply) and news.ok is not None:
            answer: dict[str, Any] = json.loads(news.ok.payload.to_string())
            return answer
        if _is(news, zenoh.SampleKind.DELETE):
            wait_s = _LAST_ANSWER_S  # an answer may have left just before
        elif _is(news, zenoh.SampleKind.PUT):
            wait_s = timeout_s + _LAST_ANSWER_S  # the network was gone for a moment
        elif news is None and time.monotonic() >= over_s:
            raise NoAnswerError(
                f"{text!r}: no answer within {timeout_s:g} s; `companion echo status` tells what it does"
            )
        elif news is None:
            raise NoAnswerError(
                f"{text!r}: the service of vehicle {vehicle!r} has gone before it answered: it was ended or "
                "killed, or the network to it broke. The vehicle does what its autopilot is set to do; look "
                "at it, and at the service's log"
            )


def _is(news: zenoh.Sample | zenoh.Reply | None, kind: zenoh.SampleKind) -> bool:
    return isinstance(news, zenoh.Sample) and news.kind == kind


def check_topic(key: str) -> None:
    """Raises ValueError for a single word that is no topic: nothing would ever come."""
    names = [topic.name for topic in TOPICS]
    if not set("/*") & set(key) and key not in names:
        raise ValueError(
            f"no topic {key!r}: expected one of {', '.join(names)}, or a zenoh key with / or wildcards"
        )


def listen(
    session: zenoh.Session, key: str, on_message: Callable[[str, str], None]
) -> zenoh.Subscriber[None]:
    """Call back, on a thread of zenoh's, with (key, text) of every message on `key` (wildcards allowed).

    Of what is no text, such as a picture, the text is what it is: its encoding, its length, its attachment.
    """
    full = key if key.startswith(f"{ROOT}/") else f"{ROOT}/*/{key}"

    def receive(sample: zenoh.Sample) -> None:
        on_message(str(sample.key_expr), _text_of(sample))

    return session.declare_subscriber(full, receive)


def _text_of(sample: zenoh.Sample) -> str:
    if sample.encoding != zenoh.Encoding.IMAGE_JPEG:
        return sample.payload.to_string()
    attachment = "" if sample.attachment is None else f" {sample.attachment.to_string()}"
    return f"<{sample.encoding}, {len(sample.payload)} bytes>{attachment}"
