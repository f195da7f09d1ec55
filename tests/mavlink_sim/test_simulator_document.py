"""Runs the commands and examples of docs/simulator.md, and checks its list of packages."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
import sys
import threading
from contextlib import nullcontext
from pathlib import Path

import pytest
import yaml

from mavlink_sim.cli.main import main
from mavlink_sim.realtime.fleet import Fleet
from mavlink_sim.testing import READY, free_port, free_udp_ports, running_simulator

pytestmark = pytest.mark.realtime

pytest_plugins = ["pytester"]

ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / "docs" / "simulator.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", DOCUMENT, re.MULTILINE | re.DOTALL)


COMMANDS = [line for block in blocks("sh") for line in block.splitlines()]
# `mavlink-sim camera` starts no vehicle; test_docs.py reads its options, test_camera_of_vehicle.py runs it.
OF_CAMERAS = [line for line in COMMANDS if line.startswith("mavlink-sim camera")]
OF_THE_VEHICLE = [line for line in COMMANDS if line.startswith("mavlink-sim") and line not in OF_CAMERAS]


@pytest.mark.parametrize("line", OF_THE_VEHICLE)
def test_every_command_of_the_vehicle_starts_it(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = shlex.split(line)
    if "--camera" in words:  # a name only of this test
        words[words.index("--camera") + 1] = f"document-{tmp_path.parent.name}-{tmp_path.name}"
    ports = [str(port) for port in free_udp_ports(2)]
    elsewhere = ["--onboard-bind", "0", "--gcs-bind", "0", "--onboard-port", ports[0], "--gcs-port", ports[1]]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [*words, *elsewhere])
    monkeypatch.setattr("signal.signal", lambda number, handler: None)  # pytest's stay
    monkeypatch.setattr("gc.freeze", lambda: None)  # keep the objects of other tests collectable
    run = Fleet.run

    def run_shortly(fleet: Fleet) -> None:
        threading.Timer(0.1, fleet.stop).start()
        run(fleet)

    monkeypatch.setattr(Fleet, "run", run_shortly)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    output = capsys.readouterr().out.splitlines()
    count = int(words[words.index("--vehicles") + 1]) if "--vehicles" in words else 1
    assert sum(READY.match(line) is not None for line in output) == count
    assert output[-1] == "stopped"


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def test_the_other_commands_only_install() -> None:
    others = [line for line in COMMANDS if line not in [*OF_THE_VEHICLE, *OF_CAMERAS]]
    assert others
    assert all(line.startswith("pip install ") for line in others)


def scripts() -> list[str]:
    return [block for block in blocks("python") if "def test_" not in block]


@pytest.mark.parametrize("script", scripts(), ids=lambda script: script.split()[1])
def test_every_example_runs(script: str, tmp_path: Path) -> None:
    port = free_port()
    (tmp_path / "example.py").write_text(script.replace("14540", str(port)))
    with running_simulator(onboard_port=port) if "14540" in script else nullcontext():
        runpy.run_path(str(tmp_path / "example.py"), run_name="__main__")


def test_the_example_for_pytest_passes(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    (test,) = [block for block in blocks("python") if "def test_" in block]
    pytester.makepyfile(test)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    result = pytester.runpytest_subprocess(
        "-p", "mavlink_sim.pytest_plugin", "-p", "no:cacheprovider", timeout=100
    )
    result.assert_outcomes(passed=1)


def test_example_for_continuous_integration_is_list_of_steps() -> None:
    (block,) = blocks("yaml")
    steps = yaml.safe_load(block)
    assert all("run" in step or "uses" in step for step in steps)
    assert "--vehicle-logs=" in steps[1]["run"]


def test_vehicle_needs_only_documented_packages() -> None:
    code = """
import sys
for name in ("torch", "cv2", "zenoh", "mavsdk", "pydantic", "aioconsole", "yaml"):
    sys.modules[name] = None  # an import of it fails
sys.argv = ["mavlink-sim", "--help"]
import mavlink_sim.testing
from mavlink_sim.cli.main import main
main()
"""
    finished = subprocess.run(
        [sys.executable, "-c", code], env=environment(), capture_output=True, text=True, timeout=60
    )
    assert finished.returncode == 0, finished.stderr
    assert "--onboard-port" in finished.stdout
