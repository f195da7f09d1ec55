"""From a frame's capture to the first setpoint that knows of it, in flight with the simulated vehicle."""

from __future__ import annotations

import asyncio
import os
import time
from contextlib import suppress
from dataclasses import dataclass, field

from companion.bench.percentiles import percentiles
from companion.guidance.interface import GuidanceInput, GuidanceOutput
from companion.service import Service
from companion.simulation.session import (
    ALTITUDE_M,
    SimOptions,
    SimSessionError,
    session_settings,
    simulator,
    until_ready_to_arm,
    with_service,
)
from companion.vehicle.setpoint import Setpoint
from vision.pipeline import PerceptionResult


@dataclass(slots=True)
class _Figures:
    """Milliseconds, one per setpoint that followed a frame."""

    latency_ms: list[float] = field(default_factory=list)
    beyond_ms: list[float] = field(default_factory=list)
    stages_ms: dict[str, list[float]] = field(default_factory=dict)

    def take(self, result: PerceptionResult, steered_ns: int, sent_ns: int) -> None:
        elapsed_ms = (sent_ns - result.captured_ns) / 1e6
        stages_ms = dict(result.timing_ms)
        del stages_ms["total"]
        stages_ms["deliver"] = (steered_ns - result.inferred_ns) / 1e6
        stages_ms["steer"] = (sent_ns - steered_ns) / 1e6
        self.latency_ms.append(elapsed_ms)
        self.beyond_ms.append(elapsed_ms - stages_ms.get("capture", 0.0) - stages_ms["inference"])
        for stage, time_ms in stages_ms.items():
            self.stages_ms.setdefault(stage, []).append(time_ms)

    def clear(self) -> None:
        self.latency_ms.clear()
        self.beyond_ms.clear()
        self.stages_ms.clear()


def measure_latency(seconds: float, *, driver: str) -> dict[str, object]:
    """Fly `seek` and `approach` and time every setpoint that is the first after a new detection message.

    `capture_to_setpoint` starts at the pose's stamp in the simulator, before the image is drawn.
    `beyond_network` is what the companion adds to the network: from when the frame is there, less the
    network's own time. Every stage is a median: those of `PerceptionResult.timing_ms`, among them
    `capture` and `inference`, which are not the companion's; then `deliver`, from when the result was known
    until guidance has it, and `steer`, from there until the setpoint has left.

    Raises:
        SimSessionError: the vehicle did not get into the air.
    """
    return asyncio.run(_measure(seconds, driver))


async def _measure(seconds: float, driver: str) -> dict[str, object]:
    figures = _Figures()
    camera = f"companion-bench-{os.getpid()}"
    async with simulator(SimOptions(camera, seed=1)) as vehicle:
        await vehicle.until_ready()
        settings = session_settings(vehicle.port, camera, driver=driver)
        service = Service(settings)
        _measure_sent(service, figures)
        await with_service(service, lambda: _fly(service, seconds, figures))
    if not figures.latency_ms:
        raise SimSessionError("no setpoint followed a detection message")
    return {
        "driver": driver,
        "setpoints": len(figures.latency_ms),
        **{f"capture_to_setpoint_{name}": value for name, value in percentiles(figures.latency_ms).items()},
        **{f"beyond_network_{name}": value for name, value in percentiles(figures.beyond_ms).items()},
        **{f"{stage}_p50_ms": percentiles(times)["p50_ms"] for stage, times in figures.stages_ms.items()},
    }


async def _fly(service: Service, seconds: float, figures: _Figures) -> None:
    await until_ready_to_arm(service)
    reply = await service.command(f"takeoff {ALTITUDE_M:g}")
    if not reply["success"]:
        raise SimSessionError(f"cannot measure in flight: {reply['reason']}")
    figures.clear()
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            for command in ("seek car", "approach car distance=5", "orbit radius=5 speed=1"):
                await service.command(command)
            await asyncio.sleep(seconds)


def _measure_sent(service: Service, figures: _Figures) -> None:
    """Time what goes on the wire, without changing it.

    `Guidance.step` makes a setpoint of the newest detections; what counts is when that very setpoint leaves.
    """
    step, send = service.guidance.step, service.driver.send_setpoint
    seen = -1
    awaited: tuple[Setpoint | None, PerceptionResult, int] | None = None

    def noted(now_ns: int, inputs: GuidanceInput) -> GuidanceOutput:
        nonlocal seen, awaited
        output = step(now_ns, inputs)
        newest = service.inputs.steering.newest
        if newest is not None and newest.sequence != seen:
            seen, awaited = newest.sequence, (output.setpoint, newest, now_ns)
        return output

    def timed(setpoint: Setpoint) -> None:
        nonlocal awaited
        send(setpoint)
        if awaited is not None and setpoint is awaited[0]:
            (_, newest, steered_ns), awaited = awaited, None
            figures.take(newest, steered_ns, time.monotonic_ns())

    service.guidance.step = noted  # type: ignore[method-assign]
    service.streamer.send = timed
