"""The page behind nginx, with the block of docs/how-to/dashboard.md."""

from __future__ import annotations

import asyncio
import json
import os
import re
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import zenoh

from companion.bus.topics import VEHICLE, command_key
from mavlink_sim.testing import free_port
from tests.companion.dashboard.serving import POST, EventStream, request, serving
from tests.companion.dashboard.test_bridge import NAME, publishing
from tests.programs import NGINX

pytestmark = [pytest.mark.realtime, pytest.mark.needs("nginx")]

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "dashboard.md"
SITE = "drone.example.org"
TOKEN = "0123456789abcdef0123456789abcdef"
NOBODY = 65534
# What Debian's nginx.conf has around a block, in one folder.
AROUND = "daemon off; pid nginx.pid; events {{}} http {{ access_log off; {folders} include page.conf; }}"
FOLDERS = "".join(
    f"{kind}_temp_path {kind};" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
)


def replaced(text: str, old: str, new: str) -> str:
    assert text.count(old) == 1, old
    return text.replace(old, new)


@contextmanager
def proxied(page: int) -> Iterator[int]:
    """Run nginx before the page at a port; yields its own. The block differs in these two addresses alone."""
    (block,) = re.findall(r"^```nginx\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    port = free_port(socket.SOCK_STREAM)
    block = replaced(block, "listen 80;", f"listen 127.0.0.1:{port};")
    block = replaced(block, "http://127.0.0.1:8088;", f"http://127.0.0.1:{page};")
    # Root's folders of pytest are closed to others.
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "page.conf").write_text(block)
        Path(folder, "nginx.conf").write_text(AROUND.format(folders=FOLDERS))
        unprivileged: dict[str, Any] = {}
        if os.geteuid() == 0:
            os.chown(folder, NOBODY, NOBODY)
            unprivileged = {"user": NOBODY, "group": NOBODY, "extra_groups": ()}
        assert NGINX is not None
        command = [NGINX, "-p", folder, "-c", "nginx.conf", "-e", "stderr"]
        process = subprocess.Popen(command, **unprivileged)
        try:
            until_s = time.monotonic() + 20.0
            while time.monotonic() < until_s and process.poll() is None:
                with suppress(ConnectionRefusedError):
                    socket.create_connection(("127.0.0.1", port)).close()
                    break
                time.sleep(0.02)
            assert process.poll() is None, "nginx has ended"
            yield port
        finally:
            process.terminate()
            process.wait(20)


async def test_page_stream_and_command_through_nginx(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text(TOKEN)
    token.chmod(0o600)

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, json.dumps({"success": True, "reason": "holding"}))

    page = free_port(socket.SOCK_STREAM)
    with publishing() as (service, endpoint), proxied(page) as port:
        service.session.declare_queryable(command_key(NAME), answer)
        async with serving(endpoint, port=page, token_file=token, hosts=(SITE,)), asyncio.timeout(60):
            own = {"host": SITE}
            assert (await request(port, "GET", "/", own))[0] == 401
            status, headers, body = await request(port, "GET", f"/?token={TOKEN}", own)
            assert (status, b"<html" in body) == (200, True)
            own |= {"cookie": headers["set-cookie"].partition(";")[0]}
            assert (await request(port, "GET", "/page.js", own))[0] == 200

            stream = await EventStream.open(port, headers=own)
            seen: set[float] = set()
            while len(seen) < 3:
                service.publish(VEHICLE.key(NAME), {"altitude_m": float(len(seen))})
                news = await stream.next()
                assert news is not None
                if "vehicle" in news["topics"]:
                    seen.add(news["topics"]["vehicle"]["altitude_m"])
            stream.close()

            post = {**own, **POST, "origin": f"http://{SITE}", "sec-fetch-site": "same-origin"}
            status, _, body = await request(port, "POST", "/command", post, {"text": "hold"})
            assert (status, json.loads(body)["reason"]) == (200, "holding")
            for foreign in (
                {"host": "evil.example"},
                {"host": "evil.example", "origin": "http://evil.example"},
                {"origin": "http://evil.example"},
                {"origin": f"http://{SITE}.evil.example"},
                {"sec-fetch-site": "cross-site"},
            ):
                sent = {**post, **foreign}
                assert (await request(port, "POST", "/command", sent, {"text": "land"}))[0] == 403
                assert (await request(port, "GET", "/events", {**own, **foreign}))[0] == 403
