"""The pytest plugin, in separate pytest runs."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

pytest_plugins = ["pytester"]

ROOT = Path(__file__).parents[2]
PLUGINS = ("-p", "mavlink_sim.pytest_plugin", "-p", "no:cacheprovider")

ARMING = """
    from pymavlink import mavutil

    def arm(vehicle):
        link = mavutil.mavlink_connection(vehicle.pymavlink_device, source_system=245)
        link.wait_heartbeat(timeout=20)
        link.mav.command_long_send(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
        vehicle.wait_for_event("armed")
        link.close()
"""


@pytest.fixture
def run(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs pytest in its own process over a test file, with only this plugin."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))

    def start(code: str, *arguments: str) -> pytest.RunResult:
        pytester.makepyfile(code)
        return pytester.runpytest_subprocess(*PLUGINS, *arguments, timeout=100)

    return start


@pytest.mark.realtime
def test_vehicles_of_a_run(run: Any, pytester: pytest.Pytester) -> None:
    """The options of the nearest marker, an option that does not exist, and what tests leave behind."""
    result = run(
        ARMING
        + """
    import pytest

    pytestmark = pytest.mark.vehicle(system_id=9, speed=2, parameters={"COM_OF_LOSS_T": 0.5})

    def value(vehicle, system, name):
        link = mavutil.mavlink_connection(vehicle.pymavlink_device)
        beat = link.wait_heartbeat(timeout=20)
        assert beat.get_srcSystem() == system
        link.mav.param_request_read_send(system, 1, name, -1)
        found = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=20).param_value
        link.close()
        return found

    def test_passes(vehicle):
        assert value(vehicle, 9, b"COM_OF_LOSS_T") == 0.5
        print("vehicle", vehicle.pid)

    @pytest.mark.vehicle(system_id=7, parameters={"MIS_TAKEOFF_ALT": 7.0})
    def test_its_own(make_vehicle):
        first = make_vehicle()
        other = make_vehicle(system_id=8, parameters={"MIS_TAKEOFF_ALT": 8.0})
        assert value(other, 8, b"MIS_TAKEOFF_ALT") == 8.0
        assert value(first, 7, b"MIS_TAKEOFF_ALT") == 7.0
        assert value(first, 7, b"COM_OF_LOSS_T") == 0.5
        assert False

    @pytest.mark.vehicle(system_id=1)
    def test_fails(vehicle):
        arm(vehicle)
        assert vehicle is None

    def test_kills(vehicle):
        vehicle.kill()
        assert False

    @pytest.mark.vehicle(wnd=5)
    def test_a(vehicle): pass

    @pytest.mark.vehicle(parameters={"COM_OF": 1})
    def test_b(vehicle): pass

    @pytest.mark.vehicle(5)
    def test_c(vehicle): pass
    """,
        *("--basetemp=temporary", "--strict-markers", "-rP"),
    )
    result.assert_outcomes(passed=1, failed=3, errors=3)
    result.stdout.fnmatch_lines(
        ["*No such option: --wnd*", "*no parameter 'COM_OF'*", "*takes options by name*"]
    )
    result.stdout.fnmatch_lines(
        ["*- vehicle 1 -*", "log:*-1/vehicle.log", "*- vehicle 2 -*", "log:*-2/vehicle.log"]
    )
    result.stdout.fnmatch_lines(["log:*test_fails-1/vehicle.log", "traffic:*gcs-1.tlog", "* armed"])
    (pid,) = re.findall(r"vehicle (\d+)\n", result.stdout.str())
    assert not Path(f"/proc/{pid}").exists()
    (log,) = pytester.path.glob("temporary/vehicles/*test_fails-1/vehicle.log")
    (killed,) = pytester.path.glob("temporary/vehicles/*test_kills-1/vehicle.log")
    own = set(pytester.path.glob("temporary/vehicles/*test_its_own-*"))
    assert len(own) == 2
    assert set(pytester.path.glob("temporary/vehicles/*")) == {log.parent, killed.parent} | own
    assert f"log:     {log}" in result.stdout.str()
    assert "code -9" in killed.read_text()
    lines = log.read_text().splitlines()
    assert "ready: system 1" in lines[0]
    assert lines[1].endswith(" armed")
    assert lines[-2].endswith(" stopped")  # the log goes on to the end, beyond what the report shows
    record = mavutil.mavlink_connection(str(log.with_name("onboard-1.tlog")))
    kinds = set()
    while (message := record.recv_match()) is not None:
        kinds.add((message.get_srcSystem(), message.get_type()))
    record.close()
    assert {(245, "COMMAND_LONG"), (1, "COMMAND_ACK"), (1, "HEARTBEAT")} <= kinds  # both directions


@pytest.mark.realtime
def test_parallel_tests_have_separate_vehicles(run: Any, pytester: pytest.Pytester) -> None:
    result = run(
        ARMING
        + """
    import pytest

    @pytest.mark.parametrize("number", range(2))
    def test_it(make_vehicle, number):
        arm(make_vehicle())
        assert number != 1
    """,
        *("-p", "xdist", "-n", "2", "--vehicle-logs=artifacts"),
    )
    result.assert_outcomes(passed=1, failed=1)
    (log,) = pytester.path.glob("artifacts/*/vehicle.log")
    assert log.read_text().splitlines()[1].endswith(" armed")


def test_loading_the_plugin_loads_nothing_heavy() -> None:
    code = (
        "import sys, pytest; before = set(sys.modules); import mavlink_sim.pytest_plugin; "
        "print(*sorted(set(sys.modules) - before))"
    )
    finished = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True, timeout=60
    )
    loaded = set(finished.stdout.split())
    assert "mavlink_sim.pytest_plugin" in loaded
    assert not {"numpy", "pymavlink", "typer", "cv2", "mavlink_sim.testing"} & loaded


def test_installed_package_provides_plugin(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    site = pytester.path / "site"
    information = site / "mavlink_sim_elsewhere-1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: mavlink-sim-elsewhere\nVersion: 1.0\n"
    )
    lines = [f"{name} = {target}" for name, target in project["entry-points"]["pytest11"].items()]
    (information / "entry_points.txt").write_text("\n".join(["[pytest11]", *lines]))
    monkeypatch.setenv("PYTHONPATH", f"{site}:{ROOT}")
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider", "--fixtures", timeout=100)
    result.stdout.fnmatch_lines(["make_vehicle -- *", "vehicle -- *mavlink_sim/pytest_plugin.py:*"])
