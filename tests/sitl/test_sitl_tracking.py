"""A station's rectangle through the forwarding of the autopilot at COMPANION_SITL_URL; rendered camera."""

from __future__ import annotations

import os
import time
from pathlib import Path
from statistics import median

import pytest
from pymavlink.dialects.v20 import common as mavlink

from tests.companion.ground_station.operator_station import operator_station
from tests.companion.ground_station.test_tracking_in_flight import (
    MAX_NEWER,
    SCENE,
    TARGET_TOLERANCE_M,
    Bus,
    check_status,
    draw_rectangle,
    error_figures,
    target_errors_m,
)
from tests.companion.simulation.test_play import playing
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import AutopilotLink, Flight, bring_down
from tests.sitl.test_sitl_demo import make_ready

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
HEIGHT_M, FLIGHT_S = 4.0, 30.0
# Two further links of the autopilot: of the cameras, and of a station, as pymavlink names it.
CAMERA_URL, STATION = "COMPANION_SITL_CAMERA_URL", "COMPANION_SITL_STATION"


def test_rectangle_of_a_station_is_followed_through_the_autopilot(
    link: AutopilotLink, services: Services, tmp_path: Path
) -> None:
    if CAMERA_URL not in os.environ or STATION not in os.environ:
        pytest.skip(f"{CAMERA_URL} and {STATION} name no further links of the autopilot")
    make_ready(link, services)
    scene = tmp_path / "car.toml"
    scene.write_text(SCENE)
    flags = ["--vehicle-url", f"udpin://127.0.0.1:{link.service_port}", "--scene", str(scene)]
    flags += ["--guidance-min-battery-percent", "0", "--guidance-obstacles", "off"]
    flags += ["--ground-station-url", os.environ[CAMERA_URL], "--ground-station-track-follows", "true"]
    flags += ["--ground-station-target-relative", "true"]
    try:
        with (
            operator_station(os.environ[STATION]) as (station, _),
            playing(tmp_path, *flags, quick=False) as running,
            running.client() as session,
        ):
            flight, bus = Flight(link, running, session, "pymavlink"), Bus(session)
            flight.take_off(HEIGHT_M)
            flight.fly(f"goto 0 0 altitude={HEIGHT_M:g} heading=0")
            begun = len(station.messages)
            track_id = draw_rectangle(station, bus)
            flown = (f"follow track={track_id}", "in_progress")
            station.until(lambda: flown in bus.commands, 10.0, "following")
            time.sleep(FLIGHT_S)
            statuses = station.of("CAMERA_TRACKING_IMAGE_STATUS", begun)
            newest = max(bus.frames)
            station.until(lambda: max(bus.frames) > newest + 5, 10.0, "sending frames")
            ages_ms, newer = check_status(statuses, list(bus.frames.values()), track_id)
            flight.note(
                "tracking status",
                count=len(statuses),
                active=len(ages_ms),
                age_ms=median(ages_ms),
                age_max_ms=max(ages_ms),
                publication_ms=median(
                    (frame["published_ns"] - frame["captured_ns"]) / 1e6 for frame in bus.frames.values()
                ),
            )
            # PX4 1.17 does not know this message, and forwards it to nobody; mavlink-router does.
            errors_m = target_errors_m(station, bus, track_id)
            figures = error_figures(errors_m) if errors_m else {}
            flight.note("TARGET_RELATIVE", count=len(errors_m), **figures)
            assert all(max(each) < TARGET_TOLERANCE_M for each in errors_m)
            assert len(ages_ms) > 6 * FLIGHT_S
            assert median(newer) <= MAX_NEWER
            assert flight.status["pilot"]["command"]["command"] == flown[0]
            assert station.command(mavlink.MAV_CMD_CAMERA_STOP_TRACKING)[-1] == mavlink.MAV_RESULT_ACCEPTED
            assert ("hold", "in_progress") in bus.commands
    finally:
        bring_down(link)
