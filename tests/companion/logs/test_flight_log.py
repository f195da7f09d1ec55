"""`companion log`: flights, modes, events and refused commands of recordings."""

from __future__ import annotations

import json
import zlib
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from companion.bench.lockstep_flight import plain_settings
from companion.bus.messages import depth_image_attachment
from companion.bus.vehicle_messages import vehicle_message
from companion.guidance.core import GuidanceOptions
from companion.recording.convert import Converter
from companion.recording.encoding import dumps
from companion.recording.files import RecordingReader
from companion.recording.tap import run_record
from companion.vehicle.state import FlightMode, VehicleState
from tests.companion.command_line import companion, companion_here
from tests.companion.recording.lockstep_recording import new_writer

SECOND_NS = 10**9
REFUSED = {
    "stamp_ns": 1,
    "kind": "refused",
    "behaviour": "goto",
    "message": "refused: too far",
    "outcome": None,
    "level": "info",
}


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten seconds with a flight of four, in two modes, with an event and a refused command."""
    writer, converter = new_writer(tmp_path_factory.mktemp("log")), Converter("vehicle1")

    def write(path: str, message: object, attachment: bytes | None = None) -> None:
        payload = message if isinstance(message, bytes) else dumps(message)
        for converted in converter.convert(path, payload, attachment):
            writer.write(*converted)

    write("@record/run", run_record(plain_settings(), GuidanceOptions(), "service1"))
    state = VehicleState(mode=FlightMode.HOLD)
    for second in range(11):
        armed = 3 <= second < 7
        mode = FlightMode.TAKEOFF if armed else FlightMode.HOLD
        write("vehicle", vehicle_message(replace(state, armed=armed, mode=mode), second * SECOND_NS))
        if second == 5:
            write("events", {"stamp_ns": second * SECOND_NS + 1, "level": "warning", "text": "low battery"})
            output = {"step": 1, "now_ns": second * SECOND_NS + 2, "events": [REFUSED]}
            write("@record/guidance_output", output)
        if second > 5:
            about = depth_image_attachment(second, second * SECOND_NS, "down", 2, 1)
            write("cameras/down/depth_image", zlib.compress(b"\1\0\2\0"), dumps(about))
    writer.close()
    return writer.path


def test_show_lists_what_happened_in_order(path: Path, tmp_path: Path) -> None:
    done = companion_here("log", "show", path, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    refused = "goto: refused: too far"
    assert [(line["kind"], line["text"]) for line in found["lines"]] == [
        ("mode", "hold"),
        ("mode", "takeoff"),
        ("armed", ""),
        ("warning", "low battery"),
        ("refused", refused),
        ("mode", "hold"),
        ("disarmed", ""),
    ]
    assert [flight["duration_s"] for flight in found["flights"]] == [4.0]
    assert (found["vehicle"], found["problems"]) == ("vehicle1", [])
    assert found["large"] == {"/cameras/down/depth_image": 5}
    text = companion_here("log", "show", path, cwd=tmp_path).stdout
    assert len(text.splitlines()) == 1 + len(found["lines"]) + len(found["large"])
    assert text.splitlines()[-1].startswith("/cameras/down/depth_image: 5 ")


def test_list_has_a_line_for_each_file_and_one_for_a_bad_one(path: Path, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(path.read_bytes())
    (tmp_path / "b.mcap").write_bytes(path.read_bytes()[:1000])
    (tmp_path / "c.mcap").touch()
    done = companion_here("log", "show", tmp_path, "--json", cwd=tmp_path)
    assert done.returncode == 0
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert [Path(each["path"]).name for each in found] == ["a.mcap", "b.mcap"]
    assert [bool(each["problems"]) for each in found] == [False, True]
    assert len(done.stderr.splitlines()) == 1
    assert "c.mcap" in done.stderr


def test_a_recording_without_an_end_is_not_called_damaged(path: Path, tmp_path: Path) -> None:
    """As of one that is being recorded: read at a whole chunk, or inside the next."""
    content = path.read_bytes()
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    first = summary.chunk_indexes[0]
    end = first.chunk_start_offset + first.chunk_length
    (tmp_path / "a.mcap").write_bytes(content[:end])
    (tmp_path / "b.mcap").write_bytes(content[: end + 20])
    (tmp_path / "c.mcap").write_bytes(content[: end - 20] + b"\0" + content[end - 19 :])
    # The length of a record; the end is there.
    length = first.chunk_start_offset + 8
    (tmp_path / "d.mcap").write_bytes(content[:length] + b"\x7f" + content[length + 1 :])
    done = companion_here("log", "show", tmp_path, cwd=tmp_path)
    states = [line.rpartition("  ")[2] for line in done.stdout.splitlines()]
    assert states == ["not ended", "not ended", "damaged", "damaged"]
    found = [
        json.loads(line)
        for line in companion_here("log", "show", tmp_path, "--json", cwd=tmp_path).stdout.splitlines()
    ]
    assert [each["ended"] for each in found] == [False, False, True, True]
    shown = companion_here("log", "show", tmp_path / "a.mcap", cwd=tmp_path).stdout.splitlines()
    assert "not ended" in shown[0]
    assert "not ended" in shown[-1]


def test_recover_writes_a_complete_file(path: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:-400])  # in the summary: no message is lost
    done = companion_here("log", "convert", "cut.mcap", "whole.mcap", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    with (tmp_path / "whole.mcap").open("rb") as whole:
        found = list(make_reader(whole).iter_messages())
    assert len(found) == len(list(RecordingReader(path).messages()))


@pytest.mark.parametrize("command", [("show", "none"), ("convert", "none", "x.mcap")])
def test_missing_path_is_one_line(command: tuple[str, ...], tmp_path: Path) -> None:
    done = companion_here("log", *command, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("companion: none: ")


@pytest.mark.realtime  # it waits for the service
def test_record_without_a_service_is_one_line_and_leaves_no_file(tmp_path: Path) -> None:
    done = companion("log", "record", "out", "--connect", "tcp/127.0.0.1:9", cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
