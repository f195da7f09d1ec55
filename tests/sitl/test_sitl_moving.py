"""A car that turns at once, followed and circled by the autopilot at COMPANION_SITL_URL; rendered camera."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.companion.simulation.test_play import playing
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import AutopilotLink, Flight, bring_down
from tests.sitl.test_sitl_demo import make_ready

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
HEIGHT_M, FLIGHT_S = 4.0, 60.0
SCENE = """
[ground]
kinds = ["grass", "concrete"]
tile_texels = 256
texel_m = 0.05
[camera]
width = 400
height = 300
[[objects]]
class = "car"
appearance = 5
path = {{ {path} }}
"""
SQUARE = "[[12.0, 6.0], [24.0, 6.0], [24.0, -6.0], [12.0, -6.0]]"
LINE = "[[14.0, -6.0], [14.0, 6.0]]"
SPEED_MPS, STOP_S = 3.0, 4.0


def stops(*corners_m: tuple[float, float]) -> list[list[float]]:
    """A path with a stop at each corner: there the car moves to and fro by a centimetre."""
    to_and_fro = round(STOP_S * SPEED_MPS / 0.02)
    return [[north, east + by] for north, east in corners_m for by in (0.0, 0.01) * to_and_fro]


PATHS = {
    "right angles": f'waypoints_m = {SQUARE}, speed_mps = 1.5, repeat = "loop"',
    "right angles, fast": f'waypoints_m = {SQUARE}, speed_mps = {SPEED_MPS}, repeat = "loop"',
    "back": f'waypoints_m = {LINE}, speed_mps = 1.5, repeat = "back_and_forth"',
    "a stop": f'waypoints_m = [[14.0, -6.0], [14.0, 12.0]], speed_mps = {SPEED_MPS}, repeat = "once"',
    "stops and starts": f"waypoints_m = {stops((14.0, -6.0), (14.0, 9.0))}, speed_mps = {SPEED_MPS}, "
    'repeat = "back_and_forth", yaw_deg = 90.0',
}


@pytest.mark.parametrize(
    ("command", "path"),
    [*(("follow car distance=9", name) for name in PATHS), ("orbit car radius=9 speed=2", "right angles")],
)
def test_car_that_turns_at_once_is_kept_for_a_minute(
    link: AutopilotLink, services: Services, tmp_path: Path, command: str, path: str
) -> None:
    make_ready(link, services)
    scene = tmp_path / "car.toml"
    scene.write_text(SCENE.format(path=PATHS[path]))
    flags = ["--vehicle-url", f"udpin://127.0.0.1:{link.service_port}", "--scene", str(scene)]
    flags += ["--guidance-min-battery-percent", "0", "--guidance-obstacles", "off"]
    flags += ["--detector-image-size", "320", "--detector-threads", "1"]
    try:
        with playing(tmp_path, *flags, quick=False) as running, running.client() as session:
            flight = Flight(link, running, session, "pymavlink")
            flight.take_off(HEIGHT_M)
            flight.fly(f"goto 0 0 altitude={HEIGHT_M:g} heading=0")
            begun = len(flight.events)
            flight.fly(command)
            link.after(FLIGHT_S)
            print(path, command, flight.status.get("guidance"), flight.events[begun:])
            assert not [text for text in flight.events[begun:] if "lost" in text or "ended" in text]
    finally:
        bring_down(link)
