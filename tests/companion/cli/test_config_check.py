"""`companion describe settings --check`: what is wrong, what may come later, and silence."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from companion.cli.config_check import check_settings
from companion.settings import Settings
from companion.settings.perception import SourceSection
from companion.settings.reading import flags
from tests.companion.command_line import companion_here
from vision.weights import DEFAULT_WEIGHTS

# What a file setting needs besides, to be read at all.
NEEDED = {
    "mqtt.password_file": ["--mqtt-url", "mqtt://broker"],
    "mqtt.ca_file": ["--mqtt-url", "mqtts://broker"],
    "source.depth_calibration_file": ["--source-depth", "depth"],
    "markers.boards_file": ["--markers-dictionary", "APRILTAG_36h11"],
    "markers.map_file": ["--markers-dictionary", "APRILTAG_36h11"],
}
FILES = [flag.key for flag in flags() if flag.key.endswith("_file")]


def check(folder: Path, *arguments: str | Path, source: str | None = "none") -> tuple[int, list[str]]:
    """Return the exit code and the lines on standard error; nothing else is printed."""
    given = [] if source is None else ["--source", source]
    done = companion_here("describe", "settings", "--check", *given, *arguments, cwd=folder)
    assert done.stdout == ""
    assert all(line.startswith("companion: ") for line in done.stderr.splitlines())
    return done.returncode, [line.removeprefix("companion: ") for line in done.stderr.splitlines()]


def written(path: Path, content: bytes, mode: int = 0o600) -> Path:
    path.write_bytes(content)
    path.chmod(mode)
    return path


def test_right_settings_are_silent(tmp_path: Path) -> None:
    written(tmp_path / "street.mp4", b"frames")
    written(tmp_path / "token", b"0123456789abcdef")
    written(tmp_path / "key", b"correct horse")
    arguments = ["--dashboard-token-file", "token", "--vehicle-signing-key-file", "key"]
    arguments += ["--recording-directory", "flights", "--recording-video", "flight.webm"]
    assert check(tmp_path, *arguments, source="street.mp4") == (0, [])
    assert not (tmp_path / "flights").exists()


@pytest.mark.parametrize("key", FILES)
def test_missing_file_is_a_fault(key: str, tmp_path: Path) -> None:
    flag = f"--{key.replace('.', '-').replace('_', '-')}"
    code, lines = check(tmp_path, flag, "absent.file", *NEEDED.get(key, []))
    assert code == 2
    assert any("absent.file" in line for line in lines)


@pytest.mark.parametrize(
    ("key", "arguments"),
    [
        ("plugins", ["--plugins-modules", "no_such_module"]),
        ("vehicle.url", ["--vehicle-url", "serial:///dev/ttyAMA0"]),
        ("vehicle.url", ["--vehicle-url", "udpin://0.0.0.0:99999"]),
        ("dashboard.listen", ["--dashboard-listen", "0.0.0.0:8088"]),
        ("dashboard.hosts", ["--dashboard-hosts", "drone.example.org"]),
        ("source.uri", ["--source", "absent.mp4"]),
        ("source.uri", ["--source", "nonsense://0"]),
        ("source.uri", ["--source", "csi://front"]),
        ("source.uri", ["--source", "shm://a/b"]),
        ("source.uri", ["--source", "ros://camera/image-raw"]),
        ("source.depth", ["--source", "-", "--source-depth", "absent.png"]),
        ("detector", ["--source", "-", "--model", "absent"]),
        ("detector", ["--source", "-", "--model", "absent.onnx"]),
        ("detector", ["--source", "-", "--model", "text.pt"]),
        ("detector", ["--source", "-", "--model", "text.safetensors"]),
        ("detector", ["--source", "-", "--model", "text.onnx", "--detector-runtime", "torch"]),
        ("detector", ["--source", "-", "--detector-kind", "absent"]),
    ],
)
def test_wrong_setting_is_one_line(key: str, arguments: list[str], tmp_path: Path) -> None:
    for name in ("text.pt", "text.safetensors", "text.onnx"):
        written(tmp_path / name, b"text")
    code, lines = check(tmp_path, *arguments)
    assert code == 2
    assert len(lines) == 1
    assert lines[0].startswith(key)


@pytest.mark.parametrize(
    ("flag", "content"),
    [
        ("--vehicle-signing-key-file", b"correct horse"),
        ("--dashboard-token-file", b"0123456789abcdef"),
        ("--language-key-file", b"abc"),
    ],
)
def test_key_that_others_read_is_a_fault(flag: str, content: bytes, tmp_path: Path) -> None:
    code, lines = check(tmp_path, flag, written(tmp_path / "secret", content, 0o640))
    assert (code, len(lines)) == (2, 1)
    assert f"chmod 600 {tmp_path / 'secret'}" in lines[0]


@pytest.mark.parametrize("flag", ["--zenoh-config-file", "--zenoh-child-config-file"])
def test_key_of_tls_that_others_read_is_a_fault(flag: str, tmp_path: Path) -> None:
    own = written(tmp_path / "own.key", b"key")
    authority = written(tmp_path / "ca.pem", b"", 0o644)
    tls = {"root_ca_certificate": str(authority), "listen_private_key": str(own)}
    config = written(tmp_path / "zenoh.json5", json.dumps({"transport": {"link": {"tls": tls}}}).encode())
    assert check(tmp_path, flag, config) == (0, [])
    own.chmod(0o644)
    authority.unlink()
    code, lines = check(tmp_path, flag, config)
    assert code == 2
    assert [line.split()[:2] for line in lines] == [
        ["zenoh", "root_ca_certificate"],
        ["zenoh", "listen_private_key"],
    ]


@pytest.mark.parametrize(
    ("key", "arguments"),
    [
        ("source.uri", ["--source", "/dev/video77"]),
        ("vehicle.url", ["--vehicle-url", "serial:///dev/ttyAMA77:921600"]),
        ("recording.directory", ["--recording-directory", "file/flights"]),
        ("recording.video", ["--source", "-", "--recording-video", "file/flight.webm"]),
    ],
)
def test_what_may_come_later_is_no_fault(key: str, arguments: list[str], tmp_path: Path) -> None:
    written(tmp_path / "file", b"")
    code, lines = check(tmp_path, *arguments)
    assert code == 0
    assert [line.partition(":")[0] for line in lines] == [key]


def test_further_cameras_are_checked(tmp_path: Path) -> None:
    written(tmp_path / "companion.toml", b'[cameras.down.source]\nuri = "absent.mp4"\n')
    code, lines = check(tmp_path, "--config", "companion.toml")
    assert code == 2
    assert [line.partition(":")[0] for line in lines] == ["cameras.down.source.uri"]


def test_run_names_all_faults_before_it_opens_anything(tmp_path: Path) -> None:
    written(tmp_path / "key", b"correct horse", 0o644)
    arguments = ["--source", "absent.mp4", "--model", "absent", "--vehicle-signing-key-file", "key"]
    code, lines = check(tmp_path, *arguments, source=None)
    assert (code, len(lines)) == (2, 3)
    done = companion_here("run", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [f"companion: {line}" for line in lines]


def test_check_loads_no_runtime() -> None:
    """It runs in the service's own process too."""
    settings = Settings(source=SourceSection(uri="-"))
    assert check_settings(settings) == []
    assert DEFAULT_WEIGHTS.is_file()
    code = (
        "import sys\n"
        "from companion.cli.config_check import check_settings\n"
        "from companion.settings import Settings\n"
        "check_settings(Settings())\n"
        "assert not {'torch', 'onnxruntime', 'openvino'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
