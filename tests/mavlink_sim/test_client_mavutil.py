"""pymavlink's mavutil and mavparm as a client."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavparm, mavutil

from mavlink_sim.testing import QUICK_FLIGHT, RunningSimulator, vehicle

pytestmark = pytest.mark.realtime

SPEED = 4.0
REAL32, INT32 = 9, 6


@pytest.fixture(scope="module")
def simulator() -> Iterator[RunningSimulator]:
    with vehicle(speed=SPEED, parameters=QUICK_FLIGHT) as running:
        yield running


@pytest.fixture
def link(simulator: RunningSimulator) -> Iterator[Any]:
    """To the vehicle on the ground, in LOITER."""
    connection = mavutil.mavlink_connection(simulator.pymavlink_device, source_system=255)
    assert connection.wait_heartbeat(timeout=20) is not None
    yield connection
    if connection.motors_armed():  # the test failed in the air
        connection.set_mode("LAND")
        connection.motors_disarmed_wait()
    connection.set_mode("LOITER")
    until(connection, lambda: connection.flightmode == "LOITER")
    connection.close()


def until(link: Any, condition: Callable[[], bool], limit_s: float = 40.0) -> None:
    """Read messages until `condition` holds."""
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, f"still {link.flightmode}"
        assert link.recv_match(blocking=True, timeout=10.0) is not None, "the vehicle fell silent"


def test_it_arms_takes_off_changes_modes_and_lands(simulator: RunningSimulator, link: Any) -> None:
    assert (link.target_system, link.flightmode, link.motors_armed()) == (1, "LOITER", 0)
    link.arducopter_arm()
    link.motors_armed_wait()
    link.set_mode("TAKEOFF")
    until(link, lambda: link.location().alt > 490.8)
    link.set_mode("LOITER")
    until(link, lambda: link.flightmode == "LOITER")
    link.set_mode_rtl()
    until(link, lambda: link.flightmode == "RTL")
    link.set_mode("LAND")
    until(link, lambda: link.flightmode == "LAND")
    link.motors_disarmed_wait()
    assert simulator.wait_for_event("disarmed (after landing)")


def test_every_named_mode_is_accepted_and_reported(link: Any) -> None:
    refused = {"RATTITUDE", "RTGS"}  # modes that PX4 has no more
    for name in link.mode_mapping():
        link.recv_match(type="COMMAND_ACK")
        link.set_mode(name)
        answers = [link.recv_match(type="COMMAND_ACK", blocking=True, timeout=10).result for _ in range(2)]
        assert answers == [0, 1 if name in refused else 0]
        if name not in refused:
            until(link, lambda name=name: link.flightmode == name)  # type: ignore[misc]


def test_all_parameters_are_fetched_written_and_saved(
    simulator: RunningSimulator, link: Any, tmp_path: Path
) -> None:
    parameters = mavparm.MAVParmDict()
    link.param_fetch_all()
    deadline = time.monotonic() + 30.0
    count = 0
    while "_HASH_CHECK" not in parameters or len(parameters) < count + 1:
        assert time.monotonic() < deadline, len(parameters)
        message = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=5.0)
        if message is None:  # one was lost, as any datagram on a busy machine
            link.param_fetch_all()
            continue
        count = message.param_count
        parameters[message.param_id] = message.param_value
    assert parameters["COM_OF_LOSS_T"] == 1.0
    assert parameters.mavset(link, "MIS_TAKEOFF_ALT", 3.0, retries=3)
    assert parameters.mavset(link, "NAV_RCL_ACT", 3, retries=3, parm_type=INT32)
    link.param_fetch_one("NAV_RCL_ACT")
    answer = link.recv_match(
        type="PARAM_VALUE", condition="PARAM_VALUE.param_id=='NAV_RCL_ACT'", blocking=True, timeout=10
    )
    assert answer.param_type == INT32
    parameters.save(str(tmp_path / "saved.parm"))
    assert "MIS_TAKEOFF_ALT" in (tmp_path / "saved.parm").read_text()
