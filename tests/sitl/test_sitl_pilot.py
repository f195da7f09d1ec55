"""A pilot's change of mode during each command, on the autopilot at COMPANION_SITL_URL: his mode stays.

He changes while the command's own mode is requested, and again while it is flown. What needs a camera, flown
only, has one that is rendered from the autopilot's pose; a car and a landing pad are before the vehicle.
"""

from __future__ import annotations

import math
import secrets
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from companion.bus.client import listen
from mavlink_sim.testing import free_port
from mavlink_sim.wire.messages import dialect
from tests.companion.service_process import running_service
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import (
    ARDUPILOT,
    HOLD,
    LAND,
    OFFBOARD,
    PX4,
    READY_S,
    AutopilotLink,
    Flight,
    bring_down,
    repeated,
)
from vision.attitude import wrap_angle

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
HEIGHT_M = 6.0
RETURN = {PX4: 4 << 16 | 5 << 24, ARDUPILOT: 6}
# Requests repeat every half second; a late one would show within this.
WATCHED_S = 4.0
# A command that is flown for 1.5 s has moved or turned the vehicle by so much.
MOVED_M, TURNED_RAD = 0.4, 0.2
COMMANDS = ("hold", "goto forward=20 right=0", "orbit radius=6 speed=2", "follow-path 0,0 20,0 20,20 speed=2")
MODES = {"land": LAND, "rtl": RETURN}
CAR_M, PAD_M, PAD_ID = 16.0, 1.5, 4
SEEN_FRAMES, SEEING_S = 10, 60.0
SIGHTED = (
    "seek boat",
    "seek boat pattern=square radius=12 spacing=6",
    "approach car distance=4",
    "follow car distance=6",
    "orbit car radius=8 speed=2",
    "patrol 0,0 20,0 classes=boat",
    "policy approach car distance=6",
    f"land-on-marker {PAD_ID}",
)
AHEAD_DEG, DOWN_DEG = -10.0, -90.0
# North of where the camera starts.
SCENE = f"""
[ground]
kinds = ["concrete"]
tile_texels = 256
texel_m = 0.05
[[objects]]
class = "car"
place_m = [{CAR_M}, 0.0]
yaw_deg = 90
[[plates]]
dictionary = "APRILTAG_36h11"
id = {PAD_ID}
size_m = 0.8
place_m = [{PAD_M}, 0.0]
[camera]
width = 320
height = 240
horizontal_fov_deg = 80
[camera.mount]
pitch_deg = """
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


@contextmanager
def rendered_camera(link: AutopilotLink, scene: Path) -> Iterator[str]:
    """A camera at the autopilot's pose, in a world that begins there; the name of its shared memory."""
    name, port = f"sitl-{secrets.token_hex(6)}", free_port()
    command = [sys.executable, "-m", "mavlink_sim", "camera", "--vehicle-url", f"udpin://127.0.0.1:{port}"]
    command += ["--scene", str(scene), "--camera", name, "--camera-rate", "8"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    link.camera_port = port
    try:
        assert process.stdout is not None
        next(line for line in iter(process.stdout.readline, "") if line.startswith("ready: "))
        yield name
    finally:
        link.camera_port = None
        process.terminate()
        process.communicate(timeout=10.0)


@contextmanager
def sighted_flight(
    link: AutopilotLink, driver: str, services: Services, folder: Path, pitch_deg: float
) -> Iterator[Flight]:
    """As the fixture `flight`, with a camera whose lens has this pitch."""
    bring_down(link)
    services.close()  # its own service takes the port
    scene = folder / "scene.toml"
    scene.write_text(f"{SCENE}{pitch_deg}\n")
    with rendered_camera(link, scene) as name:
        flags = [
            "--source", f"shm://{name}", "--driver", driver, "--vehicle-system-id", str(link.system_id),
            "--detector-image-size", "320", "--markers-dictionary", "APRILTAG_36h11",
            "--guidance-min-battery-percent", "0", "--guidance-perception-max-age-s", "1.0",
        ]  # fmt: skip
        with (
            running_service(link.service_port, flags, cwd=folder) as service,
            service.client() as session,
        ):
            seen: list[str] = []
            subscriber = listen(session, "detections", lambda _, text: seen.append(text))
            link.until(lambda: link.ready, READY_S, "ready to be armed")
            link.until(lambda: len(seen) > SEEN_FRAMES, SEEING_S, "seen by the detector")
            yield Flight(link, service, session, driver)
            subscriber.undeclare()  # type: ignore[no-untyped-call]
    bring_down(link)


def change_during(flight: Flight, command: str, moment: str) -> None:
    """A pilot changes the mode during a command: his mode stays, and no setpoint follows."""
    link = flight.link
    link.after(1.0)
    autopilot = link.autopilot or 0
    # Neither the mode before the command nor the one that it requests.
    pilots = RETURN[autopilot] if command == "land" else LAND[autopilot]
    change = changed_when(link, moment, pilots)
    next(change)  # from here on
    begun_s = time.monotonic()
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
    flown_s = link.modes[-1][0] - begun_s
    sent = sum(begun_s < at < link.modes[-1][0] for at in link.setpoints_s)
    flight.note(f"{command}, pilot when {moment}", last_mode_is_pilots=1.0, flown_s=flown_s, setpoints=sent)


@pytest.mark.parametrize("moment", DELAYS_S)
@pytest.mark.parametrize("command", [*COMMANDS, *MODES])
def test_pilots_mode_stays_during_a_command(flight: Flight, command: str, moment: str) -> None:
    flight.take_off(HEIGHT_M)
    change_during(flight, command, moment)


@pytest.mark.parametrize("command", SIGHTED)
def test_pilots_mode_stays_with_a_camera(
    link: AutopilotLink, driver: str, services: Services, tmp_path: Path, command: str
) -> None:
    landing = command.startswith("land-on-marker")
    with sighted_flight(link, driver, services, tmp_path, DOWN_DEG if landing else AHEAD_DEG) as flight:
        flight.take_off(4.0)
        flight.fly("goto forward=0 right=0 heading=0")
        if not landing:
            flight.fly("seek car")
        start, begun_s = link.poses[-1], time.monotonic()
        change_during(flight, command, "flown")
        flown = link.trajectory(begun_s, link.modes[-1][0])
        moved_m = max(math.dist(pose.position_ned_m, start.position_ned_m) for pose in flown)
        turned_rad = max(abs(wrap_angle(pose.yaw_rad - start.yaw_rad)) for pose in flown)
        assert moved_m > MOVED_M or turned_rad > TURNED_RAD


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
