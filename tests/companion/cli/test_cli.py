"""The command line: output, streams and exit codes."""

from __future__ import annotations

import json
import os
import pickle
import re
import socket
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import cv2
import pytest
import typer
from typer.testing import CliRunner

from companion.bus.topics import NO_OBJECTS, TOPICS
from companion.cli import flags
from companion.cli.commands import app
from companion.cli.flags import warn_rendered_only
from companion.guidance.command import COMMANDS
from companion.settings import Settings
from mavlink_sim.testing import free_port
from tests.companion.command_line import companion, companion_here
from vision.catalog import CAMERA_MODEL, KNOWN
from vision.object_detector import YOLO
from vision.weights import DEFAULT_WEIGHTS

pytestmark = pytest.mark.realtime

CONFIG = ("--config", "companion.toml")


def one_line_of_bad_input(done: subprocess.CompletedProcess[str]) -> str:
    """Return the only line on standard error; check that the exit code is 2."""
    lines = [line for line in done.stderr.splitlines() if line.startswith("companion:")]
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert len(lines) == 1, done.stderr
    assert "Traceback" not in done.stderr
    return lines[0]


def test_detect_writes_one_json_object_per_frame(
    exported_model: Path, image_folder: Path, tmp_path: Path
) -> None:
    done = companion(
        "detect", image_folder, "--model", exported_model, "--image-size", "160", "--confidence", "0",
        "--json", "--every", "3", "--limit", "4", "--save", tmp_path / "saved", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    messages = [json.loads(line) for line in done.stdout.splitlines()]
    assert [message["sequence"] for message in messages] == [0, 3, 6, 9]
    for message in messages:
        fields = {"file", "sequence", "captured_ns", "width", "height", "inference_ms", "detections"}
        assert set(message) == fields
        assert (message["width"], message["height"]) == (160, 120)
        assert message["inference_ms"] > 0
        for found in message["detections"]:
            assert set(found) == {"class_id", "class_name", "confidence", "xyxy", "center"}
            left, top, right, bottom = found["xyxy"]
            assert 0 <= left <= right <= 160
            assert 0 <= top <= bottom <= 120
    assert any(message["detections"] for message in messages)
    assert sorted(path.name for path in (tmp_path / "saved").glob("*.png")) == [
        "000.png", "003.png", "006.png", "009.png",
    ]  # fmt: skip
    drawn = cv2.imread(str(tmp_path / "saved" / "detections" / "000.png"))
    assert drawn is not None
    assert drawn.shape == (120, 160, 3)


def test_detect_reports_tracks_with_track_option(
    exported_model: Path, image_folder: Path, tmp_path: Path
) -> None:
    done = companion_here(
        "detect", image_folder, "--model", exported_model, "--image-size", "160", "--confidence", "0",
        "--json", "--limit", "2", "--track", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = [record for line in done.stdout.splitlines() for record in json.loads(line)["detections"]]
    assert found
    for record in found:
        assert {"track_id", "track_score", "track_state"} < set(record)
        assert record["track_state"] in ("none", "tentative", "confirmed")


def test_detect_without_json_writes_one_line_per_frame(
    exported_model: Path, image_folder: Path, tmp_path: Path
) -> None:
    done = companion_here(
        "detect",
        image_folder,
        "--model",
        exported_model,
        "--image-size",
        "160",
        "--confidence",
        "1",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 20
    assert all(line.endswith(NO_OBJECTS) for line in lines)


def test_detect_reports_only_requested_classes(
    exported_model: Path, image_folder: Path, tmp_path: Path
) -> None:
    common: list[str | Path] = [
        "detect",
        image_folder,
        "--model",
        exported_model,
        "--image-size",
        "160",
        "--confidence",
        "0",
    ]
    common += ["--json", "--limit", "3"]

    def names(*more: str) -> set[str]:
        lines = companion_here(*common, *more, cwd=tmp_path).stdout.splitlines()
        return {found["class_name"] for line in lines for found in json.loads(line)["detections"]}

    everything = names()
    one = sorted(everything)[0]
    assert names("--classes", one) == {one}


def test_missing_model_is_one_line(image_folder: Path, tmp_path: Path) -> None:
    line = one_line_of_bad_input(companion_here("detect", image_folder, "--model", "no.pt", cwd=tmp_path))
    assert "no.pt" in line


def test_truncated_checkpoint_is_one_line(small_model: Path, image_folder: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.pt"
    content = small_model.read_bytes()
    broken.write_bytes(content[: len(content) // 2])
    line = one_line_of_bad_input(companion_here("detect", image_folder, "--model", broken, cwd=tmp_path))
    assert "broken.pt" in line


class _Hostile:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (f"touch {self.marker}",)


def test_checkpoint_that_calls_system_is_refused(image_folder: Path, tmp_path: Path) -> None:
    marker, hostile = tmp_path / "it-ran", tmp_path / "hostile.pt"
    with zipfile.ZipFile(hostile, "w") as archive:
        archive.writestr("hostile/data.pkl", pickle.dumps({"model": _Hostile(marker)}, protocol=2))
        archive.writestr("hostile/version", "3\n")
    line = one_line_of_bad_input(companion_here("detect", image_folder, "--model", hostile, cwd=tmp_path))
    assert "system" in line
    assert not marker.exists()


def test_unknown_class_is_one_line_with_nearest_names(
    exported_model: Path, image_folder: Path, tmp_path: Path
) -> None:
    arguments: list[str | Path] = [
        "detect",
        image_folder,
        "--model",
        exported_model,
        "--classes",
        "persn",
    ]
    line = one_line_of_bad_input(companion_here(*arguments, cwd=tmp_path))
    assert "'persn'" in line
    assert "person" in line


def test_unreadable_video_is_one_line(exported_model: Path, tmp_path: Path) -> None:
    video = tmp_path / "broken.mp4"
    video.write_bytes(b"\0\0\0\x18ftypmp42" + bytes(1000))
    line = one_line_of_bad_input(companion_here("detect", video, "--model", exported_model, cwd=tmp_path))
    assert "broken.mp4" in line


def test_invalid_setting_is_one_line_with_key_and_range(tmp_path: Path) -> None:
    (tmp_path / "companion.toml").write_text("[detector]\nconfidence = 1.5\n")
    line = one_line_of_bad_input(companion_here("run", *CONFIG, cwd=tmp_path))
    assert "detector.confidence" in line
    assert "0 to 1" in line


def test_view_is_run_without_a_vehicle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Settings] = []
    monkeypatch.setattr("companion.cli.view.run_service", lambda settings, _: shown.append(settings))
    (tmp_path / "companion.toml").write_text("[vehicle]\nurl = 'udpin://0.0.0.0:14540'\n")
    assert companion_here("view", "street.mp4", *CONFIG, "--model", "yolo11n", cwd=tmp_path).returncode == 0
    assert companion_here("view", "-", *CONFIG, "--source-loop", "false", cwd=tmp_path).returncode == 0
    assert [each.vehicle.expected for each in shown] == [False, False]
    assert [(each.source.uri, each.source.loop) for each in shown] == [("street.mp4", True), ("-", False)]
    assert shown[0].detector.model == "yolo11n"


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("a.mp4", "--source", "b.mp4"), "source.uri"),
        (("a.mp4", "--vehicle-url", "tcp://127.0.0.1:5760"), "vehicle.url"),
        (("a.mp4", "--dashboard-listen", ""), "dashboard.listen"),
        (("none",), "view none"),
    ],
)
def test_view_names_what_does_not_fit(words: tuple[str, ...], named: str, tmp_path: Path) -> None:
    assert named in one_line_of_bad_input(companion_here("view", *words, cwd=tmp_path))


def test_play_with_an_own_source_names_the_command(tmp_path: Path) -> None:
    assert "companion view a.mp4" in one_line_of_bad_input(
        companion_here("play", "--source", "a.mp4", cwd=tmp_path)
    )


def test_send_without_a_service_is_one_line(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    line = one_line_of_bad_input(companion_here("send", "hold", "--connect", endpoint, cwd=tmp_path))
    assert endpoint in line


def test_config_merges_file_environment_and_flags(tmp_path: Path) -> None:
    (tmp_path / "companion.toml").write_text('[vehicle]\nname = "alpha"\n')
    done = companion_here(
        "describe", "settings", *CONFIG, "--detector-image-size", "320", "--source", "-", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert 'name = "alpha"' in done.stdout
    assert "image_size = 320" in done.stdout
    assert 'uri = "-"' in done.stdout


def test_version_is_printed(tmp_path: Path) -> None:
    done = companion("--version", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, f"companion {version('mavlink-companion')}\n")


@pytest.mark.parametrize("command", sorted(typer.main.get_group(app).commands))
def test_every_command_has_help(command: str) -> None:
    done = CliRunner().invoke(app, [command, "--help"])
    assert done.exit_code == 0
    assert len(done.stdout.splitlines()) > 4


def test_help_shows_the_types_of_settings() -> None:
    shown = CliRunner().invoke(app, ["run", "--help"]).stdout
    for words in (
        "--source-loop <true|false>",
        "--vehicle-system-id <int>",
        "--detector-confidence <float>",
        "--vehicle-url <str>",
        "--detector-classes <list>",
    ):
        assert words in shown


def test_small_commands_do_not_load_torch(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom companion.cli import app\n"
        "for command in ('send hold --help', 'describe --help'):\n"
        "    app(command.split(), standalone_mode=False)\n"
        "assert 'torch' not in sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_help_of_all_commands_loads_nothing_heavy(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom companion.cli import app\napp(['--help'], standalone_mode=False)\n"
        "heavy = {'pydantic', 'numpy', 'cv2', 'torch', 'zenoh', 'av', 'rich', 'companion.settings'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_default_detector_of_the_command_line_is_that_of_vision() -> None:
    assert flags.YOLO == YOLO


def test_bench_setpoints_prints_json(tmp_path: Path) -> None:
    done = companion("bench", "setpoints", "--seconds", "1", "--load", "1", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["rate_hz"] == 50.0
    assert figures["setpoints"] > 10


@pytest.mark.parametrize("name", ["default", "path", "export"])
def test_detect_warns_of_a_model_of_rendered_scenes(
    name: str, exported_model: Path, image_folder: Path, tmp_path: Path
) -> None:
    model, flags = {
        "default": ("default", ("--image-size", "96")),
        "path": (str(DEFAULT_WEIGHTS), ("--image-size", "96")),
        "export": (str(exported_model), ("--image-size", "160")),
    }[name]
    done = companion_here("detect", image_folder, "--limit", "2", "--model", model, *flags, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "--pull" in line]
    offered = KNOWN[CAMERA_MODEL]
    assert offered.name in line
    assert (offered.licence, Path(offered.file).suffix) == ("Apache-2.0", ".onnx")  # needs no extra
    assert f"'{model}'" in line
    assert "camera images" in line


def test_detect_is_silent_about_another_model(small_model: Path, image_folder: Path, tmp_path: Path) -> None:
    from vision.yolo.checkpoint import load_checkpoint, save_checkpoint

    own = tmp_path / "own.safetensors"
    save_checkpoint(own, load_checkpoint(small_model).model, metadata={"trained_on": "6 images of set"})
    done = companion_here("detect", image_folder, "--model", own, "--image-size", "96", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "--pull" not in done.stderr


def test_no_warning_for_the_simulated_camera(capsys: pytest.CaptureFixture[str]) -> None:
    warn = warn_rendered_only
    warn([("shm://simulator", "default")])
    assert capsys.readouterr().err == ""
    warn([("shm://simulator", "default"), ("/dev/video0", "mine.onnx"), ("rtp://:5600", "default")])
    (line,) = capsys.readouterr().err.splitlines()
    assert "'mine.onnx'" in line


def test_help_lists_commands_in_order_of_use() -> None:
    shown = CliRunner().invoke(app, ["--help"]).stdout
    listed = shown.partition("Commands:")[2].split("\n")
    commands = [line.split()[0] for line in listed if line.startswith("  ") and line.strip()]
    assert commands[:6] == ["view", "play", "run", "demo", "detect", "send"]
    assert "--install-completion" in shown


@pytest.mark.parametrize("group", [[], ["models"], ["calibrate"], ["bench"], ["log"], ["learn"]])
def test_commands_in_the_help_have_a_whole_sentence(group: list[str]) -> None:
    shown = CliRunner().invoke(app, [*group, "--help"], env={"COLUMNS": "80"}).stdout
    listed = shown.partition("Commands:")[2].splitlines()[1:]
    assert len(listed) > 1
    assert all(line.endswith(".") and not line.endswith("...") for line in listed)


def test_help_of_send_has_flight_commands_and_few_settings() -> None:
    shown = CliRunner().invoke(app, ["send", "--help"]).stdout
    assert len(shown.splitlines()) < 160
    assert {f"  {word}" for word in COMMANDS} <= {
        f"  {line.split()[0]}" for line in shown.splitlines() if line.split()
    }
    assert "--zenoh-connect" in shown
    assert "--source-uri" not in shown
    assert CliRunner().invoke(app, ["send", "hold", "--source-uri", "x.mp4"]).exit_code == 2


def test_echo_of_unknown_topic_lists_topics(tmp_path: Path) -> None:
    line = one_line_of_bad_input(companion_here("echo", "bogus", cwd=tmp_path))
    assert {topic.name for topic in TOPICS} <= set(re.findall(r"[a-z_]+", line))


_DEMO_THAT_SAYS_MUCH = """
import sys
import companion.simulation.demo
from companion.cli import main

def flight(output, *, say, **_):
    for _ in range(400):
        say("x" * 1000)
    values = dict.fromkeys(companion.simulation.demo.Summary.__dataclass_fields__)
    return companion.simulation.demo.Summary(**{**values, "success": False, "failure": "flown"})

companion.simulation.demo.run_demo = flight
sys.argv = ["companion", "demo"]
main()
"""


def test_demo_does_not_wait_for_its_reader() -> None:
    command = [sys.executable, "-c", _DEMO_THAT_SAYS_MUCH]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            assert process.wait(60) == 1  # nobody has read its output
            assert "flown" in process.stderr.read()
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("arguments", "new", "there"),
    [
        (["detect", "x.mp4", "--detector-known-heights", "car=1.5"], "detector.class_heights_m", True),
        (["send", "stop", "--tracker-true-score=0.3"], "--tracker-confirm-score", False),
        (["run", "--tracker-true-score", "0.3"], "tracker.confirm_score", True),
        (["calibrate", "mount", "x.mp4", "--camera-gimbal", "true"], "--camera-on-gimbal", False),
        (["play", "--views-front-x", "1"], "[cameras.NAME]", True),
    ],
)
def test_old_flag_names_the_new_one_in_every_command(
    arguments: list[str], new: str, there: bool, tmp_path: Path
) -> None:
    done = companion_here(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    [line] = [line for line in done.stderr.splitlines() if "renamed" in line]
    assert new in line
    assert ("such option" not in line) == there


def test_old_flag_is_reported_with_all_other_faults(tmp_path: Path) -> None:
    (tmp_path / "companion.toml").write_text("[tracker]\nlost_s = 1.0\n[detector]\nimage_size = 1\n")
    done = companion_here(
        "run", *CONFIG, "--tracker-true-score", "0.3", "--detector-every", "2", cwd=tmp_path
    )
    assert done.returncode == 2
    lines = done.stderr.splitlines()
    for key in ("tracker.confirm_score", "tracker.coast_timeout_s", "detector.image_size", "detector.every"):
        assert len([line for line in lines if key in line]) == 1, done.stderr
    assert "--tracker-true-score" not in companion_here("run", "--help", cwd=tmp_path).stdout
