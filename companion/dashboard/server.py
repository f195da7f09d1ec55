"""The web server: the page, one stream of state, images on request, commands by POST.

Nothing is queued for a browser. The stream sends what is newest when the browser is ready for more, and a
image is sent when the browser asks for the next one. A connection whose data are not accepted for
`TCP_USER_TIMEOUT` is closed by the kernel.
"""

from __future__ import annotations

import asyncio
import json
import re
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import uvicorn
from pydantic import TypeAdapter, ValidationError
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from companion.bus.bodies.vehicle import VelocityBody
from companion.dashboard.access import COOKIE, Access, DashboardError, ErrorResponse, read_token
from companion.dashboard.bridge import Bridge, News
from companion.dashboard.chat import MAX_SENTENCE_CHARACTERS, Chats
from companion.dashboard.connections import connection_class, connection_of
from companion.dashboard.fleet import MAX_VEHICLES, Fleet
from companion.host.passing import AddressTakenError
from companion.host.tasks import spawn
from companion.settings import LanguageSection, ZenohSection

NICENESS = 5
"""Of the server's process: the loop that steers has priority."""
STREAM_PERIOD_S = 0.1
IMAGE_WAIT_S = 0.5
REPLY_WAIT_S = 1.0
"""How long a POST waits for the command's outcome; a later one is only in the stream."""
ALL = "*"
"""As the vehicle of a `stop`: all."""
LONGEST_COMMAND, LARGEST_BODY_BYTES = 8000, 64 * 1024
MAX_STREAMS_PER_BROWSER = 2
"""A browser opens 6 connections to one host. One window uses a stream and 2 for images, each of two windows
a stream and 1, so that a stop command has one at once."""
_UNACCEPTED_MS = 15_000
_SEND_BUFFER_BYTES = 256 * 1024
_VELOCITY = TypeAdapter(VelocityBody)
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
_SECURITY = {
    "cache-control": "no-store",
    "content-security-policy": "default-src 'self'; img-src data:; base-uri 'none'; frame-ancestors 'none'",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}


@dataclass(frozen=True, slots=True)
class DashboardOptions:
    """Options of a server.

    Attributes:
        listen: HOST:PORT. token_file: required beyond loopback.
        zenoh: settings of a client (`companion.bus.client.client_settings`).
        vehicle: name of the vehicle that is shown first.
        language, plugins: of the chat; modules.
        hosts: names of a proxy (`Access`).
    """

    listen: str
    token_file: str | None
    zenoh: ZenohSection
    vehicle: str
    language: LanguageSection = field(default_factory=LanguageSection)
    plugins: tuple[str, ...] = ()
    hosts: tuple[str, ...] = ()


class _Server(uvicorn.Server):
    """A server that leaves nothing in the event loop when it is cancelled.

    uvicorn would leave its listening socket in the loop's selector, and the next socket with the number of
    that one, of whatever kind, would never be read.
    """

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        try:
            await super().serve(sockets)
        finally:
            if self.started:
                for server in self.servers:
                    server.close()


async def serve(options: DashboardOptions, on_ready: Callable[[str], None], flag: str) -> None:
    """Serve until SIGINT or SIGTERM, or until cancelled.

    Args:
        on_ready: called with the page's address.
        flag: what sets the address, for errors.

    Raises:
        AddressTakenError: the address is in use or not available. DashboardError: the token is missing.
    """
    host, port = split_listen(options.listen)
    token = None if options.token_file is None else read_token(options.token_file)
    access = Access(host, token, hosts=options.hosts)
    with listening_socket(host, port, flag) as listener:
        fleet = Fleet(options.zenoh, options.vehicle)
        chats = Chats(fleet, options.language, options.plugins)
        server = http_server(create_app(fleet, chats, access))
        bridging = spawn(fleet.run(), "bridge to zenoh")
        bridging.add_done_callback(lambda _: setattr(server, "should_exit", True))
        loading = spawn(chats.load(), "loading of the chats")
        try:
            on_ready(f"http://{host}:{port}/")
            await server.serve(sockets=[listener])
            if bridging.done():
                bridging.result()  # raises why it ended
        finally:
            chats.end()
            bridging.cancel()
            loading.cancel()
            await asyncio.gather(bridging, loading, return_exceptions=True)


def http_server(application: ASGIApp) -> uvicorn.Server:
    """A server without a log of requests, whose connections are bounded."""
    return _Server(
        uvicorn.Config(
            application,
            http=connection_class(),
            ws="none",
            lifespan="off",
            access_log=False,
            log_config=None,  # its own would close the handlers of the whole process
            log_level="critical",
            server_header=False,
            timeout_graceful_shutdown=1,
        )
    )


def split_listen(listen: str, name: str = "dashboard.listen") -> tuple[str, int]:
    """Split HOST:PORT. `name`: of the setting, for errors. Raises DashboardError."""
    host, _, port = listen.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise DashboardError(f"{name} {listen}: expected HOST:PORT such as 127.0.0.1:8088")
    return host, int(port)


def listening_socket(host: str, port: int, flag: str) -> socket.socket:
    """Open the server's socket. `flag`: what sets its address, for errors. Raises AddressTakenError."""
    try:
        listener = socket.create_server((host, port))
    except OSError as error:
        raise AddressTakenError(
            f"cannot listen on {host}:{port}: {error.strerror or error}; {flag} sets another address"
        ) from error
    # Accepted connections inherit these.
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
    with suppress(AttributeError):  # not on Linux
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNACCEPTED_MS)
    return listener


def create_app(fleet: Fleet, chats: Chats, access: Access) -> ASGIApp:
    """Create the ASGI application."""
    folder = resources.files("companion.dashboard") / "page"
    files = {file.name: file.read_bytes() for file in folder.iterdir()}
    streams = StreamTable()

    async def page(request: Request) -> Response:
        response = Response(files["page.html"], media_type="text/html")
        if access.token is not None and "token" in request.query_params:
            # The page removes the token from the address; from here on the cookie is used.
            response.set_cookie(COOKIE, access.cookie, httponly=True, samesite="strict", max_age=30 * 86400)
        return response

    async def file(request: Request) -> Response:
        name = request.url.path.lstrip("/")
        return Response(files[name], media_type=_TYPES[Path(name).suffix])

    def bridge_of(vehicle: Any) -> Bridge | Response:
        """Return the bridge of the vehicle in a request, or an error."""
        if not isinstance(vehicle, str) or not re.fullmatch("([A-Za-z0-9][A-Za-z0-9_.-]{0,63})?", vehicle):
            return PlainTextResponse("vehicle: expected the name of a vehicle, or none for the first", 400)
        bridge = fleet.bridge(vehicle)
        return PlainTextResponse(f"at most {MAX_VEHICLES} vehicles", 429) if bridge is None else bridge

    async def events(request: Request) -> Response:
        bridge = bridge_of(request.query_params.get("vehicle", ""))
        if isinstance(bridge, Response):
            return bridge
        browser = (
            f"{request.client.host if request.client else ''} {request.query_params.get('browser', '')[:64]}"
        )
        window = request.query_params.get("window", "")[:64]
        return StreamingResponse(
            _stream(fleet, bridge, streams, browser, chats, window), media_type="text/event-stream"
        )

    async def image(request: Request) -> Response:
        try:
            after = int(request.query_params.get("after", "-1"))
        except ValueError:
            return PlainTextResponse("after: expected a number", 400)
        camera = request.query_params.get("camera", "")
        if not re.fullmatch("[A-Za-z0-9_-]{0,64}", camera):
            return PlainTextResponse("camera: expected the name of a camera, or none for the first", 400)
        bridge = bridge_of(request.query_params.get("vehicle", ""))
        if isinstance(bridge, Response):
            return bridge
        wait_s = 0.0 if request.query_params.get("wait") == "0" else IMAGE_WAIT_S
        found = await bridge.image(camera, after, wait_s)
        if found is None:
            return Response(status_code=204)
        return Response(found.jpeg, media_type="image/jpeg", headers={"x-frame": json.dumps(found.about)})

    async def read_body(request: Request) -> bytearray | Response:
        """Return a request's body, or an error."""
        body = bytearray()
        async for chunk in request.stream():
            body += chunk
            if len(body) > LARGEST_BODY_BYTES:
                return PlainTextResponse(f"at most {LARGEST_BODY_BYTES} bytes are accepted", 413)
        return body

    async def velocity(request: Request) -> Response:
        body = await read_body(request)
        if isinstance(body, Response):
            return body
        try:
            sent = json.loads(body)
            vehicle = sent.pop("vehicle", "")
            _VELOCITY.validate_python(sent, strict=True)
        except ValidationError as error:
            first = error.errors()[0]
            return PlainTextResponse(f"{'.'.join(map(str, first['loc']))}: {first['msg']}", 400)
        except (ValueError, AttributeError, TypeError, RecursionError):
            return PlainTextResponse("expected a JSON object", 400)
        bridge = bridge_of(vehicle)
        if isinstance(bridge, Response):
            return bridge
        if not fleet.steer(bridge.vehicle, sent):
            return PlainTextResponse(fleet.problem, 503)
        return Response(status_code=204)

    async def command(request: Request) -> Response:
        body = await read_body(request)
        if isinstance(body, Response):
            return body
        try:
            sent = json.loads(body)
            text, identifier = sent["text"], str(sent.get("id", ""))[:64]
            vehicle = sent.get("vehicle", "")
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return PlainTextResponse('expected JSON such as {"text": "takeoff 5", "id": "1"}', 400)
        if not isinstance(text, str) or not 0 < len(text) <= LONGEST_COMMAND:
            return PlainTextResponse(f"text: expected 1 to {LONGEST_COMMAND} characters", 400)
        if vehicle == ALL:
            if text.strip().lower() != "stop":
                return PlainTextResponse("only stop can be sent to all vehicles", 400)
            chats.end()
            return JSONResponse(await fleet.stop_all(identifier))
        bridge = bridge_of(vehicle)
        if isinstance(bridge, Response):
            return bridge
        if text.strip().lower() == "stop":
            chats.end(bridge.vehicle)  # first: they send nothing after the stop
        else:
            chats.end_plans(bridge.vehicle)
        outcome = fleet.command(bridge.vehicle, text, identifier)
        if outcome is None:
            return PlainTextResponse("too many commands are waiting for their outcome", 429)
        try:
            async with asyncio.timeout(REPLY_WAIT_S):
                return JSONResponse(await asyncio.shield(outcome))
        except TimeoutError:
            return JSONResponse({"id": identifier, "command": text[:200], "vehicle": bridge.vehicle}, 202)

    async def ask(request: Request) -> Response:
        body = await read_body(request)
        if isinstance(body, Response):
            return body
        try:
            sent = json.loads(body)
            window, text, plan = str(sent["window"])[:64], sent.get("text"), sent.get("plan")
            fly, vehicle = sent.get("fly"), sent.get("vehicle", "")
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return PlainTextResponse('expected JSON such as {"window": "1", "text": "what do you see?"}', 400)
        bridge = bridge_of(vehicle)
        if isinstance(bridge, Response):
            return bridge
        if isinstance(plan, int) and isinstance(fly, bool):
            waited = chats.answer_plan(window, bridge.vehicle, plan, fly=fly)
            return Response(status_code=204) if waited else PlainTextResponse("this plan has ended", 409)
        if not isinstance(text, str) or not 0 < len(text.strip()) <= MAX_SENTENCE_CHARACTERS:
            return PlainTextResponse(f"text: expected 1 to {MAX_SENTENCE_CHARACTERS} characters", 400)
        reason = await chats.ask(window, bridge.vehicle, text)
        return PlainTextResponse(reason, 429) if reason else Response(status_code=204)

    async def clock(_request: Request) -> Response:
        return JSONResponse({"now_ns": time.monotonic_ns()})

    routes = [
        Route("/", page),
        *(Route(f"/{name}", file) for name in files if name != "page.html"),
        Route("/events", events),
        Route("/image", image),
        Route("/clock", clock),
        Route("/command", command, methods=["POST"]),
        Route("/velocity", velocity, methods=["POST"]),
        Route("/ask", ask, methods=["POST"]),
    ]
    return Guard(Starlette(routes=routes), access)


class StreamTable:
    """The open streams of each browser, the oldest first; a new one ends the oldest of too many."""

    def __init__(self) -> None:
        self._open: dict[str, list[asyncio.Event]] = {}

    def add(self, browser: str) -> asyncio.Event:
        """Return an event that is set when the stream has to end."""
        streams = self._open.setdefault(browser, [])
        streams.append(ended := asyncio.Event())
        for old in streams[:-MAX_STREAMS_PER_BROWSER]:
            old.set()
        return ended

    def count(self, browser: str) -> int:
        """Return the number of a browser's streams that go on."""
        return sum(not ended.is_set() for ended in self._open[browser])

    def remove(self, browser: str, ended: asyncio.Event) -> None:
        """Forget a stream."""
        self._open[browser].remove(ended)
        if not self._open[browser]:
            del self._open[browser]


async def _stream(
    fleet: Fleet, bridge: Bridge, streams: StreamTable, browser: str, chats: Chats, window: str
) -> AsyncIterator[str]:
    """Yield server-sent events with what is new since the one before, at most ten a second."""
    ended = streams.add(browser)
    seen = answered = 0
    sent_chat: dict[str, Any] | None = None
    try:
        with fleet.watching(bridge), chats.watching(window, bridge.vehicle):
            yield "retry: 1000\n\n"
            while not ended.is_set():
                news = bridge.news(seen)
                seen = news.number
                answered, replies = fleet.replies(answered)
                chat = chats.state(window, bridge.vehicle)
                new_chat = chat if chat != sent_chat else None
                sent_chat = chat
                text = _text_of(fleet, bridge, news, replies, streams.count(browser), new_chat)
                yield f"data: {text}\n\n"
                with suppress(TimeoutError):
                    await asyncio.wait_for(ended.wait(), STREAM_PERIOD_S)
            yield "event: replaced\ndata: {}\n\n"
    finally:
        streams.remove(browser, ended)


def _text_of(
    fleet: Fleet,
    bridge: Bridge,
    news: News,
    replies: list[dict[str, Any]],
    windows: int,
    chat: dict[str, Any] | None,
) -> str:
    """Format what is new as JSON."""
    head = {
        "now_ns": time.monotonic_ns(),
        "vehicle_name": bridge.vehicle,
        "problem": fleet.problem,
        "alive": bridge.alive,
        "ages_s": news.ages_s,
        "events": news.events,
        "command_states": news.command_states,
        "replies": replies,
        "windows": windows,
        "chat": chat,
        "vehicles": (vehicles := fleet.vehicles(bridge)),
        "objects": fleet.objects(bridge) if len(vehicles) > 1 else [],
    }
    topics = ", ".join(f"{json.dumps(path)}: {text}" for path, text in news.topics.items())
    return f'{json.dumps(head)[:-1]}, "topics": {{{topics}}}}}'


class Guard:
    """Applies the access rules to every request, and adds the security headers to every response."""

    def __init__(self, application: ASGIApp, access: Access) -> None:
        self._application, self._access = application, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        error = self._check(Request(scope))

        async def send_secured(message: Message) -> None:
            if message["type"] == "http.response.start":
                extra = [(name.encode(), value.encode()) for name, value in _SECURITY.items()]
                message = {**message, "headers": [*message.get("headers", []), *extra]}
            await send(message)

        if error is not None:
            await PlainTextResponse(f"{error.text}\n", error.status)(scope, receive, send_secured)
            return
        connection = connection_of(scope)
        if not connection.table.admit(connection, short=scope["method"] == "POST"):
            answer = PlainTextResponse("too many requests are being answered: close other windows\n", 503)
            await answer(scope, receive, send_secured)
            return
        try:
            await self._application(scope, receive, send_secured)
        finally:
            connection.table.end(connection)

    def _check(self, request: Request) -> ErrorResponse | None:
        headers = _joined(request.headers)
        path = request.url.path
        if (error := self._access.check(request.method, path, headers)) is not None:
            return error
        given = request.query_params.get("token") if path == "/" else None
        if given is not None and self._access.token is not None:
            return None if self._access.token_is(given) else ErrorResponse(401, "wrong token")
        if self._access.admits(headers):
            return None
        once = "open /?token=… once, or " if self._access.page else ""
        return ErrorResponse(401, f"a token is needed: {once}send it as Authorization: Bearer …")


def _joined(headers: Headers) -> dict[str, str]:
    """Return name → value; a header that was sent twice has both values, and then matches no rule."""
    names: dict[str, Any] = {name: ", ".join(headers.getlist(name)) for name in headers}
    return names
