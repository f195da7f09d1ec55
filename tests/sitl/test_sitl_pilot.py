"""A pilot's change of mode during each command, on the autopilot at COMPANION_SITL_URL: his mode stays.

He changes while the command's own mode is requested, and again while it is flown. Behaviours that need a
camera are flown by setpoints like these, and are tested in lockstep.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from mavlink_sim.wire.messages import dialect
from tests.sitl.sitl_harness import ARDUPILOT, HOLD, LAND, OFFBOARD, PX4, AutopilotLink, Flight, repeated

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
HEIGHT_M = 6.0
RETURN = {PX4: 4 << 16 | 5 << 24, ARDUPILOT: 6}
# Requests repeat every half second; a late one would show within this.
WATCHED_S = 4.0
COMMANDS = ("hold", "goto forward=20 right=0", "orbit radius=6 speed=2", "follow-path 0,0 20,0 20,20 speed=2")
MODES = {"land": LAND, "rtl": RETURN}
DELAYS_S, UNASKED_S = {"requested": 0.1, "flown": 1.5}, 0.5


def changed_when(link: AutopilotLink, moment: str, mode: int) -> Iterator[None]:
    """The pilot's change, once: a moment after the service's first request, or when its mode is flown.

    In OFFBOARD already, as after a take-off that it has finished, the service requests no mode.
    """
    requests, begun_s, since_s = len(link.commands), time.monotonic(), None
    while since_s is None:
        yield
        asked = any(number == dialect.MAV_CMD_DO_SET_MODE for _, number in link.commands[requests:])
        if asked or time.monotonic() - begun_s > UNASKED_S:
            since_s = time.monotonic()
    while time.monotonic() - since_s < DELAYS_S[moment]:
        yield
    link.set_mode(mode)
    while True:
        yield


@pytest.mark.parametrize("moment", DELAYS_S)
@pytest.mark.parametrize("command", [*COMMANDS, *MODES])
def test_pilots_mode_stays_during_a_command(flight: Flight, command: str, moment: str) -> None:
    link = flight.link
    flight.take_off(HEIGHT_M)
    link.after(1.0)
    autopilot = link.autopilot or 0
    # Neither the mode before the command nor the one that it requests.
    pilots = RETURN[autopilot] if command == "land" else LAND[autopilot]
    change = changed_when(link, moment, pilots)
    next(change)  # from here on
    with repeated(0.01, change):
        reply = flight.command(command)
        if reply["success"]:  # `hold` and `orbit` are answered when they are flown
            link.until(
                lambda: link.modes[-1][1] == pilots, 5.0, f"in {pilots:#x}: {reply}, {link.modes[-6:]}"
            )
    asked_s = time.monotonic()
    link.after(WATCHED_S)
    assert link.modes[-1][1] == pilots, (reply, link.modes[-6:])
    assert not [at for at in link.setpoints_s if at > asked_s + 0.3]
    flight.note(f"{command.partition(' ')[0]}, pilot when {moment}", last_mode_is_pilots=1.0)


def test_pilots_mode_stays_during_a_take_off(flight: Flight) -> None:
    link = flight.link
    autopilot = link.autopilot or 0
    climbing = dialect.MAV_LANDED_STATE_TAKEOFF, dialect.MAV_LANDED_STATE_IN_AIR

    def change() -> Iterator[None]:
        while link.landed not in climbing or link.height_m < 1.5:
            yield
        link.set_mode(LAND[autopilot])
        while True:
            yield

    with repeated(0.02, change()):
        reply = flight.command(f"takeoff {HEIGHT_M:g}")
    assert not reply["success"], reply
    link.after(WATCHED_S)
    assert link.modes[-1][1] in (LAND[autopilot], HOLD[autopilot]) or link.grounded, link.modes[-6:]
    assert link.modes[-1][1] != OFFBOARD[autopilot]
