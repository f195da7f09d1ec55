"""The other side of the bus, for the command line and for tests: send a command, listen to topics."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import zenoh
from pydantic import ValidationError

from companion.bus.session import zenoh_config
from companion.bus.topics import ROOT, alive_key, command_key
from companion.settings import ZenohSection

_DISCOVERY_S = 3.0


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
def open_client(settings: ZenohSection, *, timeout_s: float = 5.0) -> Iterator[zenoh.Session]:
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
        NoAnswerError: no service for this vehicle, or it did not end in `timeout_s`.
    """
    _wait_for_service(session, vehicle)
    # Sent once: a command that was heard and not answered may be flying.
    for reply in session.get(command_key(vehicle), payload=text, timeout=timeout_s):
        if reply.ok is not None:
            answer: dict[str, Any] = json.loads(reply.ok.payload.to_string())
            return answer
    raise NoAnswerError(
        f"{text!r}: no answer within {timeout_s:g} s; `companion echo status` tells what it does"
    )


def _wait_for_service(session: zenoh.Session, vehicle: str) -> None:
    """Until the service's own token is seen: just after connecting it may still be on its way."""
    deadline = time.monotonic() + _DISCOVERY_S
    while not any(
        reply.ok is not None for reply in session.liveliness().get(alive_key(vehicle), timeout=1.0)
    ):
        if time.monotonic() > deadline:
            raise NoAnswerError(
                f"no service for vehicle {vehicle!r} here: is that its vehicle.name? "
                "`companion echo status` shows who is there"
            )
        time.sleep(0.05)


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
