"""The service with its recorder: what is in the file, and what happens when either is killed."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from pymavlink import mavutil

from companion.logs.replay import replay
from companion.recording.files import RecordingReader
from mavlink_sim.testing import running_simulator
from tests.companion.recording.lockstep_recording import library_times
from tests.companion.service_process import TWICE, ServiceProcess, heartbeats, running_service

pytestmark = pytest.mark.realtime

LAYOUT = Path(__file__).parents[3] / "docs/foxglove-layout.json"


def wait_for(condition: Callable[[], object], timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def files(folder: Path) -> list[Path]:
    """The recordings whose writing has begun: a new file is empty for a moment."""
    return sorted(path for path in folder.glob("*.mcap") if path.stat().st_size)


def recorder_of(service: ServiceProcess) -> int:
    """The process id of the service's recorder."""
    listed = subprocess.run(
        ["ps", "--ppid", str(service.pid), "-o", "pid=,args="], capture_output=True, text=True, check=True
    )
    (line,) = (line for line in listed.stdout.splitlines() if "companion.recording" in line)
    return int(line.split()[0])


def messages_of(path: Path) -> Counter[str]:
    return Counter(message.channel.topic for message in RecordingReader(path).messages())


def steps_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(message.data) for message in RecordingReader(path).messages("guidance_input")]


def schema_errors(path: Path) -> list[str]:
    """What is wrong with the JSON messages of a file by the schemas in it."""
    validators: dict[bytes, jsonschema.Draft202012Validator] = {}
    found = []
    for channel, _, data in RecordingReader(path).messages():
        if channel.encoding == "json":
            if channel.schema not in validators:
                validators[channel.schema] = jsonschema.Draft202012Validator(json.loads(channel.schema))
            error = next(validators[channel.schema].iter_errors(json.loads(data)), None)
            found += [] if error is None else [f"{channel.topic}: {error.message}"]
    return found


def images(path: Path) -> int:
    return sum(1 for _ in RecordingReader(path).messages("/image"))


def layout_topics() -> set[str]:
    """The topics that the layout for Foxglove shows."""
    text = LAYOUT.read_text()
    plotted = re.findall(r'"value": "(\w+)\.', text)
    return {*re.findall(r'"(/\w+)"', text), *plotted}


def test_flight_is_recorded_and_replays(image_folder: Path, exported_model: Path, tmp_path: Path) -> None:
    """With lossless images: the model of the flight finds the same again, bit for bit."""
    folder = tmp_path / "recordings"
    flags = [
        *("--source", str(image_folder), "--source-loop", "true", "--source-rate-hz", "5"),
        *("--detector-model", str(exported_model), "--detector-runtime", "onnxruntime"),
        *("--detector-image-size", "160", "--detector-confidence", "0", "--detector-iou", "0.3"),
        *("--tracker-enabled", "false"),
        *("--recording-directory", str(folder), "--recording-content", "png"),
    ]
    with (
        running_simulator(**TWICE) as simulator,
        running_service(simulator.onboard_port, flags, cwd=tmp_path) as service,
    ):
        service.take_off(2.5)
        assert service.command("hold")["success"]
        assert not service.command("goto forward=900 right=0")["success"]
        # A busy machine takes longer for as many images.
        wait_for(lambda: [*map(images, files(folder))] > [10])
        assert service.stop() == 0
    (path,) = files(folder)
    reader = RecordingReader(path)
    found = Counter(message.channel.topic for message in reader.messages())
    assert reader.problems == []
    assert found["guidance_input"] == found["guidance_output"] > 50
    shown = layout_topics() - {"/path"}  # published while it goes around obstacles
    assert len(shown) == 7
    for topic in {"run", "events", "detections", "/tf"} | shown:
        assert found[topic], topic
    assert schema_errors(path) == []
    (note,) = [json.loads(message.data) for message in reader.messages("recorder")][-1:]
    assert (note["first_step"], note["lost_steps"], note["dropped_messages"]) == (0, 0, 0)

    result = replay([path], {})
    assert (result.first, result.inexact) == (None, [])
    assert result.steps == found["guidance_input"]
    again = replay([path], {}, str(exported_model)).detections
    assert again is not None
    assert (again.image_formats, again.same_model) == (["png"], True)
    assert again.images == again.identical_images > 8
    assert again.recorded == again.replayed > again.images
    sent = mavutil.mavlink.MAVLink(None)
    names = Counter(
        message.get_type()
        for recorded in reader.messages("mavlink_sent")
        for message in sent.parse_buffer(recorded.data) or ()
    )
    last = list(reader.messages("guidance_input"))[-1]
    assert (
        0 < names["SET_POSITION_TARGET_LOCAL_NED"] <= json.loads(last.data)["inputs"]["stream"]["sent_count"]
    )
    assert names["HEARTBEAT"]


def test_recorder_is_started_again_and_pauses_on_a_full_disk(filming: list[str], tmp_path: Path) -> None:
    """The limit of a file's size stands for a full disk: the same write fails, with EFBIG for ENOSPC."""
    folder = tmp_path / "recordings"
    with (
        running_simulator(**TWICE) as simulator,
        running_service(
            simulator.onboard_port, [*filming, "--recording-directory", str(folder)], cwd=tmp_path
        ) as service,
    ):
        wait_for(lambda: files(folder) and messages_of(files(folder)[0])["guidance_input"] > 20)
        recorder = recorder_of(service)
        # On a busy machine the recorder is late: kill it when it is not.
        wait_for(lambda: time.monotonic_ns() - steps_of(files(folder)[0])[-1]["now_ns"] < 1.5e9)
        os.kill(recorder, signal.SIGKILL)
        service.wait_for_line("restarting (")
        (first,) = files(folder)
        assert messages_of(first)["guidance_input"] > 20
        assert library_times(first) == [message.log_time_ns for message in RecordingReader(first).messages()]
        service.take_off(2.5)
        wait_for(lambda: len(files(folder)) == 2 and messages_of(files(folder)[1])["guidance_input"] > 100)
        recorder = recorder_of(service)
        _, hard = resource.prlimit(recorder, resource.RLIMIT_FSIZE)
        resource.prlimit(recorder, resource.RLIMIT_FSIZE, (files(folder)[1].stat().st_size, hard))
        line = service.wait_for_line("cannot be written")
        assert str(files(folder)[1]) in line
        assert service.command("hold")["success"]
        resource.prlimit(recorder, resource.RLIMIT_FSIZE, (hard, hard))
        wait_for(lambda: len(files(folder)) == 3 and messages_of(files(folder)[2])["guidance_input"] > 20)
        assert recorder_of(service) == recorder
        assert service.stop() == 0
    assert service.lines.count(line) == 1
    assert len([each for each in service.lines if "restarting (" in each]) == 1
    before, after = map(steps_of, files(folder)[:2])
    # Only the last chunk, of a second, is missing: the steps wait for the new recorder.
    assert after[0]["now_ns"] - before[-1]["now_ns"] < 2e9
    assert [each["step"] for each in after] == list(range(after[0]["step"], after[-1]["step"] + 1))
    second = files(folder)[1]
    reader = RecordingReader(second)
    assert len(list(reader.messages())) > 100
    assert len(reader.problems) == 1  # it has no end
    assert replay([second], {}).inexact  # it does not begin with the service


def test_recorder_joins_a_service_and_ends_with_a_killed_one(filming: list[str], tmp_path: Path) -> None:
    own, joined = tmp_path / "recordings", tmp_path / "joined"
    with (
        heartbeats() as port,
        running_service(port, [*filming, "--recording-directory", str(own)], cwd=tmp_path) as service,
    ):
        command = [
            sys.executable,
            "-m",
            "companion.cli",
            "log",
            "record",
            str(joined),
            "--connect",
            service.endpoint,
        ]
        with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE) as recorder:
            try:
                wait_for(lambda: files(joined) and messages_of(files(joined)[0])["guidance_input"] > 20)
                recorder.terminate()
                _, printed = recorder.communicate(timeout=60)
            finally:
                recorder.kill()
        assert recorder.returncode == 0
        assert len(printed.splitlines()) == 2

        child = recorder_of(service)
        service.signal(signal.SIGKILL)

        def ended() -> bool:
            with contextlib.suppress(ProcessLookupError, FileNotFoundError):
                return "Z" in Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[0]
            return True

        wait_for(ended)
    (path,) = files(own)
    reader = RecordingReader(path)
    assert len(list(reader.messages())) > 100
    assert reader.problems == []
    (path,) = files(joined)
    assert RecordingReader(path).problems == []
    assert messages_of(path)["/image"]
    assert replay([path], {}).inexact
