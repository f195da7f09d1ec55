"""`companion demo`: a vehicle with a camera finds a car, approaches it, returns and lands.

The vehicle is the simulated one, or another autopilot. The simulator and the perception worker are separate
processes, an independent zenoh subscriber counts the detections, and the result is measured from ground
truth, or from the position that the autopilot reports.
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
from companion.dashboard.process import dashboard_process
from companion.service import Event, Service
from companion.service.ending import EndedError, until_ended
from companion.simulation.session import (
    DEMO_NOISE,
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
from vision.video_writer import has_pyav

VIDEO_NAME = "flight.webm"
# Two cores render, process and record this rate. A slow encoder records every third frame: the camera's rate
# is a multiple of the video's, so the video is evenly spaced.
_CAMERA_RATE_HZ, _SLOW_VIDEO_RATE_HZ = 18.0, 6.0

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Summary:
    """Result of a demonstration. Ranges and landing are the simulator's ground truth.

    With another autopilot they are its own position and state (`truth` is "autopilot").
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
    """Fly it; write `flight.webm`, `summary.json`, `events.jsonl` and `truth.jsonl` to `output`.

    Args:
        vehicle_url: `udpin://HOST:PORT` to which an autopilot sends; None: the simulated vehicle.

    Raises:
        SimSessionError: the simulator did not start, or the autopilot cannot be flown.
    """
    output.mkdir(parents=True, exist_ok=True)
    truth_path = output / "truth.jsonl"
    truth_path.unlink(missing_ok=True)
    started = time.monotonic()
    try:
        flight = asyncio.run(
            until_ended(_fly(output, truth_path, vehicle_url, seed=seed, limit_s=limit_s, say=say))
        )
    except EndedError as error:
        raise SimSessionError(f"the demonstration was {error}") from None
    final_range_m = _range_at(truth_path, flight.reached_ns, seed) if flight.reached_ns else None
    reached = final_range_m is not None and abs(final_range_m - STOP_DISTANCE_M) <= RANGE_TOLERANCE_M
    landed = flight.ended and _landed(truth_path, flight.on_ground)
    failure = flight.failure
    if failure is None and not reached:
        reached_text = "unknown" if final_range_m is None else f"{final_range_m:.2f} m"
        failure = f"range to the {TARGET_CLASS} {reached_text}, expected {STOP_DISTANCE_M:g} m"
    if failure is None and not flight.received:
        failure = "no detection message received on zenoh"
    if failure is None and not landed:
        failure = "vehicle not landed and disarmed"
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
    """Values collected in flight."""

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
        noise=DEMO_NOISE,
    )
    opened = simulator(options) if vehicle_url is None else camera_of_autopilot(vehicle_url, options)
    rate_hz = _CAMERA_RATE_HZ if has_pyav() else _SLOW_VIDEO_RATE_HZ
    async with opened as vehicle:
        settings = session_settings(
            vehicle.port,
            options.camera,
            video=output / VIDEO_NAME,
            video_rate_hz=rate_hz,
            system_id=vehicle.system_id,
        )
        with (output / "events.jsonl").open("w") as events:

            def on_event(event: Event) -> None:
                events.write(json.dumps(asdict(event)) + "\n")
                say(event.text)

            # Created while the camera starts: its imports would delay the relay's messages later.
            service = Service(settings, on_event=on_event)
            await vehicle.until_ready()
            say("vehicle and camera are running")
            try:
                await _until_finished(service, vehicle, flight, limit_s, say)
            finally:
                flight.published = service.bus.published[DETECTIONS.name]
                flight.frames = service.perception.status.frames
    return flight


async def _until_finished(
    service: Service, vehicle: SimProcess, flight: _Flight, limit_s: float, say: Say
) -> None:
    """Wait until the mission ends or the time limit is reached.

    The end of the simulator or camera in flight is a failure; the mission continues, to return the vehicle.
    """
    deadline_s = time.monotonic() + limit_s
    flying = asyncio.create_task(with_service(service, lambda: _watched_mission(service, flight, say)))
    lost = asyncio.create_task(vehicle.until_lost())
    try:
        await asyncio.wait({flying, lost}, timeout=limit_s, return_when=asyncio.FIRST_COMPLETED)
        if lost.done() and not flying.done():
            flight.failure = str(lost.exception())
            say(flight.failure)
            if not service.driver.link_count:
                raise SimSessionError(flight.failure)
            await asyncio.wait({flying}, timeout=max(deadline_s - time.monotonic(), 0.0))
        if not flying.done():
            flight.failure = flight.failure or f"not finished within {limit_s:g} s"
    finally:
        for task in (flying, lost):
            task.cancel()
        ended = (await asyncio.gather(flying, lost, return_exceptions=True))[0]
    if isinstance(ended, Exception):
        raise ended


async def _watched_mission(service: Service, flight: _Flight, say: Say) -> None:
    """Fly the mission while an independent zenoh subscriber counts the detection messages."""

    def count(_key: str, text: str) -> None:
        json.loads(text)
        flight.received += 1

    with open_client(client_settings(service.settings.zenoh)) as session:
        subscriber = listen(session, DETECTIONS.name, count)
        try:
            async with dashboard_process(service.settings, say):
                await _mission(service, flight)
        finally:
            subscriber.undeclare()  # type: ignore[no-untyped-call]


async def _mission(service: Service, flight: _Flight) -> None:
    """Fly the mission, which returns the vehicle also after a failure."""
    await until_ready_to_arm(service)
    reply = await service.command(f"mission {MISSION}")
    if not reply["success"]:
        flight.failure = flight.failure or reply["reason"]
        if service.guidance.in_command and service.driver.state.armed:
            # A low battery ended the mission: the service must not end before the return.
            await service.command("rtl")
    for step in reply.get("steps", ()):
        flight.found = flight.found or (step["title"] == FIND and step["success"])
        if step["title"] == STAND and step["success"]:
            # The range is measured at the end of the hold, when the vehicle is still.
            flight.reached_ns = step["ended_ns"]
    state = service.driver.state
    flight.ended = not state.armed
    flight.on_ground = state.landed is LandedState.ON_GROUND
    if flight.failure is not None and state.armed:
        flight.failure += f"; vehicle still armed, mode {state.mode.value}"


def _range_at(truth_path: Path, stamp_ns: int, seed: int) -> float | None:
    """Return the true range at a time to the surface of the nearest car; None without truth."""
    rows = _rows(truth_path)
    if not rows:
        return None
    position = min(rows, key=lambda row: abs(row["stamp_ns"] - stamp_ns))["position_ned_m"]
    cars = [item for item in demo_world(seed).objects if item.class_name == TARGET_CLASS]
    return min(surface_range_to(car, position) for car in cars)


def _landed(truth_path: Path, on_ground: bool) -> bool:
    """Return whether the vehicle is disarmed on the ground. `on_ground`: used if the file lacks `landed`."""
    rows = _rows(truth_path)
    return bool(rows) and not rows[-1]["armed"] and bool(rows[-1].get("landed", on_ground))


def _rows(truth_path: Path) -> list[dict[str, Any]]:
    lines = truth_path.read_text().splitlines() if truth_path.exists() else []
    # The last line may be incomplete.
    return [json.loads(line) for line in lines if line.endswith("}")]
