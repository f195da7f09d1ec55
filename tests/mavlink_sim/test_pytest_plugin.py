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
def test_passing_test_leaves_no_files(run: Any, pytester: pytest.Pytester) -> None:
    result = run(
        ARMING
        + """
    def test_it(vehicle):
        arm(vehicle)
        print("vehicle", vehicle.pid)
    """,
        "--basetemp=temporary",
        "-s",
    )
    result.assert_outcomes(passed=1)
    (pid,) = re.findall(r"vehicle (\d+)", result.stdout.str())
    assert not Path(f"/proc/{pid}").exists()
    assert list(pytester.path.glob("temporary/vehicles/*")) == []


@pytest.mark.realtime
def test_failing_test_keeps_log_and_traffic_and_names_them(run: Any, pytester: pytest.Pytester) -> None:
    result = run(
        ARMING
        + """
    def test_it(vehicle):
        arm(vehicle)
        assert vehicle is None
    """,
        "--basetemp=temporary",
    )
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*- vehicle 1 -*", "log:*vehicle.log", "traffic:*gcs-1.tlog", "* armed"])
    (log,) = pytester.path.glob("temporary/vehicles/*test_it-1/vehicle.log")
    assert f"log:     {log}" in result.stdout.str()
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
def test_logs_folder_option_and_separate_runs(run: Any, pytester: pytest.Pytester) -> None:
    code = """
    def test_it(make_vehicle):
        make_vehicle(system_id=2)
        make_vehicle(system_id=3)
        assert False
    """
    result = run(code, "--vehicle-logs=artifacts")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*- vehicle 1 -*", "*- vehicle 2 -*"])
    folders = sorted(pytester.path.glob("artifacts/*"))
    output = [(folder / "vehicle.log").read_text() for folder in folders]
    assert ["ready: system 2" in output[0], "ready: system 3" in output[1]] == [True, True]


@pytest.mark.realtime
def test_nearest_marker_options_win(run: Any) -> None:
    result = run(
        """
    import pytest
    from pymavlink import mavutil

    pytestmark = pytest.mark.vehicle(system_id=9, speed=2, parameters={"COM_OF_LOSS_T": 0.5})

    def value(vehicle, system, name):
        link = mavutil.mavlink_connection(vehicle.pymavlink_device)
        beat = link.wait_heartbeat(timeout=20)
        assert beat.get_srcSystem() == system
        link.mav.param_request_read_send(system, 1, name, -1)
        found = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=20).param_value
        link.close()
        return found

    def test_the_module_s(vehicle):
        assert value(vehicle, 9, b"COM_OF_LOSS_T") == 0.5

    @pytest.mark.vehicle(system_id=7, parameters={"MIS_TAKEOFF_ALT": 7.0})
    def test_its_own(make_vehicle):
        first = make_vehicle()
        other = make_vehicle(system_id=8, parameters={"MIS_TAKEOFF_ALT": 8.0})
        assert value(other, 8, b"MIS_TAKEOFF_ALT") == 8.0
        assert value(first, 7, b"MIS_TAKEOFF_ALT") == 7.0
        assert value(first, 7, b"COM_OF_LOSS_T") == 0.5
    """,
        "--strict-markers",
    )
    result.assert_outcomes(passed=2)


@pytest.mark.realtime
def test_an_option_that_does_not_exist_is_named(run: Any) -> None:
    result = run(
        """
    import pytest

    @pytest.mark.vehicle(wnd=5)
    def test_a(vehicle): pass

    @pytest.mark.vehicle(parameters={"COM_OF": 1})
    def test_b(vehicle): pass

    @pytest.mark.vehicle(5)
    def test_c(vehicle): pass
    """
    )
    result.assert_outcomes(errors=3)
    result.stdout.fnmatch_lines(
        ["*No such option: --wnd*", "*no parameter 'COM_OF'*", "*takes options by name*"]
    )


@pytest.mark.realtime
def test_parallel_tests_have_separate_vehicles(run: Any) -> None:
    result = run(
        ARMING
        + """
    import pytest

    @pytest.mark.parametrize("number", range(2))
    def test_it(vehicle, number):
        arm(vehicle)
        assert number != 1
    """,
        *("-p", "xdist", "-n", "2", "--basetemp=temporary"),
    )
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*- vehicle 1 -*", "log:*vehicle.log"])


@pytest.mark.realtime
def test_killed_vehicle_log_has_exit_code(run: Any, pytester: pytest.Pytester) -> None:
    result = run(
        """
    def test_it(vehicle):
        vehicle.kill()
        assert False
    """,
        "--basetemp=temporary",
    )
    result.assert_outcomes(failed=1)
    (log,) = pytester.path.glob("temporary/vehicles/*test_it-1/vehicle.log")
    assert "code -9" in log.read_text()


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


@pytest.mark.realtime
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
    pytester.makepyfile("def test_it(vehicle): assert vehicle.onboard_port")
    pytester.runpytest_subprocess("-p", "no:cacheprovider", timeout=100).assert_outcomes(passed=1)
