"""The worker's side of the sockets: a slow, silent or lost service."""

from __future__ import annotations

import asyncio
import logging
import os
import re
import select
import shutil
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from companion.perception.messages import (
    Attitude,
    Begin,
    Ended,
    Heartbeat,
    Hud,
    LogLine,
    Message,
    ProtocolError,
    Report,
    ResultLogHandler,
    ResultSender,
    StartFailed,
    packed,
    read_message,
    receive,
)
from companion.perception.process import (
    FIRST_RESULT_S,
    LONGEST_S,
    SHORTEST_S,
    START_S,
    PerceptionProcess,
    Watchdog,
    log_printed,
)
from companion.perception.worker import ControlChannel, _heartbeat_while_loading, _work
from companion.settings.reading import load_settings
from vision.detections import Detections
from vision.object_detector import DETECTORS, ObjectDetector
from vision.pipeline import PerceptionResult

pytestmark = pytest.mark.realtime


def report(sequence: int) -> Report:
    empty = Detections.empty(("car",))
    return Report(PerceptionResult(sequence, 0, 0, 64, 48, empty, {}, 0), frames=sequence + 1, replaced=0)


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, theirs = socket.socketpair()
    for end in (ours, theirs):
        end.settimeout(30)
    with ours, theirs:
        yield ours, theirs


def everything(connection: socket.socket) -> list[Message]:
    messages = []
    while (message := receive(connection)) is not None:
        messages.append(message)
        if isinstance(message, Ended):
            break
    return messages


def test_slow_service_gets_the_newest_result(
    ends: tuple[socket.socket, socket.socket],
) -> None:
    service, worker = ends
    sender = ResultSender(worker, on_lost=lambda: None)
    count = 5000  # far more than the socket holds
    for sequence in range(count):
        sender.put_newest(report(sequence))
    closing = threading.Thread(target=sender.close, args=(Ended(True, "done", count), 30.0))
    closing.start()
    reports = [message for message in everything(service) if isinstance(message, Report)]
    closing.join()
    assert reports[-1].result.sequence == count - 1
    assert reports[-1].replaced == count - len(reports)
    assert reports[-1].replaced > 0
    sequences = [message.result.sequence for message in reports]
    assert sequences == sorted(set(sequences))


def test_result_is_sent_at_once(ends: tuple[socket.socket, socket.socket]) -> None:
    service, worker = ends
    sender = ResultSender(worker, on_lost=lambda: None)
    service.setblocking(False)
    for sequence in range(100):
        sender.put_newest(report(sequence))
        message = receive(service)  # BlockingIOError if nothing was sent
        assert isinstance(message, Report)
        assert (message.result.sequence, message.replaced) == (sequence, 0)
    sender.close(Ended(True, "done", 100), 30.0)


def test_partially_sent_message_is_completed_in_order(
    ends: tuple[socket.socket, socket.socket],
) -> None:
    service, worker = ends
    sender = ResultSender(worker, on_lost=lambda: None)
    names = tuple(f"{number:01000}" for number in range(2000))
    large = Report(PerceptionResult(1, 0, 0, 64, 48, Detections.empty(names), {}, 0), 1, 0)
    sender.put_newest(large)
    sender.put(LogLine(logging.INFO, "vision", "behind it"))
    sender.put_newest(report(2))
    closing = threading.Thread(target=sender.close, args=(Ended(True, "done", 2), 30.0))
    closing.start()
    first, line, second, last = everything(service)
    closing.join()
    assert isinstance(first, Report)
    assert first.result.detections.class_names == names
    assert line == LogLine(logging.INFO, "vision", "behind it")
    assert isinstance(second, Report)
    assert second.result.sequence == 2
    assert last == Ended(True, "done", 2)


def test_heartbeat_never_replaces_a_result(ends: tuple[socket.socket, socket.socket]) -> None:
    service, worker = ends
    sender = ResultSender(worker, on_lost=lambda: None)
    for _ in range(2000):
        sender.put_newest(report(0))
        sender.put_newest(Heartbeat(0))
    sender.put_newest(report(7))
    sender.put_newest(Heartbeat(9))
    closing = threading.Thread(target=sender.close, args=(Ended(True, "done", 0), 30.0))
    closing.start()
    reports = [message for message in everything(service) if isinstance(message, Report)]
    closing.join()
    assert reports[-1].result.sequence == 7


def test_end_is_last_and_lines_keep_their_order(
    ends: tuple[socket.socket, socket.socket], capfd: pytest.CaptureFixture[str]
) -> None:
    service, worker = ends
    sender = ResultSender(worker, on_lost=lambda: None)
    log = logging.Logger("vision.test")
    log.addHandler(ResultLogHandler(sender))
    log.warning("lost %s\nagain", "street.mp4")
    log.info("second")
    log.error("a fault", exc_info=ValueError("fault 7"))
    sender.put_newest(report(3))
    sender.close(Ended(False, "broken", 4), 30.0)
    first, second, third, *_, last = everything(service)
    assert first == LogLine(logging.WARNING, "vision.test", "lost street.mp4 again")
    assert second == LogLine(logging.INFO, "vision.test", "second")
    assert third == LogLine(logging.ERROR, "vision.test", "a fault")
    assert last == Ended(False, "broken", 4)
    assert capfd.readouterr().err == "ValueError: fault 7\n"  # the traceback is not sent to the service


def test_lost_service_is_detected(ends: tuple[socket.socket, socket.socket]) -> None:
    service, worker = ends
    gone = threading.Event()
    sender = ResultSender(worker, on_lost=gone.set)
    service.close()
    sender.put_newest(report(0))
    assert gone.wait(30)
    sender.close(Ended(True, "done", 0), 30.0)


def test_signal_during_stop_is_harmless(
    ends: tuple[socket.socket, socket.socket],
) -> None:
    service, worker = ends
    control = ControlChannel(worker)

    def signalled(*_: object) -> Any:
        """Called at every line: a second signal may interrupt the handler of the first."""
        control.stop()
        return signalled

    tracing = sys.gettrace()
    sys.settrace(signalled)
    try:
        control.stop()
    finally:
        sys.settrace(tracing)
        control.finished()
    assert control.stopping
    service.close()
    for thread in threading.enumerate():
        if thread.name == "control":
            thread.join(30)


def test_large_messages_are_received_in_pieces(ends: tuple[socket.socket, socket.socket]) -> None:
    service, worker = ends
    message = Hud(("x" * 300_000,), None)
    sending = threading.Thread(target=worker.sendall, args=(packed(message) * 2,))
    sending.start()
    assert receive(service) == message
    assert receive(service) == message
    sending.join()


def test_invalid_message_is_refused(ends: tuple[socket.socket, socket.socket]) -> None:
    service, worker = ends
    worker.sendall(struct.pack(">I", 1 << 31))
    with pytest.raises(ProtocolError, match="2147483648 bytes"):
        receive(service)


async def test_end_of_stream_within_a_message() -> None:
    reader = asyncio.StreamReader()
    reader.feed_data(packed(Hud(("a",), "car"))[:-1])
    reader.feed_eof()
    assert await read_message(reader) is None


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        ({"source.uri": "/nowhere/street.mp4"}, r"/nowhere/street\.mp4: "),
        ({"detector.model": "/nowhere/m.pt"}, r"/nowhere/m\.pt: "),
        ({"detector.kind": "rad"}, "unknown kind 'rad'"),
        ({"detector.classes": "persn"}, "'persn'.*person"),
        ({"plugins.modules": "no_such_module"}, "'no_such_module'"),
        ({"recording.video": "/dev/null/v.webm"}, r"/dev/null/v\.webm: "),
    ],
)
def test_failure_of_a_start_is_one_line(
    overrides: dict[str, str], named: str, exported_model: Path, image_folder: Path
) -> None:
    values = {"source.uri": str(image_folder), "detector.runtime": "onnxruntime", "detector.image_size": "64"}
    settings = load_settings(os.devnull, {**values, "detector.model": str(exported_model), **overrides}, {})
    control = Mock(stopping=True)  # a start that does not fail ends at once
    failed = _work(Begin(settings), control, Mock())
    assert isinstance(failed, StartFailed)
    assert re.search(named, failed.text)
    assert "\n" not in failed.text


@pytest.mark.parametrize(
    ("error", "wrong"),
    [
        (ValueError("no such weights"), True),
        (KeyError("weights"), False),
        (ZeroDivisionError("of a plug-in"), False),
        (MemoryError(), False),
        (RuntimeError("two\nlines"), False),
    ],
)
def test_only_a_wrong_setting_of_a_plug_in_ends_the_service(
    error: Exception, wrong: bool, image_folder: Path
) -> None:
    def fail(_settings: object) -> ObjectDetector:
        raise error

    DETECTORS.add("odd", "raises", fail)
    try:
        values = {"source.uri": str(image_folder), "detector.kind": "odd"}
        failed = _work(Begin(load_settings(os.devnull, values, {})), Mock(stopping=True), Mock())
    finally:
        DETECTORS.remove("odd")
    assert isinstance(failed, StartFailed)
    assert failed.wrong_settings is wrong
    assert failed.text
    assert "\n" not in failed.text


def test_worker_without_a_service_exits() -> None:
    ours, theirs = socket.socketpair()
    with theirs:
        # The process id is not that of its parent, as if the service had died in between.
        end = str(theirs.fileno())
        arguments = [sys.executable, "-m", "companion.perception.worker", end, end, "-1"]
        process = subprocess.run(arguments, pass_fds=[theirs.fileno()], timeout=60, check=False)
    ours.close()
    assert process.returncode == 1


@pytest.fixture
def few_images(image_folder: Path, tmp_path: Path) -> Path:
    """Few enough that all their results fit into the unread socket."""
    for image in sorted(image_folder.iterdir())[:3]:
        shutil.copy(image, tmp_path)
    return tmp_path


async def test_last_message_is_read_after_failed_writes(
    few_images: Path,
) -> None:
    overrides = {"source.uri": str(few_images), "source.every_frame": "true", "detector.enabled": "false"}
    settings = load_settings(Path(os.devnull), overrides, environment={})
    process = await PerceptionProcess.spawn(settings, subprocess.DEVNULL)
    # Nothing is read until it has ended, as when the service's own loop is blocked.
    ended = os.pidfd_open(process.pid)
    assert select.select([ended], [], [], 60.0)[0]
    os.close(ended)
    for count in range(3):
        process.send_attitude(Attitude(count, (1.0, 0.0, 0.0, 0.0)))
    messages = []
    while (message := await process.read()) is not None:
        messages.append(message)
    last = messages[-1]
    assert isinstance(last, Ended)
    assert (last.finished, last.frames) == (True, 3)
    assert last.text.endswith("of stream")
    assert "code 0" in await process.wait()


def test_printed_lines_are_logged_with_a_limit(caplog: pytest.LogCaptureFixture) -> None:
    reading, writing = os.pipe()
    logging_it = threading.Thread(target=log_printed, args=(reading, 7))
    logging_it.start()
    with open(writing, "wb") as pipe:
        pipe.writelines(b"%d %s\n" % (number, b"x" * 5000) for number in range(20_000))
        pipe.write(b"no end")
    logging_it.join(30.0)
    assert not logging_it.is_alive()
    lines = [record.getMessage() for record in caplog.records]
    assert lines[0].startswith("0 xxx")
    assert lines[-1] == "no end"
    assert 100 <= len(lines) < 5000
    assert max(map(len, lines)) == 1000


def test_loading_worker_has_a_longer_limit() -> None:
    watchdog = Watchdog(100.0, open_timeout_s=10.0)
    assert watchdog.stuck_after_s == START_S + 10.0
    watchdog.on_message(105.0)
    watchdog.ready()
    assert watchdog.stuck_after_s == FIRST_RESULT_S
    assert watchdog.silent_s(107.5) == 2.5


@pytest.mark.parametrize(
    ("values", "sends"),
    [
        ({}, False),
        ({"detector.model": "any.onnx"}, True),
        ({"detector.model": "openvino_folder"}, True),
        ({"detector.model": "any.onnx", "detector.runtime": "torch"}, False),
        ({"detector.runtime": "auto"}, True),
    ],
)
def test_heartbeats_while_a_model_loads_that_may_take_long(
    values: dict[str, str], sends: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "openvino_folder").mkdir()
    started = Mock()
    monkeypatch.setattr(threading, "Thread", started)
    settings = load_settings(Path(os.devnull), {"source.uri": "none", **values}, environment={})
    with _heartbeat_while_loading(settings, Mock()):
        assert started.called is sends


@pytest.mark.parametrize(
    ("step_s", "stuck_after_s"),
    [(0.02, SHORTEST_S), (0.15, SHORTEST_S), (0.25, 5.0), (1.0, 20.0), (4.0, LONGEST_S)],
)
def test_stuck_limit_follows_the_usual_step(step_s: float, stuck_after_s: float) -> None:
    watchdog = Watchdog(0.0, open_timeout_s=10.0)
    for count in range(1, 60):
        # Heartbeats between the results do not affect the usual step.
        for part in range(4):
            watchdog.on_message(count * 10.0 + part)
        watchdog.on_result(step_s)
    assert watchdog.stuck_after_s == pytest.approx(stuck_after_s)


def test_reset_restarts_the_silence() -> None:
    watchdog = Watchdog(0.0, open_timeout_s=10.0)
    watchdog.reset(50.0)
    assert watchdog.silent_s(51.0) == 1.0


@pytest.mark.parametrize(
    "modules", ["companion.perception.supervisor, companion.perception.worker", "companion.service"]
)
def test_service_and_worker_import_no_torch_yaml_or_http(modules: str) -> None:
    unwanted = {"torch", "yaml", "http.client", "urllib.request"}
    code = f"import {modules}, sys\nprint(sorted({unwanted} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
