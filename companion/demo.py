"""The whole way in one command: a vehicle, its camera, our weights, and a flight to a car.

The vehicle is the built-in one, or an autopilot that runs elsewhere. The simulator and the perception worker
are processes of their own, the detections are counted by a zenoh subscriber that knows nothing of the
service, and what is claimed is measured from the simulator's truth, or from the position that the autopilot
reports.
"""

from __future__ import annotations

import asyncio
import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from companion.bus.client import client_settings, listen, open_client
from companion.bus.topics import DETECTIONS
from companion.service import Event, Service
from companion.sim_session import (
    FIND,
    MISSION,
    RANGE_TOLERANCE_M,
    STAND,
    STOP_DISTANCE_M,
    TARGET_CLASS,
    SimOptions,
    SimProcess,
    SimSessionError,
    camera_of_autopilot,
    session_settings,
    simulator,
    until_ready_to_arm,
    with_service,
)
from companion.vehicle.state import LandedState
from mavlink_sim.world.mesh import surface_range_to
from mavlink_sim.world.world import demo_world
from vision.video_encoders import has_pyav

VIDEO_NAME = "flight.webm"
# What two cores draw, look at and film at once. A slow encoder films every third frame: of an odd number of
# frames to a picture none is between two.
_CAMERA_RATE_HZ, _SLOW_FILM_RATE_HZ = 18.0, 6.0

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Summary:
    """What happened. Ranges and landing are the simulator's truth, not our own estimate.

    Of an autopilot that is not built in they are its own position and state (`truth` is "autopilot").
    """

    success: bool
    found: bool
    reached: bool
    final_range_m: float | None
    landed: bool
    frames: int
    detections_published: int
    detections_received: int
    seed: int
    truth: str
    duration_s: float
    video: str
    failure: str | None


def run_demo(output: Path, *, seed: int, limit_s: float, say: Say, vehicle_url: str | None = None) -> Summary:
    """Fly it. Leaves `flight.webm`, `summary.json`, `events.jsonl` and `truth.jsonl` in `output`.

    Args:
        vehicle_url: `udpin://HOST:PORT` to which an autopilot sends; None: the built-in vehicle.

    Raises:
        SimSessionError: the simulator did not start, or there is no vehicle that can be flown.
    """
    output.mkdir(parents=True, exist_ok=True)
    truth_path = output / "truth.jsonl"
    truth_path.unlink(missing_ok=True)
    started = time.monotonic()
    flight = asyncio.run(_fly(output, truth_path, vehicle_url, seed=seed, limit_s=limit_s, say=say))
    final_range_m = _range_at(truth_path, flight.reached_ns, seed) if flight.reached_ns else None
    reached = final_range_m is not None and abs(final_range_m - STOP_DISTANCE_M) <= RANGE_TOLERANCE_M
    landed = flight.ended and _landed(truth_path, flight.on_ground)
    failure = flight.failure
    if failure is None and not reached:
        stood = "nowhere" if final_range_m is None else f"{final_range_m:.2f} m from the {TARGET_CLASS}"
        failure = f"stood {stood}, not {STOP_DISTANCE_M:g} m from it"
    if failure is None and not flight.received:
        failure = "no detection message came over zenoh"
    if failure is None and not landed:
        failure = "the vehicle is not on the ground and disarmed"
    summary = Summary(
        success=failure is None,
        found=flight.found,
        reached=reached,
        final_range_m=None if final_range_m is None else round(final_range_m, 2),
        landed=landed,
        frames=flight.frames,
        detections_published=flight.published,
        detections_received=flight.received,
        seed=seed,
        truth="simulator" if vehicle_url is None else "autopilot",
        duration_s=round(time.monotonic() - started, 1),
        video=VIDEO_NAME,
        failure=failure,
    )
    (output / "summary.json").write_text(json.dumps(asdict(summary), indent=2) + "\n")
    return summary


@dataclass(slots=True)
class _Flight:
    """What is gathered while flying."""

    found: bool = False
    reached_ns: int | None = None
    ended: bool = False
    on_ground: bool = False
    frames: int = 0
    published: int = 0
    received: int = 0
    failure: str | None = None


async def _fly(
    output: Path, truth_path: Path, vehicle_url: str | None, *, seed: int, limit_s: float, say: Say
) -> _Flight:
    flight = _Flight()
    options = SimOptions(
        camera=f"companion-demo-{os.getpid()}",
        seed=seed,
        camera_rate_hz=_CAMERA_RATE_HZ,
        truth_path=truth_path,
        log_path=output / "simulator.log",
    )
    opened = simulator(options) if vehicle_url is None else camera_of_autopilot(vehicle_url, options)
    rate_hz = _CAMERA_RATE_HZ if has_pyav() else _SLOW_FILM_RATE_HZ
    async with opened as vehicle:
        settings = session_settings(
            vehicle.port,
            options.camera,
            video=output / VIDEO_NAME,
            video_rate_hz=rate_hz,
            driver="mavsdk" if vehicle_url is None else "auto",
            system_id=vehicle.system_id,
        )
        with (output / "events.jsonl").open("w") as events:

            def on_event(event: Event) -> None:
                events.write(json.dumps(asdict(event)) + "\n")
                say(event.text)

            # BuiltLayer while the camera starts: what it imports would hold up the relay's messages later.
            service = Service(settings, on_event=on_event)
            await vehicle.until_ready()
            say("the vehicle and its camera are running")
            try:
                await _until_finished(service, vehicle, flight, limit_s, say)
            finally:
                flight.published = service.bus.published[DETECTIONS.name]
                flight.frames = service.perception.status.frames
    return flight


async def _until_finished(
    service: Service, vehicle: SimProcess, flight: _Flight, limit_s: float, say: Say
) -> None:
    """Until the mission has ended, or the time is up.

    A simulator or camera that ends in flight is a failure; the mission goes on, to bring the vehicle home.
    """
    deadline_s = time.monotonic() + limit_s
    flying = asyncio.create_task(with_service(service, lambda: _watched_mission(service, flight)))
    lost = asyncio.create_task(vehicle.until_lost())
    try:
        await asyncio.wait({flying, lost}, timeout=limit_s, return_when=asyncio.FIRST_COMPLETED)
        if lost.done() and not flying.done():
            flight.failure = str(lost.exception())
            say(flight.failure)
            if not service.ready:
                raise SimSessionError(flight.failure)
            await asyncio.wait({flying}, timeout=max(deadline_s - time.monotonic(), 0.0))
        if not flying.done():
            flight.failure = flight.failure or f"not finished in {limit_s:g} s"
    finally:
        for task in (flying, lost):
            task.cancel()
        ended = (await asyncio.gather(flying, lost, return_exceptions=True))[0]
    if isinstance(ended, Exception):
        raise ended


async def _watched_mission(service: Service, flight: _Flight) -> None:
    """The mission, while a zenoh subscriber of its own counts the detection messages."""

    def count(_key: str, text: str) -> None:
        json.loads(text)
        flight.received += 1

    with open_client(client_settings(service.settings.zenoh)) as session:
        subscriber = listen(session, DETECTIONS.name, count)
        try:
            await _mission(service, flight)
        finally:
            subscriber.undeclare()  # type: ignore[no-untyped-call]


async def _mission(service: Service, flight: _Flight) -> None:
    """The mission; failing, it brings the vehicle home all the same."""
    await until_ready_to_arm(service)
    reply = await service.command(f"mission {MISSION}")
    if not reply["success"]:
        flight.failure = flight.failure or reply["reason"]
    for step in reply.get("steps", ()):
        flight.found = flight.found or (step["title"] == FIND and step["success"])
        if step["title"] == STAND and step["success"]:
            # The range is taken at the end of the hold, when all is still.
            flight.reached_ns = step["ended_ns"]
    state = service.driver.state
    flight.ended = not state.armed
    flight.on_ground = state.landed is LandedState.ON_GROUND
    if flight.failure is not None and state.armed:
        flight.failure += f"; the vehicle is left armed, in {state.mode.value} mode"


def _range_at(truth_path: Path, stamp_ns: int, seed: int) -> float | None:
    """The true range to the surface of the nearest car at a moment."""
    rows = _rows(truth_path)
    if not rows:
        return None
    place = min(rows, key=lambda row: abs(row["stamp_ns"] - stamp_ns))["position_ned_m"]
    cars = [item for item in demo_world(seed).objects if item.class_name == TARGET_CLASS]
    return min(surface_range_to(car, place) for car in cars)


def _landed(truth_path: Path, on_ground: bool) -> bool:
    """Disarmed on the ground. `on_ground`: what the autopilot says, where the file does not have it."""
    rows = _rows(truth_path)
    return bool(rows) and not rows[-1]["armed"] and bool(rows[-1].get("landed", on_ground))


def _rows(truth_path: Path) -> list[dict[str, Any]]:
    lines = truth_path.read_text().splitlines() if truth_path.exists() else []
    # The simulator may have been ended in the middle of its last line.
    return [json.loads(line) for line in lines if line.endswith("}")]
