"""A car that turns at once, followed and circled by the autopilot at COMPANION_SITL_URL; rendered camera."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.companion.test_play import playing
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
path = {{ waypoints_m = {waypoints}, speed_mps = {speed}, repeat = "{repeat}" }}
"""
SQUARE = "[[12.0, 6.0], [24.0, 6.0], [24.0, -6.0], [12.0, -6.0]]"
LINE = "[[14.0, -6.0], [14.0, 6.0]]"
PATHS = {
    "right angles": (SQUARE, 1.5, "loop"),
    "right angles, fast": (SQUARE, 3.0, "loop"),
    "back": (LINE, 1.5, "back_and_forth"),
    "stops": ("[[14.0, -6.0], [14.0, 12.0]]", 3.0, "once"),
}


@pytest.mark.parametrize(
    ("command", "path"),
    [*(("follow car distance=9", name) for name in PATHS), ("orbit car radius=9 speed=2", "right angles")],
)
def test_car_that_turns_at_once_is_kept_for_a_minute(
    link: AutopilotLink, services: Services, tmp_path: Path, command: str, path: str
) -> None:
    make_ready(link, services)
    waypoints, speed, repeat = PATHS[path]
    scene = tmp_path / "car.toml"
    scene.write_text(SCENE.format(waypoints=waypoints, speed=speed, repeat=repeat))
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
