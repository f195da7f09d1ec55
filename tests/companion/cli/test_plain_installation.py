"""Without the extras: every command works, or says in one line which extra it needs."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main

from companion.cli import app
from mavlink_sim.cli.main import _COMMANDS as SIMULATOR_COMMANDS
from tests.companion.plain_installation import environment_without
from vision.extras import EXTRA_OF, install_command, missing_module

ROOT = Path(__file__).parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# What may need the module of an extra when it is imported. Nothing that flies is in it.
OPTIONAL = {
    "torch": (
        "companion.learning.train",
        "vision.exports.export",
        "vision.foreign.yolox",
        "vision.runtimes.conversion",
        "vision.runtimes.network",
        "vision.runtimes.torch_runtime",
        "vision.training.",
        "vision.yolo.",
    ),
    "aiomqtt": ("companion.mqtt.broker", "companion.mqtt.publisher"),
    "httpx": ("companion.mqtt.webhooks",),
    "mcap": (
        "companion.learning.collect",
        "companion.logs.",
        "companion.recording.",
        "companion.ros2.bag",
    ),
    "foxglove": ("companion.recording.live",),
    "gymnasium": ("companion.learning.train_policy", "mavlink_sim.environments"),
    "mavsdk": ("companion.vehicle.mavsdk_driver",),
    "mcp_types": ("companion.language.mcp_server",),
}
NOBODY = ("--connect", "tcp/127.0.0.1:1")  # where no service answers
ENDS = ""  # ends, with output or one line of its own
# (command, arguments, extra that its one line names). A command may be in it several times.
Walk = list[tuple[str, tuple[str, ...], str]]
NO_VEHICLE = ("--vehicle-url", "none", "--zenoh-listen", "tcp/127.0.0.1:0")
WALK: Walk = [
    ("run", ("--vehicle-url", "bad"), ENDS),
    ("run", (*NO_VEHICLE, "--source", "demo.png", "--model", "old.pt"), "models"),
    ("run", (*NO_VEHICLE, "--source", "demo.png", "--detector-runtime", "torch"), "models"),
    ("run", (*NO_VEHICLE, "--source", "demo.png", "--detector-runtime", "openvino"), "models"),
    ("run", (*NO_VEHICLE, "--source", "none", "--metrics-listen", "127.0.0.1:1"), "service"),
    ("run", ("--vehicle-driver", "mavsdk", "--source", "none", *NO_VEHICLE[2:]), "service"),
    ("play", ("--autopilot", "none"), ENDS),
    ("view", ("none",), ENDS),
    ("demo", ("--seeds", "2..1"), ENDS),
    ("detect", ("demo.png", "--image-size", "320"), ENDS),
    ("detect", ("demo.png", "--model", "old.pt"), "models"),
    ("detect", ("demo.png", "--runtime", "torch"), "models"),
    ("detect", ("demo.png", "--runtime", "openvino"), "models"),
    ("detect", ("demo.png", "--runtime", "tensorrt"), "models"),
    ("detect", ("demo.png", "--runtime", "auto", "--image-size", "320"), ENDS),
    ("send", ("land", *NOBODY), ENDS),
    ("console", NOBODY, ENDS),
    ("echo", ("detections", *NOBODY), ENDS),
    ("init", (), ENDS),
    ("status", NOBODY, ENDS),
    ("doctor", (*NOBODY, "--vehicle-url", "none", "--source", "none"), ENDS),
    ("install", ("--user", "--dry-run"), ENDS),
    ("uninstall", ("--user", "--dry-run"), ENDS),
    ("ask", ("land", *NOBODY), ENDS),
    ("ask", ("land", *NOBODY, "--language-model", "small"), "language"),
    ("mcp", NOBODY, "language"),
    ("ros2 node", (*NOBODY, "--python", "none"), ENDS),
    ("detect", ("demo.png", "--model", "none"), ENDS),
    ("detect", ("demo.png", "--level", "--save", "out", "--vehicle-driver", "mavsdk"), "service"),
    ("detect", ("demo.png", "--model", "none", "--depth"), ENDS),
    ("detect", ("demo.png", "--model", "none", "--cloud", "out.ply"), ENDS),
    ("detect", ("demo.png", "--model", "none", "--markers", "4X4_50"), ENDS),
    ("view", ("--dashboard-listen", "bad"), ENDS),
    ("send", ("--file", "demo"), ENDS),
    ("describe", ("commands",), ENDS),
    ("describe", ("topics",), ENDS),
    ("describe", ("cameras",), ENDS),
    ("describe", ("settings",), ENDS),
    ("describe", ("settings", "--check", "--vehicle-driver", "mavsdk"), "service"),
    ("describe", ("settings", "--check", "--metrics-listen", "127.0.0.1:1"), "service"),
    ("markers", ("--help",), ENDS),
    ("log record", ("recordings", *NOBODY), "recording"),
    ("log replay", ("flight.mcap",), "recording"),
    ("log show", (".",), "recording"),
    ("log show", ("flight.mcap",), "recording"),
    ("log show", ("flight.mcap", "--objects", "kml"), "recording"),
    ("log convert", ("flight.mcap", "out.mcap"), "recording"),
    ("log convert", ("flight.mcap", "out.tlog"), "recording"),
    ("learn collect", ("images", "flight.mcap"), "recording"),
    ("learn evaluate", ("labelled", "--image-size", "320"), ENDS),
    ("learn evaluate", ("labelled", "--runtime", "torch"), "models"),
    ("learn train", ("--data", "labelled", "--steps", "2", "--image-size", "64"), "models"),
    ("learn train", ("--policy", "companion/CartPole-v0"), "learn"),
    ("models show", (), ENDS),
    ("models show", ("default",), ENDS),
    ("models show", ("old.pt",), "models"),
    ("models show", ("default", "--compare", "none.onnx"), "models"),
    ("models pull", ("none",), ENDS),
    ("models export", ("default", "--to", "onnx"), "models"),
    ("calibrate lens", ("none", "--board", "chessboard", "10x7", "--square", "0.02"), ENDS),
    ("calibrate mount", ("none", "--marker", "4X4_50"), ENDS),
    ("bench detector", ("--frames", "5", "--image-size", "64"), ENDS),
    ("bench latency", ("--driver", "none"), ENDS),
    ("bench latency", ("--driver", "mavsdk", "--seconds", "1"), "service"),
    ("bench setpoints", ("--seconds", "1", "--load", "0"), ENDS),
    ("bench deadman", ("--runs", "0"), ENDS),
    ("bench chaos", ("--minutes", "0"), ENDS),
    ("signing new", ("signing.key",), ENDS),
    ("signing send", ("--yes", "--vehicle-url", "none"), ENDS),
]
SIMULATOR_WALK: Walk = [
    ("", ("--camera-output", "rtp://127.0.0.1:5600"), "cameras"),
    (
        "camera",
        ("--vehicle-url", "udpin://127.0.0.1:0", "--camera-output", "rtp://127.0.0.1:5600"),
        "cameras",
    ),
    ("dataset", ("images", "--frames", "2", "--scene", "random", "--width", "64", "--height", "48"), ENDS),
    ("board", ("--help",), ENDS),
    ("bench", ("--help",), ENDS),
]
# All in one process, to which each command's imports are new only once.
CHILD = """
import importlib, json, sys
from typer.testing import CliRunner
app = importlib.import_module(sys.argv[2]).app
for arguments in json.loads(sys.argv[1]):
    done = CliRunner().invoke(app, arguments)
    failed = None if isinstance(done.exception, SystemExit | None) else repr(done.exception)
    print(json.dumps([done.exit_code, done.stdout, done.stderr, failed]), flush=True)
"""


def commands(command: Any, name: str = "") -> Iterator[str]:
    """Every command with its group."""
    if not hasattr(command, "commands"):
        yield name
        return
    for word, part in command.commands.items():
        yield from commands(part, f"{name} {word}".strip())


def walked(folder: Path, environment: dict[str, str], walk: Walk, module: str) -> Any:
    """Run the commands in a folder with an image, a checkpoint, a recording and a labelled set.

    What is run is a copy of the packages: nothing may be written into it.
    """
    packages = folder.parent / "packages"
    for name in ("companion", "mavlink_sim", "vision"):
        shutil.copytree(ROOT / name, packages / name)
    installed = files(packages)
    shutil.copy(ROOT / "docs/images/demo.png", folder)
    (folder / "labelled").mkdir()
    shutil.copy(ROOT / "docs/images/demo.png", folder / "labelled")
    (folder / "labelled" / "demo.txt").write_text("2 0.5 0.5 0.2 0.2\n")
    (folder / "old.pt").write_bytes(b"PK")  # begins as a checkpoint
    (folder / "flight.mcap").touch()
    given = json.dumps([[*command.split(), *arguments] for command, arguments, _ in walk])
    path = os.pathsep.join((environment["PYTHONPATH"], str(packages)))
    done = subprocess.run(
        [sys.executable, "-c", CHILD, given, module],
        cwd=folder,
        env=environment | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    results = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(results) == len(walk), done.stderr
    assert files(packages) == installed
    return results


def files(folder: Path) -> dict[Path, int]:
    """The files of a folder, with the time of their last change."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def test_walk_has_every_command() -> None:
    assert {command for command, _, _ in WALK} == set(commands(typer.main.get_command(app)))
    assert {command for command, _, _ in SIMULATOR_WALK} == {"", *SIMULATOR_COMMANDS}


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("walk", "module"), [(WALK, "companion.cli.commands"), (SIMULATOR_WALK, "mavlink_sim.cli.main")]
)
def test_every_command_works_or_names_its_extra(tmp_path: Path, walk: Walk, module: str) -> None:
    (tmp_path / "work").mkdir()
    results = walked(tmp_path / "work", environment_without(tmp_path / "hidden"), walk, module)
    wrong = []
    for (command, arguments, extra), (code, output, errors, failed) in zip(walk, results, strict=True):
        lines = errors.splitlines()
        if extra:
            good = code == 2 and len(lines) == 1 and f"'mavlink-companion[{extra}]'" in errors
        else:
            # `status` without a service, and warnings of `doctor`, are 1.
            good = (
                code in ((0, 1, 2) if command in ("status", "doctor") else (0, 2))
                and "mavlink-companion[" not in errors
                and (output or errors)
            )
        if failed is not None or not good:
            wrong.append(f"{command} {' '.join(arguments)}: {code} {failed} {errors[-500:]}")
    assert not wrong, "\n".join(wrong)


def test_only_listed_modules_need_an_extra(tmp_path: Path) -> None:
    """Imported alone each: the service imports none of them."""
    code = """
import importlib, json, pkgutil
missing = {}
for package in ("companion", "mavlink_sim", "vision"):
    path = importlib.import_module(package).__path__
    for module in pkgutil.walk_packages(path, f"{package}.", lambda _: None):
        try:
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            missing[module.name] = error.name.partition(".")[0]
print(json.dumps(missing))
"""
    environment = environment_without(tmp_path / "hidden")
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    missing = json.loads(done.stdout)
    assert missing["vision.yolo.checkpoint"] == "torch"
    assert not {
        name: module for name, module in missing.items() if not name.startswith(OPTIONAL.get(module, ()))
    }


def test_table_of_extras_is_that_of_the_project() -> None:
    extras = PROJECT["optional-dependencies"]
    assert set(EXTRA_OF.values()) <= set(extras)
    for module, extra in EXTRA_OF.items():
        assert install_command(f"{module}.part") == f"pip install 'mavlink-companion[{extra}]'"


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (
            ModuleNotFoundError(name="torch"),
            "torch is not installed: pip install 'mavlink-companion[models]'",
        ),
        (
            ModuleNotFoundError(name="mcp.server"),
            "mcp.server is not installed: pip install 'mavlink-companion[language]'",
        ),
        (ModuleNotFoundError(name="companion.none"), None),
        (ImportError(name="torch"), None),  # is installed, and does not load
    ],
)
def test_line_of_a_missing_module(error: ImportError, line: str | None) -> None:
    assert missing_module(error) == line
