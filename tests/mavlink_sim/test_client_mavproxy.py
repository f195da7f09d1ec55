"""MAVProxy as a ground station, driven by typed commands.

MAVProxy is GPL, and asks for matplotlib, VTK and another OpenCV: it is a tool of this test alone, in an
environment of its own (`make programs`).
"""

from __future__ import annotations

import os
import re
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from mavlink_sim.physics.geography import HOME_ALTITUDE_M
from mavlink_sim.testing import QUICK_FLIGHT, RunningSimulator, vehicle
from tests.programs import MAVPROXY

pytestmark = [pytest.mark.needs("MAVProxy"), pytest.mark.realtime]
MODULES = "param,arm,mode,wp,cmdlong,link,misc"
# PX4's main and sub modes: MAVProxy 1.8.75 knows their names, but hands pymavlink all three numbers as one
TAKEOFF, MISSION, LAND = "4 2", "4 4", "4 6"
PX4, COPTER = ("px4", QUICK_FLIGHT), ("ardupilot", {"LAND_SPEED": 200})


class Console:
    """A running MAVProxy: type a line, wait for output."""

    def __init__(self, device: str, folder: Path) -> None:
        self.output: list[str] = []
        self._changed = threading.Condition()
        assert MAVPROXY is not None
        self.process = subprocess.Popen(
            [
                *(MAVPROXY, f"--master={device}"),
                *(f"--state-basedir={folder}", f"--default-modules={MODULES}", "--aircraft=test"),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=folder,
            env={**os.environ, "HOME": str(folder), "PYTHONUNBUFFERED": "1"},  # nobody's .mavinit.scr
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._changed:
                self.output.append(line.rstrip("\n"))
                self._changed.notify_all()

    def type(self, line: str) -> int:
        """Returns the number of lines printed before."""
        assert self.process.stdin is not None
        before = len(self.output)
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return before

    def wait_for(self, pattern: str, since: int = 0, limit_s: float = 40.0) -> re.Match[str]:
        """The first line, from `since` on, in which the pattern is found."""

        def found() -> re.Match[str] | None:
            return next((hit for line in self.output[since:] if (hit := re.search(pattern, line))), None)

        with self._changed:
            self._changed.wait_for(lambda: found() is not None, limit_s)
        hit = found()
        assert hit is not None, f"no {pattern!r} in {self.output[since:]}"
        return hit

    def ask(self, line: str, pattern: str, limit_s: float = 10.0) -> re.Match[str]:
        """Type a line, repeatedly if needed, until the answer is printed."""
        deadline = time.monotonic() + limit_s
        while True:
            since = self.type(line)
            try:
                return self.wait_for(pattern, since, 1.0)
            except AssertionError:
                if time.monotonic() > deadline:
                    raise

    def end(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.kill()  # with SIGTERM it waits for one more line of input
        self.process.wait()
        self._reader.join(10.0)
        self.process.stdin.close()
        self.process.stdout.close()


@pytest.fixture
def simulator(request: pytest.FixtureRequest) -> Iterator[RunningSimulator]:
    # MAVProxy cannot keep up with a faster one
    autopilot, parameters = getattr(request, "param", PX4)
    with vehicle(autopilot=autopilot, parameters=parameters) as running:
        yield running


@pytest.fixture
def console(simulator: RunningSimulator, tmp_path: Path) -> Iterator[Console]:
    mavproxy = Console(simulator.gcs_pymavlink_device, tmp_path)
    try:
        mavproxy.wait_for("online system 1")
        yield mavproxy
    finally:
        mavproxy.end()


# With QUICK_FLIGHT from the start its `param fetch` does not end: cause not known.
@pytest.mark.parametrize("simulator", [("px4", {})], ids=["px4"], indirect=True)
def test_it_connects_sets_parameters_and_flies(simulator: RunningSimulator, console: Console) -> None:
    count = int(console.wait_for(r"Received (\d+) parameters")[1])
    since = console.type("param fetch")
    assert int(console.wait_for(r"Received (\d+) parameters", since)[1]) == count > 250
    assert float(console.ask("param show COM_OF_LOSS_T", r"COM_OF_LOSS_T\s+(\S+)")[1]) == 1.0
    console.type("param set MIS_TAKEOFF_ALT 1.5")
    console.ask("param show MIS_TAKEOFF_ALT", r"MIS_TAKEOFF_ALT\s+1\.5")
    console.type("param set NAV_RCL_ACT 3")  # an integer, bytewise
    console.ask("param show NAV_RCL_ACT", r"NAV_RCL_ACT\s+3")
    for name, value in QUICK_FLIGHT.items():
        console.type(f"param set {name} {value:g}")
        console.ask(f"param show {name}", rf"{name}\s+{value:g}")

    console.ask("disarm", "COMPONENT_ARM_DISARM: ACCEPTED")  # it is disarmed: no error
    console.type(f"long DO_SET_MODE 1 {TAKEOFF}")
    simulator.wait_for_event("mode TAKEOFF")
    console.type("arm throttle")
    simulator.wait_for_event("takeoff")
    console.wait_for("ARMED")
    console.ask("disarm", "COMPONENT_ARM_DISARM: TEMPORARILY_REJECTED")  # in the air
    simulator.wait_for_event("mode HOLD")
    console.type("long NAV_RETURN_TO_LAUNCH")
    simulator.wait_for_event("mode RTL")
    console.type(f"long DO_SET_MODE 1 {LAND}")
    simulator.wait_for_event("disarmed (after landing)")
    console.wait_for("DISARMED")


def test_takeoff_altitude_is_amsl_as_in_px4(simulator: RunningSimulator, console: Console) -> None:
    console.wait_for(r"Received (\d+) parameters")
    console.ask("arm throttle", "COMPONENT_ARM_DISARM: ACCEPTED")
    since = console.type(f"takeoff {HOME_ALTITUDE_M + 4.0}")
    console.wait_for("NAV_TAKEOFF: ACCEPTED", since)
    simulator.wait_for_event("mode HOLD")
    height = console.ask("status LOCAL_POSITION_NED", r"LOCAL_POSITION_NED.* z : (-?[\d.]+)")
    assert float(height[1]) == pytest.approx(-4.0, abs=0.8)


@pytest.mark.parametrize("simulator", [COPTER], ids=["ardupilot"], indirect=True)
def test_a_copter_is_flown_by_the_names_of_its_modes(simulator: RunningSimulator, console: Console) -> None:
    console.wait_for(r"Received (\d+) parameters")
    console.ask("mode GUIDED", "Mode GUIDED")
    console.ask("arm throttle", "COMPONENT_ARM_DISARM: ACCEPTED")
    since = console.type("takeoff 2")
    console.wait_for("NAV_TAKEOFF: ACCEPTED", since)
    simulator.wait_for_event("takeoff")
    console.ask("status GLOBAL_POSITION_INT", r"relative_alt : (1[7-9]|2\d)\d\d", 30.0)
    console.ask("mode BRAKE", "Mode BRAKE")
    console.ask("mode LAND", "Mode LAND")
    simulator.wait_for_event("disarmed", 60.0)


# A file for an ArduPilot begins with the home position; to a PX4 every line is an item to fly.
MISSION_FILE = """QGC WPL 110
0\t1\t3\t22\t0\t0\t0\t0\t47.3977432\t8.5455942\t4.0\t1
1\t0\t3\t16\t0\t0\t0\t0\t47.3978000\t8.5455942\t4.0\t1
2\t0\t3\t21\t0\t0\t0\t0\t47.3978000\t8.5455942\t0.0\t1
"""


def test_it_loads_a_mission_and_flies_it(
    simulator: RunningSimulator, console: Console, tmp_path: Path
) -> None:
    console.wait_for(r"Received (\d+) parameters")
    (tmp_path / "mission.txt").write_text(MISSION_FILE)
    since = console.type("wp load mission.txt")
    console.wait_for("Sent all 3 waypoints", since)
    since = console.type("wp list")
    console.wait_for("Requesting 3 waypoints", since)
    console.type(f"long DO_SET_MODE 1 {MISSION}")
    simulator.wait_for_event("mode MISSION")
    console.ask("arm throttle", "COMPONENT_ARM_DISARM: ACCEPTED")
    simulator.wait_for_event("takeoff")
    simulator.wait_for_event("disarmed (after landing)", 60.0)


def test_it_lists_files(console: Console) -> None:
    console.wait_for(r"Received (\d+) parameters")
    since = console.type("module load ftp")
    console.wait_for("Loaded module ftp", since)
    since = console.type("ftp list /")
    console.wait_for("Total size", since)
