"""The service with the built-in vehicle, both on loopback: for the demonstration and for measuring."""

from __future__ import annotations

import asyncio
import ctypes
import os
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from companion.service import Service
from companion.settings import Settings
from companion.settings.reading import load_settings
from mavlink_sim.testing import free_port

# High enough to see far, low enough that a car at 5 m is in the picture.
ALTITUDE_M = 4.0

# What the demonstration flies: a mission file that comes with this package, and the steps that are judged.
MISSION = "demo"
FIND, REACH, STAND = "find", "reach", "stand"
TARGET_CLASS = "car"
# Where the mission's approach stops, and how well the simulator must agree with that after the hold.
STOP_DISTANCE_M, RANGE_TOLERANCE_M = 5.0, 0.5
# The open field of the built-in world needs no 30 m on the way home (PX4's default).
SIMULATOR_PARAMETERS = {"RTL_RETURN_ALT": 5.0}

_SIMULATOR_START_S = 20.0
_SIMULATOR_END_S = 5.0
_ARMABLE_S = 20.0
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class RehearsalError(RuntimeError):
    """The built-in vehicle is not to be had. The message is one line for a person."""


@asynccontextmanager
async def simulator(
    port: int, camera: str, truth_path: Path, seed: int, log_path: Path, *, camera_rate_hz: float = 30.0
) -> AsyncIterator[asyncio.subprocess.Process]:
    """`mavlink-sim` as a process of its own, sending to `port`; what it says goes to `log_path`.

    Raises:
        RehearsalError: it did not start.
    """
    arguments = [
        "--onboard-port",
        str(port),
        "--onboard-bind",
        "0",
        "--gcs-port",
        str(free_port()),
        "--gcs-bind",
        "0",
    ]
    arguments += ["--camera", camera, "--camera-rate", f"{camera_rate_hz:g}"]
    arguments += ["--truth", str(truth_path), "--seed", str(seed)]
    for name, value in SIMULATOR_PARAMETERS.items():
        arguments += ["--param", f"{name}={value:g}"]
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "mavlink_sim",
        *arguments,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        # Ctrl-C is for the service: it must be able to leave a vehicle that still flies.
        process_group=0,
        preexec_fn=_end_with_us,
    )
    assert process.stdout is not None
    lines: list[str] = []
    copying: asyncio.Task[None] | None = None
    try:
        await _until_ready(process.stdout, lines)
        copying = asyncio.create_task(_copy(process.stdout, lines))
        yield process
    finally:
        await _end(process)
        if copying is not None:
            await copying
        log_path.write_text("".join(lines))  # noqa: ASYNC240 - the loop has nothing else to do any more


def _end_with_us() -> None:
    """Run in the new process: however we end, the simulator is told to end too (prctl(2))."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


async def _end(process: asyncio.subprocess.Process) -> None:
    if process.returncode is None:
        process.terminate()
    try:
        async with asyncio.timeout(_SIMULATOR_END_S):
            await process.wait()
    except TimeoutError:
        process.kill()
        await process.wait()


async def _until_ready(stream: asyncio.StreamReader, lines: list[str]) -> None:
    try:
        async with asyncio.timeout(_SIMULATOR_START_S):
            while line := await stream.readline():
                lines.append(line.decode())
                if lines[-1].startswith("ready"):
                    return
    except TimeoutError as error:
        raise RehearsalError(f"the simulator was not ready in {_SIMULATOR_START_S:g} s") from error
    raise RehearsalError(f"the simulator did not start: {''.join(lines[-3:]).strip()}")


async def _copy(stream: asyncio.StreamReader, lines: list[str]) -> None:
    while line := await stream.readline():
        lines.append(line.decode())


def rehearsal_settings(
    port: int, camera: str, *, video: Path | None = None, video_rate_hz: float = 7.5, driver: str = "mavsdk"
) -> Settings:
    """Settings for the built-in vehicle and its camera, whatever is configured on this machine."""
    overrides = {
        "vehicle.url": f"udpin://127.0.0.1:{port}",
        "vehicle.driver": driver,
        "source.uri": f"shm://{camera}",
        "detector.threads": "1",
        # The size at which the bundled model was trained; see docs/models.md.
        "detector.image_size": "320",
        # A laptop draws the world, looks at it and films it all at once: frames may come late.
        "guidance.perception_max_age_s": "1.0",
        "zenoh.listen": f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",
    }
    if video is not None:
        overrides["recording.video"] = str(video)
        overrides["recording.rate_hz"] = f"{video_rate_hz:g}"
    return load_settings(Path(os.devnull), overrides, environment={})


async def with_service(service: Service, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run the service, and `work` once it is ready; then end the service.

    What fails in the service is raised here and ends the work, and the other way round.

    Raises:
        LinkError, PerceptionStartError, BusError: as `Service.run`.
    """
    ready = asyncio.Event()

    async def when_ready() -> None:
        await ready.wait()
        await work()

    running = asyncio.create_task(service.run(ready.set))
    working = asyncio.create_task(when_ready())
    try:
        await asyncio.wait({running, working}, return_when=asyncio.FIRST_COMPLETED)
        if running.done():
            running.result()
            raise RehearsalError("the service ended before its work was done")
        working.result()
    finally:
        working.cancel()
        # Before it is ready there is nothing to leave in order.
        service.stop() if service.ready else running.cancel()
        ended, _ = await asyncio.gather(running, working, return_exceptions=True)
    if isinstance(ended, BaseException):
        raise ended  # it went wrong after the work was done, which is no success


async def until_ready_to_arm(service: Service) -> None:
    """Wait for the autopilot's pre-arm checks. Raises RehearsalError if they do not pass."""
    armable = asyncio.Event()
    unsubscribe = service.driver.subscribe(lambda state: armable.set() if state.ready_to_arm else None)
    try:
        async with asyncio.timeout(_ARMABLE_S):
            await armable.wait()
    except TimeoutError as error:
        raise RehearsalError(f"the vehicle was not ready to arm in {_ARMABLE_S:g} s") from error
    finally:
        unsubscribe()
