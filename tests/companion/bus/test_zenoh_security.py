"""TLS and access control with the files and commands of docs/how-to/zenoh-security.md."""

from __future__ import annotations

import asyncio
import json
import queue
import re
import socket
import subprocess
from pathlib import Path
from typing import Any

import pytest

from companion.bus import topics
from companion.bus.client import NoAnswerError, client_settings, listen, open_client, send_command
from companion.bus.session import Bus
from companion.dashboard.process import dashboard_process
from companion.service.factory import clients_of
from companion.settings import Settings, ZenohSection
from mavlink_sim.testing import free_port
from tests.companion.dashboard.serving import POST, EventStream, request

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.needs("openssl"),
]
PAGE = (Path(__file__).parents[3] / "docs" / "how-to" / "zenoh-security.md").read_text()


def make_certificates(folder: Path) -> None:
    """Run the commands of the page in a folder."""
    commands = re.findall(r"^```sh\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)[0]
    subprocess.run(["bash", "-ec", commands], check=True, capture_output=True, timeout=60, cwd=folder)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The files of the page, in the current folder."""
    monkeypatch.chdir(tmp_path)
    make_certificates(tmp_path)
    service, operator = re.findall(r"^```json5\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    Path("vehicle1.json5").write_text(service)
    Path("operator.json5").write_text(operator)
    Path("reader.json5").write_text(operator.replace("operator", "reader"))
    Path("nobody.json5").write_text('{transport: {link: {tls: {root_ca_certificate: "ca.pem"}}}}')
    return tmp_path


def client(name: str, endpoint: str) -> ZenohSection:
    return client_settings(ZenohSection(config_file=f"{name}.json5"), (endpoint,))


def answered(session: Any, path: str) -> list[bool]:
    return [reply.ok is not None for reply in session.get(f"companion/alpha/{path}", timeout=5.0)]


@pytest.mark.usefixtures("folder")
async def test_reader_sees_detections_but_may_not_command() -> None:
    endpoint = f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    executed: list[str] = []

    async def execute(text: str) -> dict[str, Any]:
        executed.append(text)
        return {"command": text, "success": True, "reason": ""}

    async def reply() -> dict[str, int]:
        return {"value": 1}

    bus = Bus(
        ZenohSection(listen=(endpoint,), config_file="vehicle1.json5"),
        "alpha",
        on_event=lambda *_: None,
        on_command=execute,
        queries={"status": reply, "config": reply},
    )
    await bus.start()
    bus.publish(topics.EVENTS, {"stamp_ns": 1, "level": "info", "text": "ready"})

    def use(name: str) -> tuple[str, dict[str, list[bool]], dict[str, Any] | str]:
        """One detection, the answers to queries, and the reply to a command or why there is none."""
        received: queue.SimpleQueue[str] = queue.SimpleQueue()
        with open_client(client(name, endpoint), timeout_s=5.0) as session:
            listen(session, "detections", lambda _, text: received.put(text))
            detection = received.get(timeout=20.0)
            kept: queue.SimpleQueue[str] = queue.SimpleQueue()
            events = listen(session, "events", lambda _, text: kept.put(text), history=True)
            assert json.loads(kept.get(timeout=20.0))["text"] == "ready"
            del events
            answers = {path: answered(session, path) for path in ("status", "config")}
            try:
                return detection, answers, send_command(session, "alpha", f"hold {name}", timeout_s=5.0)
            except NoAnswerError as error:
                return detection, answers, str(error)

    try:
        results = {}
        for name in ("operator", "reader"):
            using = asyncio.create_task(asyncio.to_thread(use, name))
            while not using.done():
                bus.publish(topics.DETECTIONS, {"detections": []})
                await asyncio.sleep(0.02)
            results[name] = await using
        with pytest.raises(NoAnswerError), open_client(client("nobody", endpoint), timeout_s=0.5):
            pass
    finally:
        await bus.close()
    detection, answers, answer = results["operator"]
    assert detection == '{"detections":[]}'
    assert answers == {"status": [True], "config": [True]}
    assert answer == {"command": "hold operator", "success": True, "reason": ""}
    detection, answers, answer = results["reader"]
    assert detection == '{"detections":[]}'
    assert answers == {"status": [True], "config": []}
    assert isinstance(answer, str)
    assert "access control" in answer
    assert executed == ["hold operator"]


@pytest.mark.parametrize(("name", "text"), [("missing.json5", None), ("bad.json5", "{ mode: ")])
async def test_unusable_file_of_the_children_is_named(tmp_path: Path, name: str, text: str | None) -> None:
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    settings = Settings.model_validate(
        {"zenoh": {"child_config_file": str(path)}, "recording": {"directory": str(tmp_path)}}
    )
    lines: list[str] = []
    async with (
        dashboard_process(settings, lines.append),
        clients_of(settings, lambda _level, line: lines.append(line), lambda *state: None),
    ):
        pass
    assert [line.partition(f" {path}: ")[0] for line in lines] == [
        "dashboard: zenoh.child_config_file",
        "recorder: zenoh.child_config_file",
    ]
    assert all(line.partition(f" {path}: ")[2] for line in lines)


@pytest.mark.usefixtures("folder")
async def test_dashboard_and_recorder_connect_with_the_childrens_file() -> None:
    endpoint, port = f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}", free_port(socket.SOCK_STREAM)
    files = {"config_file": "vehicle1.json5", "child_config_file": "operator.json5"}
    settings = Settings.model_validate(
        {
            "vehicle": {"name": "alpha"},
            "zenoh": {"listen": (endpoint,), **files},
            "dashboard": {"listen": f"127.0.0.1:{port}"},
            "recording": {"directory": "recordings"},
        }
    )

    async def execute(text: str) -> dict[str, Any]:
        return {"command": text, "success": True, "reason": "holding"}

    lines: asyncio.Queue[str] = asyncio.Queue()
    bus = Bus(settings.zenoh, "alpha", on_event=lambda *_: None, on_command=execute)
    await bus.start()
    try:
        async with (
            dashboard_process(settings, lines.put_nowait),
            clients_of(settings, lambda _level, line: lines.put_nowait(line), lambda *state: None),
            asyncio.timeout(60.0),
        ):
            begun = sorted([await lines.get(), await lines.get()])
            assert begun[0] == f"dashboard: http://127.0.0.1:{port}/"
            assert begun[1].startswith("recorder: recording to ")  # _ROUTINE of companion.service.factory
            stream = await EventStream.open(port)
            while (news := await stream.next()) is not None and news["alive"] is not True:
                pass
            stream.close()
            _, _, body = await request(port, "POST", "/command", POST, {"text": "hold"})
            assert json.loads(body)["reason"] == "holding"
    finally:
        await bus.close()
