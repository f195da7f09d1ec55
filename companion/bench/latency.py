"""From a frame's capture to the first setpoint that knows of it, in flight with the built-in vehicle."""

from __future__ import annotations

import asyncio
import os
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from companion.bench.percentiles import percentiles
from companion.guidance.behaviour import Situation
from companion.rehearsal import (
    ALTITUDE_M,
    RehearsalError,
    rehearsal_settings,
    simulator,
    until_ready_to_arm,
    with_service,
)
from companion.service import Service
from companion.vehicle.setpoint import Setpoint
from mavlink_sim.testing import free_port
from vision.pipeline import PerceptionResult


def measure_latency(seconds: float, *, driver: str) -> dict[str, object]:
    """Fly `seek` and `approach` and time every setpoint that is the first after a new detection message.

    `capture_to_setpoint` starts at the pose's stamp in the simulator, before the picture is drawn.
    `beyond_network` is what the companion adds to the network: from when the frame is there, less the
    network's own time.

    Raises:
        RehearsalError: the vehicle did not get into the air.
    """
    with tempfile.TemporaryDirectory(prefix="companion-bench-") as folder:
        return asyncio.run(_measure(Path(folder), seconds, driver))


async def _measure(folder: Path, seconds: float, driver: str) -> dict[str, object]:
    latency_ms: list[float] = []
    beyond_ms: list[float] = []
    camera = f"companion-bench-{os.getpid()}"
    port = free_port()
    async with simulator(port, camera, folder / "truth.jsonl", 1, folder / "simulator.log"):
        settings = rehearsal_settings(port, camera, driver=driver)
        service = Service(settings)
        _measure_sent(service, latency_ms, beyond_ms)
        await with_service(service, lambda: _fly(service, seconds, latency_ms, beyond_ms))
    if not latency_ms:
        raise RehearsalError("no setpoint followed a detection message")
    return {
        "driver": driver,
        "setpoints": len(latency_ms),
        **{f"capture_to_setpoint_{name}": value for name, value in percentiles(latency_ms).items()},
        **{f"beyond_network_{name}": value for name, value in percentiles(beyond_ms).items()},
    }


async def _fly(service: Service, seconds: float, latency_ms: list[float], beyond_ms: list[float]) -> None:
    await until_ready_to_arm(service)
    reply = await service.command(f"takeoff {ALTITUDE_M:g}")
    if not reply["success"]:
        raise RehearsalError(f"cannot measure in flight: {reply['reason']}")
    latency_ms.clear()
    beyond_ms.clear()
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            for command in ("seek car", "approach car distance=5", "orbit radius=5 speed=1"):
                await service.command(command)
            await asyncio.sleep(seconds)


def _measure_sent(service: Service, latency_ms: list[float], beyond_ms: list[float]) -> None:
    """Time what goes on the wire, without changing it.

    `Pilot.update` makes a setpoint of the newest detections; what counts is when that very setpoint leaves.
    """
    update, send = service.pilot.update, service.driver.send_setpoint
    seen = -1
    awaited: tuple[Setpoint | None, PerceptionResult] | None = None

    def noted(situation: Situation) -> None:
        nonlocal seen, awaited
        update(situation)
        newest = service.steering.newest
        if newest is not None and newest.sequence != seen:
            seen, awaited = newest.sequence, (service.pilot.sent, newest)

    def timed(setpoint: Setpoint) -> None:
        nonlocal awaited
        send(setpoint)
        if awaited is not None and setpoint is awaited[0]:
            newest, awaited = awaited[1], None
            elapsed_ms = (time.monotonic_ns() - newest.captured_ns) / 1e6
            latency_ms.append(elapsed_ms)
            timing_ms = newest.timing_ms
            beyond_ms.append(elapsed_ms - timing_ms.get("capture", 0.0) - timing_ms["inference"])

    service.pilot.update = noted  # type: ignore[method-assign]
    service.streamer.send = timed
