"""Every way out of the program removes the secrets of addresses."""

from __future__ import annotations

import http.server
import json
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from companion.bus.config import BusError
from companion.bus.session import encode
from companion.host.journal import log_to_standard_error
from companion.language.endpoints import LanguageError
from companion.perception.messages import LogLine, ResultLogHandler
from companion.service.event import EventLog
from companion.service.queries import without_secrets
from companion.settings.reading import ConfigurationError, load_settings
from tests.companion.command_line import companion, companion_here
from vision.sources.capture import CaptureError
from vision.sources.source import SourceError, SourceUnavailableError

SECRET = "hunter2"
ADDRESSES = [
    f"http://127.0.0.1:9/v.mjpg?user=admin&password={SECRET}",
    f"rtsp://127.0.0.1/user=admin_password={SECRET}_channel=1.sdp",
    f"rtsp://admin:p#{SECRET}@127.0.0.1/x",
    f"rtsp://admin:p/{SECRET}@127.0.0.1/x",
    f"rtsp://admin:{SECRET}@127.0.0.1/x",
    f"tcp/me:{SECRET}@127.0.0.1:7447",
]


def event_text(text: str) -> str:
    published: list[object] = []
    log = EventLog(published.append, None)
    log.add("error", text)
    return f"{published} {log.newest}"


def refused_setting(text: str) -> str:
    with pytest.raises(ConfigurationError) as refused:
        load_settings(os.devnull, {"source.width": text}, {})
    return f"{refused.value} {refused.value.problems}"


def worker_line(text: str) -> str:
    class Sender:
        line: object = None

        def put(self, line: LogLine) -> None:
            self.line = line

    sender = Sender()
    ResultLogHandler(sender).emit(  # type: ignore[arg-type]
        logging.LogRecord("vision", logging.WARNING, "", 0, "%s: lost", (text,), None)
    )
    return str(sender.line)


WAYS_OUT: dict[str, Callable[[str], str]] = {
    "event": event_text,
    "message": lambda text: encode({"problem": f"camera: {text}", "list": [text]}).decode(),
    "config reply": lambda text: json.dumps(without_secrets({"uri": text, "connect": [text]})),
    "setting": refused_setting,
    "worker": worker_line,
    "bus": lambda text: str(BusError(f"{text}: refused")),
    "language": lambda text: str(LanguageError(f"{text}: refused")),
    "source": lambda text: f"{SourceError(text)} {SourceUnavailableError(text)} {CaptureError(text)}",
}


@pytest.mark.parametrize("address", ADDRESSES)
@pytest.mark.parametrize("way", WAYS_OUT.values(), ids=WAYS_OUT.keys())
def test_a_way_out_shows_no_secret(way: Callable[[str], str], address: str) -> None:
    shown = way(address)
    assert "***" in shown
    assert SECRET not in shown


def test_log_lines_and_tracebacks_show_no_secret(capsys: pytest.CaptureFixture[str]) -> None:
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    root.handlers.clear()
    try:
        log_to_standard_error("INFO", "%(levelname)s %(message)s")
        for address in ADDRESSES:
            logging.getLogger("test").error("opening %s", address)
            try:
                raise ValueError(f"cannot open {address}")
            except ValueError:
                logging.getLogger("test").exception("failed")
    finally:
        root.handlers[:] = before
        root.setLevel(level)
    shown = capsys.readouterr().err
    assert shown.count("***") >= 2 * len(ADDRESSES)
    assert SECRET not in shown


@pytest.fixture
def refusing() -> Iterator[str]:
    """A server that answers every request with its path, and no video."""

    class Refusing(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(404, f"no {self.path}")

        def log_message(self, *_: object) -> None:
            """Nothing."""

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Refusing) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/v.mjpg?user=admin&password={SECRET}"
        server.shutdown()
        thread.join()


@pytest.mark.parametrize(
    "command",
    [
        ["detect", "--model", "none"],
        ["describe", "settings", "--source"],
        ["view", "--source"],
        ["describe", "settings", "--check", "--source"],
    ],
)
def test_commands_show_no_secret(
    refusing: str, command: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    ran = companion(*command, refusing, cwd=tmp_path)
    here = [companion_here(*command, address, cwd=tmp_path) for address in (refusing, *ADDRESSES[2:5])]
    of_libraries = capfd.readouterr()
    shown = [of_libraries.out + of_libraries.err, *(done.stdout + done.stderr for done in (ran, *here))]
    for text in shown:
        assert SECRET not in text
        assert "Traceback" not in text


def test_an_uncaught_exception_shows_no_secret() -> None:
    code = (
        "import logging; from companion.cli import commands\n"
        "def app():\n"
        f"    logging.getLogger('x').warning('lost: %s', {ADDRESSES[0]!r})\n"
        f"    raise RuntimeError({ADDRESSES[4]!r})\n"
        "commands.app = app; commands.main()"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode == 1
    assert "?user=admin&password=***" in ran.stderr
    assert "RuntimeError: rtsp://admin:***@127.0.0.1/x" in ran.stderr
    assert SECRET not in ran.stderr
