"""A recorded flight replays bit for bit; a change or damage shows."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from companion.logs.replay import Replay, replay
from companion.recording import RecordingError
from companion.recording.convert import INPUT_CHANNEL, OUTPUT_CHANNEL, RUN_CHANNEL
from companion.recording.files import Recorded
from companion.settings.reading import ConfigurationError
from tests.companion.command_line import companion_here
from tests.companion.guidance.gimbal_flight import gimbal_flight, person
from tests.companion.recording.lockstep_recording import recording, rewritten

MISSION = """
name = "look around"
[[step]]
do = "goto forward=4 right=1"
[[step]]
do = "seek person"
"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording: a mission from a file, which is removed, a refused command and a gimbal's direction."""
    folder = tmp_path_factory.mktemp("flight")
    mission = folder / "mission.toml"
    mission.write_text(MISSION)
    flight = gimbal_flight(person(40.0, 12.0))
    with recording(flight, folder) as path:
        assert flight.fly("gimbal pitch=-20", 20.0).outcome is not None
        outcome = flight.fly(f"mission {mission}", 120.0).outcome
        assert outcome is not None
        assert outcome.success, outcome.reason
        approach = "approach person distance=6"
        assert flight.fly(approach, 4.0).moments
        refused = flight.fly("goto forward=900 right=0", 5.0).outcome
        assert refused is not None
        assert not refused.success
    mission.unlink()
    return path


@pytest.fixture(scope="module")
def replayed(flown: Path) -> Replay:
    return replay([flown], {})


def changed_run(flown: Path, folder: Path, **values: object) -> Path:
    def change(message: Recorded) -> Recorded:
        if message.channel.topic != RUN_CHANNEL:
            return message
        return message._replace(data=json.dumps(json.loads(message.data) | values).encode())

    return rewritten(flown, folder, change)


def test_replay_equals_the_flight(replayed: Replay) -> None:
    assert (replayed.first, replayed.inexact, replayed.differing_steps) == (None, [], 0)
    assert replayed.steps > 500
    assert replayed.commands == 4


def test_replay_equals_in_another_process(flown: Path, replayed: Replay, tmp_path: Path) -> None:
    """Sets of texts have another order there."""
    other_seed = "2" if os.environ.get("PYTHONHASHSEED") == "1" else "1"
    done = subprocess.run(
        [sys.executable, "-m", "companion.cli", "log", "replay", flown, "--json"],
        env=os.environ | {"PYTHONHASHSEED": other_seed},
        cwd=tmp_path,
        capture_output=True,
        check=True,
    )
    found = json.loads(done.stdout)
    assert (found["identical"], found["digest"]) == (True, replayed.digest)


def test_changed_setting_is_named_with_the_first_difference(flown: Path, tmp_path: Path) -> None:
    done = companion_here(
        "log", "replay", flown, "--set", "guidance.max_horizontal_speed_mps=0.5", "--json", cwd=tmp_path
    )
    assert done.returncode == 1, done.stderr
    found = json.loads(done.stdout)
    assert found["changed"] == [
        {"key": "guidance.max_horizontal_speed_mps", "recorded": 5.0, "replayed": 0.5}
    ]
    assert found["first"]["field"].startswith("setpoint.")
    assert found["first"]["recorded"] != found["first"]["replayed"]
    assert 0 < found["differing_steps"] <= found["steps"]
    lines = companion_here(
        "log", "replay", flown, "--set", "guidance.max_horizontal_speed_mps=0.5", cwd=tmp_path
    )
    assert f"step {found['first']['step']}," in lines.stdout


def test_changed_outcome_shows_in_the_events(flown: Path) -> None:
    found = replay([flown], {"guidance.max_distance_m": "2"})
    assert found.first is not None
    assert found.events_replayed
    assert "events" in found.differing_fields


@pytest.mark.parametrize(
    "changes",
    [
        {"guidance.rate_hz": "40"},
        {"vehicle.name": "other"},
        {"guidance.max_speed": "1"},
        {"guidance.brake_s": "fast"},
        {"guidance.min_altitude_m": "90"},
    ],
)
def test_change_that_cannot_act_is_refused(flown: Path, changes: dict[str, str]) -> None:
    with pytest.raises(ConfigurationError, match=next(iter(changes)).partition(".")[2]):
        replay([flown], changes)


def test_altered_output_is_found(flown: Path, tmp_path: Path) -> None:
    def change(message: Recorded) -> Recorded:
        if message.channel.topic == OUTPUT_CHANNEL and json.loads(message.data)["step"] == 100:
            return message._replace(data=json.dumps(json.loads(message.data) | {"released": True}).encode())
        return message

    found = replay([rewritten(flown, tmp_path, change)], {})
    assert found.first is not None
    assert (found.first.step, found.first.field) == (100, "released")
    assert (found.first.recorded, found.first.replayed) == (True, False)
    assert found.differing_fields == {"released": 1}


def test_missing_steps_are_reported(flown: Path, tmp_path: Path) -> None:
    def change(message: Recorded) -> Recorded | None:
        lost = message.channel.topic == INPUT_CHANNEL and json.loads(message.data)["step"] in (0, 50, 51)
        return None if lost else message

    found = replay([rewritten(flown, tmp_path, change)], {})
    assert len(found.inexact) == 2
    assert "step 1:" in found.inexact[0]
    assert "50 to 51" in found.inexact[1]


def test_missing_outputs_are_reported(flown: Path, tmp_path: Path) -> None:
    def change(message: Recorded) -> Recorded | None:
        lost = message.channel.topic == OUTPUT_CHANNEL and 10 <= json.loads(message.data)["step"] < 13
        return None if lost else message

    found = replay([rewritten(flown, tmp_path, change)], {})
    (reason,) = found.inexact
    assert "outputs of 3 steps " in reason
    assert reason.endswith(" 10")
    assert found.differing_steps == 0


def test_outputs_before_their_inputs_are_compared(flown: Path, tmp_path: Path) -> None:
    """Messages with one stamp are read in any order."""

    def change(message: Recorded) -> Recorded:
        if message.channel.topic != OUTPUT_CHANNEL:
            return message
        output = json.loads(message.data) | {"rate_wanted": "none"}
        return message._replace(data=json.dumps(output).encode(), log_time_ns=message.log_time_ns - 1)

    found = replay([rewritten(flown, tmp_path, change)], {})
    assert (found.differing_steps, found.inexact) == (found.steps, [])


def test_parts_are_replayed_together(flown: Path, replayed: Replay, tmp_path: Path) -> None:
    def half(second: bool) -> Path:
        def change(message: Recorded) -> Recorded | None:
            step = json.loads(message.data).get("step", -1)
            return message if step < 0 or (step >= 200) is second else None

        return rewritten(flown, tmp_path / str(second), change)

    parts = [half(False), half(True)]
    found = replay(parts, {})
    assert (found.first, found.inexact) == (None, [])
    assert found.digest == replayed.digest
    assert replay(parts[::-1], {}).inexact
    other = changed_run(flown, tmp_path / "other", service="service2")
    with pytest.raises(RecordingError, match="2 runs"):
        replay([parts[0], other], {})


def test_recording_of_another_version_is_one_line(flown: Path, tmp_path: Path) -> None:
    other = changed_run(flown, tmp_path, layout="0" * 12, version="9.9.9")
    done = companion_here("log", "replay", other, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "9.9.9" in done.stderr


def test_unknown_command_is_one_line(flown: Path, tmp_path: Path) -> None:
    def change(message: Recorded) -> Recorded:
        text = message.data.replace(b'"text":"goto forward=900 right=0"', b'"text":"circle"')
        return message._replace(data=text)

    done = companion_here("log", "replay", rewritten(flown, tmp_path, change), cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "circle" in done.stderr


@pytest.mark.parametrize("content", [b"", b"text", b"\x89MCAP0\r\n"])
def test_file_without_recording_is_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "file.mcap").write_bytes(content)
    done = companion_here("log", "replay", "file.mcap", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("companion: file.mcap: ")
    assert len(done.stderr.splitlines()) == 1
