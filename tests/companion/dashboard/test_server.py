"""The page's server, by real HTTP on loopback."""

from __future__ import annotations

import asyncio
import gc
import json
import socket
import tracemalloc
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
import zenoh

from companion import dashboard
from companion.bus.topics import DETECTIONS, VEHICLE, command_key
from companion.dashboard.access import COOKIE, DashboardError
from companion.dashboard.connections import MAX_ANSWERED
from companion.dashboard.server import LARGEST_BODY_BYTES, MAX_STREAMS_PER_BROWSER
from companion.host.passing import AddressTakenError
from tests.companion.dashboard.serving import POST, EventStream, request, serving
from tests.companion.dashboard.test_bridge import NAME, frame, publishing, until

pytestmark = pytest.mark.realtime

TOKEN = "0123456789abcdef0123456789abcdef"
KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
PAGE = {path.name: KINDS[path.suffix] for path in Path(dashboard.__file__).with_name("page").iterdir()}


async def test_page_and_its_files_have_security_headers() -> None:
    async with serving() as port:
        for path in ("/", *(f"/{name}" for name in PAGE if name != "page.html")):
            status, headers, body = await request(port, "GET", path)
            assert status == 200
            kind = PAGE[path.strip("/") or "page.html"]
            assert headers["content-type"].startswith(kind)
            assert "frame-ancestors 'none'" in headers["content-security-policy"]
            assert headers["cross-origin-resource-policy"] == "same-origin"
            assert b"http://" not in body
            assert b"https://" not in body  # nothing from elsewhere
        for path in ("/bridge.py", "/page.html"):
            assert (await request(port, "GET", path))[0] == 404


async def test_sockets_opened_after_a_server_has_ended_are_read() -> None:
    for _ in range(2):
        async with serving() as port:
            assert (await request(port, "GET", "/clock"))[0] == 200


async def test_requests_of_other_pages_are_refused() -> None:
    async with serving() as port:
        for path in ("/", "/events", "/image", "/clock", "/page.js"):
            for headers in ({"host": "evil.example"}, {"origin": "http://evil.example"}):
                assert (await request(port, "GET", path, headers))[0] == 403
        body = {"text": "land"}
        assert (await request(port, "POST", "/command", {"content-type": "text/plain"}, body))[0] == 403
        assert (await request(port, "POST", "/command", {**POST, "origin": "null"}, body))[0] == 403


async def test_token_opens_the_page_and_sets_a_cookie(tmp_path: Path) -> None:
    path = tmp_path / "token"
    path.write_text(TOKEN)
    path.chmod(0o600)
    async with serving(listen="0.0.0.0", token_file=path) as port:
        assert (await request(port, "GET", "/"))[0] == 401
        assert (await request(port, "GET", "/?token=wrong"))[0] == 401
        assert (await request(port, "GET", f"/clock?token={TOKEN}"))[0] == 401
        assert (await request(port, "GET", "/clock", {"authorization": f"Bearer {TOKEN}"}))[0] == 200
        status, headers, body = await request(port, "GET", f"/?token={TOKEN}")
        assert status == 200
        cookie = headers["set-cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=strict" in cookie
        assert TOKEN not in cookie
        assert TOKEN.encode() not in body
        value = cookie.partition(";")[0]
        assert value.startswith(f"{COOKIE}=")
        assert (await request(port, "GET", "/", {"cookie": value}))[0] == 200
        assert (await request(port, "POST", "/command", {"cookie": value}, {"text": "land"}))[0] == 403


async def test_address_in_use_or_open_without_token_is_refused() -> None:
    async with serving() as port:
        with pytest.raises(AddressTakenError) as refused:
            async with serving(port=port):
                raise AssertionError
        assert str(port) in str(refused.value)
    with pytest.raises(DashboardError, match="token_file"):
        async with serving(listen="0.0.0.0"):
            raise AssertionError


async def test_stream_sends_what_is_new() -> None:
    with publishing() as (service, endpoint):
        async with serving(endpoint) as port:
            stream = await EventStream.open(port)
            assert stream.response.headers["content-type"].startswith("text/event-stream")
            heights: list[float] = []
            service_seen = False
            for number in range(200):
                service.publish(VEHICLE.key(NAME), {"altitude_m": float(number)})
                news = await stream.next()
                assert news is not None
                assert news["vehicle_name"] == NAME
                service_seen = service_seen or news["alive"] is True
                if "vehicle" in news["topics"]:
                    heights.append(news["topics"]["vehicle"]["altitude_m"])
                if len(heights) > 5 and service_seen:
                    break
            assert service_seen
            assert heights == sorted(set(heights))
            quiet: Any = {"topics": {"vehicle": {}}}
            while "vehicle" in quiet["topics"]:
                quiet = await stream.next()
            assert quiet["ages_s"]["vehicle"] >= 0.0
            stream.close()


async def test_stream_says_that_no_service_answers() -> None:
    async with serving() as port:
        stream = await EventStream.open(port)
        news = await stream.next()
        while news is not None and "companion run" not in news["problem"]:
            news = await stream.next()
        assert news is not None
        assert news["topics"] == {}
        stream.close()
        status, _, body = await request(port, "POST", "/command", POST, {"text": "land", "id": "1"})
        assert status == 200
        assert json.loads(body)["success"] is False


async def test_too_many_windows_end_the_oldest_stream() -> None:
    async with serving() as port:
        streams = [await EventStream.open(port, "?browser=one") for _ in range(MAX_STREAMS_PER_BROWSER + 1)]
        other = await EventStream.open(port, "?browser=two")
        seen = [await streams[0].next()]
        while seen[-1] is not None:
            seen.append(await streams[0].next())
        assert seen[-2] == {}  # the event `replaced`
        for stream in (*streams[1:], other):
            news = await stream.next()
            assert news is not None
            assert news["windows"] == (1 if stream is other else MAX_STREAMS_PER_BROWSER)
        for stream in (*streams, other):
            stream.close()


async def test_command_and_its_late_outcome() -> None:
    with publishing() as (service, endpoint):
        queries: list[Any] = []
        service.session.declare_queryable(command_key(NAME), queries.append)
        async with serving(endpoint) as port:
            stream = await EventStream.open(port)
            while not (news := await stream.next()) or not news["alive"]:
                assert news is not None  # until the page's session is connected
            status, _, body = await request(
                port, "POST", "/command", POST, {"text": "approach track=17", "id": "page-1"}
            )
            assert status == 202
            assert json.loads(body) == {
                "id": "page-1",
                "command": "approach track=17",
                "vehicle": NAME,
            }
            query = (await until(lambda: queries))[0]
            assert query.payload.to_string() == "approach track=17"
            with query:
                query.reply(query.key_expr, json.dumps({"success": True, "reason": "reached"}))
            queries.clear()
            replies: list[Any] = []
            while not replies:
                news = await stream.next()
                assert news is not None
                replies = news["replies"]
            (reply,) = replies
            assert (reply["id"], reply["command"], reply["vehicle"]) == ("page-1", "approach track=17", NAME)
            assert (reply["success"], reply["reason"]) == (True, "reached")
            stream.close()


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b"", 400),
        (b"[]", 400),
        (b"[" * 50_000, 400),
        (b'{"text": 1}', 400),
        (b'{"text": ""}', 400),
        (b'{"text": "land", "vehicle": "*"}', 400),
        (b'{"text": "land", "vehicle": "a/*"}', 400),
        (b'{"text": "land", "vehicle": 1}', 400),
        (json.dumps({"text": "x" * 8001}).encode(), 400),
        (b" " * (LARGEST_BODY_BYTES + 1), 413),
    ],
)
async def test_bad_commands_are_refused(body: bytes, status: int) -> None:
    async with serving() as port:
        assert (await request(port, "POST", "/command", POST, body))[0] == status
        for query in ("after=x", "camera=*", "camera=a/b", "camera=%24%2A", "vehicle=*", "vehicle=a/b"):
            assert (await request(port, "GET", f"/image?{query}"))[0] == 400
        assert (await request(port, "GET", "/events?vehicle=a/b"))[0] == 400


async def test_velocity_reaches_the_vehicle_that_it_names() -> None:
    sent = {"source": "page-1", "stamp_ns": 5, "forward_mps": 1, "lifetime_s": 0.4}
    with publishing() as (service, endpoint):
        received: list[Any] = []
        service.session.declare_subscriber(
            "companion/*/velocity", lambda one: received.append((str(one.key_expr), one.payload.to_string()))
        )
        async with serving(endpoint) as port:

            async def post(body: Any) -> int:
                return (await request(port, "POST", "/velocity", POST, body))[0]

            async with asyncio.timeout(15.0):
                while not received:  # until the page's session is connected
                    assert await post(sent) in (204, 503)
            received.clear()
            assert await post({**sent, "vehicle": "beta"}) == 204
            key, text = await until(lambda: next((one for one in received if "beta" in one[0]), None))
            assert (key, json.loads(text)) == ("companion/beta/velocity", sent)
            wrongs: list[Any] = [{**sent, "lifetime_s": 0.6}, {"source": "a"}, [], {**sent, "vehicle": "a/*"}]
            for wrong in wrongs:
                assert await post(wrong) == 400
    async with serving() as port:
        assert (await request(port, "POST", "/velocity", POST, sent))[0] == 503


async def test_image_has_its_frame_in_a_header() -> None:
    with publishing() as (service, endpoint):
        async with serving(endpoint) as port:
            stream = await EventStream.open(port)
            await stream.next()
            assert (await request(port, "GET", "/image?camera="))[0] == 204
            boxes: list[Any] = []
            for sequence in range(3, 200):
                service.publish(DETECTIONS.key(NAME), frame(sequence))
                service.image(sequence, b"\xff\xd8jpeg")
                status, headers, body = await request(port, "GET", "/image?camera=&after=-1")
                boxes = json.loads(headers["x-frame"])["boxes"] if status == 200 else []
                if boxes:
                    break
            assert headers["content-type"] == "image/jpeg"
            assert body == b"\xff\xd8jpeg"
            assert json.loads(headers["x-frame"])["captured_ns"] == 5
            assert boxes[0][4:] == ["car", 0.9, 7, "confirmed"]
            stream.close()


async def test_browser_that_reads_nothing_costs_no_memory() -> None:
    with publishing() as (service, endpoint):
        async with serving(endpoint) as port:
            dead = socket.create_connection(("127.0.0.1", port))
            dead.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            dead.sendall(f"GET /events HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
            alive = await EventStream.open(port)
            large = {"text": "x" * 100_000}

            async def megabytes(count: int) -> None:
                for _ in range(count * 10):
                    service.publish(VEHICLE.key(NAME), large)
                    await alive.next()

            await megabytes(2)
            gc.collect()
            tracemalloc.start()
            before, _ = tracemalloc.get_traced_memory()
            await megabytes(3)
            gc.collect()
            after, _ = tracemalloc.get_traced_memory()
            tracemalloc.stop()
            assert after - before < 1_000_000  # 3 MB were sent to the other browser
            alive.close()
            dead.close()


HEAD = b"GET / HT"
BODY = b"POST /command HTTP/1.1\r\nHost: 127.0.0.1\r\nx-companion-dashboard: 1\r\nContent-Length: 40\r\n\r\n{"
WEBSOCKET = b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n"
IDLE = b"GET /clock HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
STREAM = b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
HELD = 200


@pytest.mark.parametrize("token", [False, True])
@pytest.mark.parametrize(
    "sent",
    [b"", HEAD, BODY, WEBSOCKET, IDLE, STREAM],
    ids=["silent", "head", "body", "websocket", "idle", "stream"],
)
async def test_stop_is_answered_while_others_hold_connections(
    tmp_path: Path, sent: bytes, token: bool
) -> None:
    path = tmp_path / "token"
    path.write_text(TOKEN)
    path.chmod(0o600)
    headers = {**POST, "authorization": f"Bearer {TOKEN}"}
    with publishing() as (service, endpoint), ExitStack() as held:

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(query.key_expr, json.dumps({"success": True, "reason": "stopped"}))

        service.session.declare_queryable(command_key(NAME), answer)
        async with serving(endpoint, token_file=path if token else None) as port:
            body = {"text": "stop", "id": "1"}
            while (await request(port, "POST", "/command", headers, body))[0] not in (200, 202):
                pass  # until the server has found the service
            for number in range(HELD):
                connection = held.enter_context(socket.create_connection(("127.0.0.1", port)))
                connection.sendall(sent)
                if number % 50 == 49:
                    assert (await request(port, "POST", "/command", headers, body))[0] in (200, 202)


async def test_request_that_does_not_end_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.dashboard.connections.REQUEST_S", 0.5)
    async with serving() as port:
        for sent in (b"", HEAD, BODY, IDLE + HEAD):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(sent)
            if sent.startswith(IDLE):
                await reader.readuntil(b"}")
            async with asyncio.timeout(20):
                with suppress(ConnectionError):
                    while True:  # one byte now and then does not extend it
                        writer.write(b"x" if sent else b"")
                        try:
                            async with asyncio.timeout(0.1):
                                if not await reader.read(100):
                                    break
                        except TimeoutError:
                            continue
            writer.close()


async def test_connections_without_token_end_no_stream_of_others(tmp_path: Path) -> None:
    path = tmp_path / "token"
    path.write_text(TOKEN)
    path.chmod(0o600)
    admitted = STREAM.replace(b"\r\n\r\n", f"\r\nAuthorization: Bearer {TOKEN}\r\n\r\n".encode())
    async with serving(token_file=path) as port:
        with ExitStack() as held:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(admitted)
            await reader.readuntil(b"data: ")
            for _ in range(HELD):
                held.enter_context(socket.create_connection(("127.0.0.1", port))).sendall(HEAD)
            for _ in range(3):
                await reader.readuntil(b"data: ")
            writer.close()


async def test_too_many_streams_are_refused_and_end() -> None:
    async with serving() as port:
        with ExitStack() as held:
            for number in range(MAX_ANSWERED):
                connection = held.enter_context(socket.create_connection(("127.0.0.1", port)))
                connection.sendall(STREAM.replace(b"/events", b"/events?browser=%d" % number))
                assert await asyncio.to_thread(connection.recv, 12) == b"HTTP/1.1 200"
            assert (await request(port, "GET", "/clock"))[0] == 503
        while (await request(port, "GET", "/clock"))[0] != 200:
            pass
