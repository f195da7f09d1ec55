"""Many vehicles in one process: ids, ports, start positions, seeds, one clock."""

import json
import math
import re
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.realtime import simulation
from mavlink_sim.realtime.fleet import instance_options, start_positions
from mavlink_sim.realtime.options import SimulationOptions
from mavlink_sim.testing import free_udp_port_range, running_simulator
from mavlink_sim.vehicles.vehicle import Vehicle

pytestmark = pytest.mark.realtime

METRE_DEG = math.degrees(1.0 / 6371000.0)


def test_ids_and_ports_count_up_as_in_px4s_sitl() -> None:
    members = instance_options(SimulationOptions(seed=10), 20, 5.0)
    assert [one.system_id for one in members] == list(range(1, 21))
    assert [one.onboard_port for one in members] == list(range(14540, 14560))
    assert [one.onboard_bind for one in members] == list(range(14580, 14600))
    assert {one.gcs_port for one in members} == {14550}
    assert [one.gcs_bind for one in members] == list(range(18570, 18590))
    assert [one.seed for one in members] == list(range(10, 30))


def test_start_positions_are_a_grid() -> None:
    grid = start_positions(20, 5.0)
    assert grid[0] == (0.0, 0.0)
    assert len(set(grid)) == 20
    assert max(max(position) for position in grid) == 20.0
    assert min(math.dist(a, b) for a in grid for b in grid if a != b) == 5.0


def test_camera_on_one_vehicle_and_each_has_its_own_truth_file() -> None:
    options = SimulationOptions(camera="eye", truth=Path("truth.jsonl"))
    members = instance_options(options, 3, 5.0)
    assert [one.camera for one in members] == ["eye", None, None]
    assert [one.camera for one in instance_options(options, 3, 5.0, camera_vehicle=2)] == [None, "eye", None]
    several = instance_options(options, 4, 5.0, camera_vehicle=2, cameras=2)
    assert [one.camera for one in several] == [None, "eye", "eye-3", None]
    assert [str(one.truth) for one in members] == ["truth.jsonl", "truth-2.jsonl", "truth-3.jsonl"]


def test_each_vehicle_has_its_home_and_local_frame() -> None:
    first = LockstepVehicle(noise=False)
    second = LockstepVehicle(noise=False, start_ned_m=(10.0, 20.0))
    for vehicle in (first, second):  # in turns, as a fleet's are
        vehicle.step(2.0)
    for _ in range(3):
        for vehicle in (first, second):
            vehicle.step(1.0)
    here, there = (vehicle.newest["onboard"]["GLOBAL_POSITION_INT"] for vehicle in (first, second))
    assert (there.lat - here.lat) * 1e-7 == pytest.approx(10.0 * METRE_DEG, rel=0.01)
    east = 20.0 * METRE_DEG / math.cos(math.radians(47.4))
    assert (there.lon - here.lon) * 1e-7 == pytest.approx(east, rel=0.01)
    local = second.newest["onboard"]["LOCAL_POSITION_NED"]
    assert (local.x, local.y) == (0.0, 0.0)
    origin, home = (second.newest["onboard"][name] for name in ("GPS_GLOBAL_ORIGIN", "HOME_POSITION"))
    assert (origin.latitude, origin.longitude) == (there.lat, there.lon) == (home.latitude, home.longitude)


def test_global_position_reached_from_another_start() -> None:
    vehicle = LockstepVehicle({"onboard": {}}, noise=False, gusts_mps=0.0, start_ned_m=(10.0, 20.0))
    vehicle.take_off(5.0)
    # SIH's home, ten metres south and twenty west of where this one started
    position = (47.397743225, 8.545594215, 494.4)
    assert vehicle.command(192, -1.0, 1.0, 0.0, math.nan, *position) == "ACCEPTED"
    vehicle.step(25.0)
    north, east, _ = vehicle.truth.position_ned_m
    assert (north, east) == pytest.approx((-10.0, -20.0), abs=0.7)
    assert vehicle.vehicle.local_frame.local(*position) == pytest.approx((-10.0, -20.0, -5.0))


def received(port: int, wanted: set[int], limit_s: float = 40.0) -> dict[int, dict[str, Any]]:
    """The newest messages by system and type, once each given system has sent its position."""
    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=245)
    newest: dict[int, dict[str, Any]] = defaultdict(dict)
    deadline = time.monotonic() + limit_s
    try:
        while time.monotonic() < deadline:
            message = link.recv_match(blocking=True, timeout=1)
            if message is not None and not message.get_type().startswith(("BAD_DATA", "UNKNOWN")):
                newest[message.get_srcSystem()][message.get_type()] = message
            if all({"HEARTBEAT", "GLOBAL_POSITION_INT"} <= set(newest[system]) for system in wanted):
                return dict(newest)
    finally:
        link.close()
    raise AssertionError(f"received {sorted(newest)} of {sorted(wanted)}")


def test_fleet_sends_on_its_ports(tmp_path: Path) -> None:
    ready = tmp_path / "ready.json"
    with running_simulator(vehicles=3, spacing=50.0, ready_file=ready) as simulator:
        assert [one.system_id for one in simulator.vehicles] == [1, 2, 3]
        ports = [one.onboard_port for one in simulator.vehicles]
        assert ports == list(range(ports[0], ports[0] + 3))
        assert {one.gcs_port for one in simulator.vehicles} == {simulator.gcs_port}
        everybody = received(simulator.gcs_port, {1, 2, 3})  # all send to one ground station
        assert len({position["GLOBAL_POSITION_INT"].lon for position in everybody.values()}) >= 2
        assert set(received(ports[1], {2})) == {2}  # and each to its own companion
        report = json.loads(ready.read_text())
        assert [one["system_id"] for one in report["vehicles"]] == [1, 2, 3]
        third = simulator.vehicles[2]
        link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{third.onboard_port}", source_system=3)
        link.wait_heartbeat(timeout=30)
        link.mav.command_long_send(3, 1, 176, 0, 1, 4, 6, 0, 0, 0, 0)
        simulator.wait_for_event("vehicle 3: mode LAND", 30.0)
        link.close()


def test_a_range_of_ports_is_free() -> None:
    start = free_udp_port_range(5)
    assert 1024 < start <= 65531


def test_too_slow_machine_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr("mavlink_sim.realtime.simulation.time.monotonic", lambda: now_s)
    reports: list[str] = []
    pace = simulation._Pace(20.0, reports.append)
    pace.lose(25.0)
    now_s += 2.0
    pace.report()
    assert reports == []  # not for every short delay
    now_s += 3.0
    pace.report()
    assert len(reports) == 1
    assert re.findall(r"\d[\d.]*", reports[0]) == ["15.00", "5", "20"]
    now_s += 6.0
    pace.report()
    assert len(reports) == 1  # nothing lost since


def test_a_fleet_flies_in_one_wind_with_the_same_gusts() -> None:
    fleet = instance_options(SimulationOptions(seed=7, wind_mps=5.0), 3, 5.0)
    vehicles = [
        Vehicle(seed=one.seed, air_seed=one.world_seed, wind_mps=one.wind_mps, ready_after_s=0.0)
        for one in fleet
    ]
    gusts = []
    for start_s, vehicle in enumerate(vehicles):  # none is in the air for as long as another
        vehicle.step(1.0 + start_s)
        vehicle.autopilot.arm()
        vehicle.autopilot.takeoff(5.0)
        vehicle.step(19.0 - start_s)
        gusts.append((vehicle.airframe.wind, vehicle.airframe._gust))
    assert gusts[0] == gusts[1] == gusts[2]
    assert any(gusts[0][1])
    other = instance_options(SimulationOptions(seed=8, wind_mps=5.0), 3, 5.0)[0]
    other_autopilot = Vehicle(seed=other.seed, air_seed=other.world_seed, wind_mps=5.0)
    other_autopilot.step(20.0)
    assert (other_autopilot.airframe.wind, other_autopilot.airframe._gust) != gusts[0]
    assert len({vehicle.estimate.drift for vehicle in vehicles}) == 3


def test_a_fleet_sees_one_world() -> None:
    assert {one.world_seed for one in instance_options(SimulationOptions(seed=7), 3, 5.0)} == {7}
    assert instance_options(SimulationOptions(seed=7), 1, 5.0)[0].world_seed is None
