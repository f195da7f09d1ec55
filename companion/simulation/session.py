"""A service with a simulated camera on loopback, with the simulated vehicle or another autopilot.

For `companion play`, the demonstration and benchmarks. The simulated vehicle and its camera are one
`mavlink-sim` process. For another autopilot `mavlink-sim camera` renders the camera, and a relay forwards the
autopilot's messages to both.
"""

from __future__ import annotations

import asyncio
import ctypes
import importlib
import signal
import socket
import subprocess
import sys
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from contextlib import ExitStack, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from companion.host.passing import PassingError
from companion.host.tasks import spawn
from companion.service import Service
from companion.settings import Settings
from companion.settings.calibration import adopt_calibration
from companion.settings.perception import DEFAULT_MODEL, NO_SOURCE
from companion.simulation.relay import Relay
from mavlink_sim.camera.scene import CameraSettings
from mavlink_sim.testing import free_port, free_udp_port_range
from vision.camera_model import CameraCalibration

# High enough to see far, low enough that a car at 5 m is in the image.
ALTITUDE_M = 4.0

# The demonstration's mission file, bundled with this package, and its evaluated steps.
MISSION = "demo"
FIND, REACH, STAND = "find", "reach", "stand"
TARGET_CLASS = "car"
# Stop distance of the mission's approach, and its tolerance by ground truth after the hold.
STOP_DISTANCE_M, RANGE_TOLERANCE_M = 5.0, 0.5
# The open field of the built-in world does not need the return altitude of 30 m (PX4's default).
SIMULATOR_PARAMETERS = {"RTL_RETURN_ALT": 5.0}
# The demonstration's estimator errs by half of a PX4's, whose position alone is 0.2 m off and changes within
# seconds: of 40 seeds 3 would stand beyond the tolerance, by nobody's fault.
DEMO_NOISE = 0.5

# An autopilot has no position for up to a minute after its start; `mavlink-sim camera` waits for it.
_SIMULATOR_START_S = 90.0
_SIMULATOR_END_S = 5.0
_ARMABLE_S = 20.0
_LINES_KEPT = 40
_CAMERA_LOST = "is lost: its process ended"  # `mavlink_sim.realtime.sim_outputs`
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class SimSessionError(RuntimeError):
    """The vehicle or its camera is missing or has ended. The message is one line."""


@dataclass(frozen=True, slots=True)
class SimOptions:
    """Options of the simulation.

    Attributes:
        camera: name of the shared memory for the camera's frames; see `camera_name`. None: no camera.
        seed: random seed of the world and the simulated vehicle.
        scene: scene file or name of a bundled scene; None: the demo world.
        camera_rate_hz: frames per second; None: the scene's own.
        truth_path: file for the true pose, 20 lines per second; None: no file.
        log_path: file for the process's output; None: no file.
        vehicles: number of simulated vehicles. cameras: how many of them have a camera, the first ones.
        autopilot: autopilot firmware to emulate.
        gcs_port: UDP port for a ground station; None: a free one.
        noise: scale of the errors of estimates and sensors; 1: a PX4's.
        control: zenoh endpoint for faults. signing_key: file of 32 bytes, of a signed link; None: none.
    """

    camera: str | None
    seed: int
    scene: str | None = None
    camera_rate_hz: float | None = 30.0
    truth_path: Path | None = None
    log_path: Path | None = None
    vehicles: int = 1
    cameras: int = 1
    autopilot: str = "px4"
    gcs_port: int | None = None
    noise: float = 1.0
    control: str | None = None
    signing_key: Path | None = None


class SimUnavailableError(SimSessionError, PassingError):
    """It did not start in time, or has ended: another start may succeed."""


class SimProcess:
    """A running `mavlink-sim`: the vehicle with its camera, or the camera alone.

    Attributes:
        port: UDP port on loopback of the vehicle's link; of a fleet the first of consecutive ones.
        system_id: MAVLink system id of the vehicle; of a fleet of the first one.
    """

    def __init__(
        self, process: asyncio.subprocess.Process, port: int, log_path: Path | None, system_id: int = 1
    ) -> None:
        self.port, self.system_id = port, system_id
        self._process = process
        self._lines: deque[str] = deque(maxlen=_LINES_KEPT)
        self._ready, self._lost = asyncio.Event(), asyncio.Event()
        self._reading = spawn(self._read(log_path), "simulator output")

    @property
    def pid(self) -> int:
        return self._process.pid

    async def until_ready(self) -> None:
        """Wait until the process reports ready. Raises SimSessionError if it does not start."""
        lost = asyncio.create_task(self.until_lost())
        ready = asyncio.create_task(self._ready.wait())
        try:
            async with asyncio.timeout(_SIMULATOR_START_S):
                await asyncio.wait({ready, lost}, return_when=asyncio.FIRST_COMPLETED)
            if not ready.done():
                raise SimSessionError(f"the simulator did not start: {self._last_output()}")
        except TimeoutError as error:
            raise SimUnavailableError(
                f"the simulator was not ready within {_SIMULATOR_START_S:g} s"
            ) from error
        finally:
            lost.cancel()
            ready.cancel()
            await asyncio.gather(lost, ready, return_exceptions=True)

    async def until_lost(self) -> NoReturn:
        """Wait until the process or its camera ends. Raises SimSessionError with the last line of output."""
        await self._lost.wait()
        raise SimSessionError(f"the simulator or its camera ended: {self._last_output()}")

    async def end(self) -> None:
        """End the process by SIGTERM, after a time-out by SIGKILL; read the rest of its output."""
        if self._process.returncode is None:
            self._process.terminate()
        try:
            async with asyncio.timeout(_SIMULATOR_END_S):
                await self._process.wait()
        except TimeoutError:
            self._process.kill()
            await self._process.wait()
        await self._reading

    async def _read(self, log_path: Path | None) -> None:
        assert self._process.stdout is not None
        with ExitStack() as stack:
            log = None if log_path is None else stack.enter_context(log_path.open("w"))
            while data := await self._process.stdout.readline():
                line = data.decode(errors="replace")
                self._lines.append(line.strip())
                if log is not None:
                    log.write(line)
                if line.startswith("ready"):
                    self._ready.set()
                if _CAMERA_LOST in line:
                    self._lost.set()
        self._lost.set()

    def _last_output(self) -> str:
        return self._lines[-1].removeprefix("mavlink-sim: ") if self._lines else "it printed nothing"


@asynccontextmanager
async def simulator(options: SimOptions) -> AsyncIterator[SimProcess]:
    """Run the simulated vehicle and its camera as a process; see `SimProcess.until_ready`."""
    port = free_udp_port_range(options.vehicles)
    gcs_port = free_port() if options.gcs_port is None else options.gcs_port
    arguments = ["--onboard-port", str(port), "--onboard-bind", "0"]
    arguments += ["--gcs-port", str(gcs_port), "--gcs-bind", "0", "--autopilot", options.autopilot]
    arguments += ["--noise", f"{options.noise:g}"]
    if options.control is not None:
        arguments += ["--control", options.control]
    if options.signing_key is not None:
        arguments += ["--signing-key", str(options.signing_key)]
    if options.vehicles > 1:
        arguments += ["--vehicles", str(options.vehicles)]
        if options.camera is not None:
            arguments += ["--cameras", str(options.cameras)]
    if options.autopilot == "px4":
        for name, value in SIMULATOR_PARAMETERS.items():
            arguments += ["--param", f"{name}={value:g}"]
    process = SimProcess(await _spawn(arguments, options), port, options.log_path)
    try:
        yield process
    finally:
        await process.end()


@asynccontextmanager
async def camera_of_autopilot(url: str, options: SimOptions) -> AsyncIterator[SimProcess]:
    """Render a camera from the pose of an autopilot at `url`, after checking the autopilot.

    Raises:
        LinkError: the url is not `udpin://`, or its port is in use.
        SimSessionError: no autopilot, or an unsuitable one: see `Relay.check_autopilot`.
    """
    service_port, camera_port = free_port(), free_port()
    # Loading takes a second, which would delay the relay's messages.
    await asyncio.to_thread(importlib.import_module, "companion.vehicle.pymavlink_driver")
    relay = await Relay.open(url, (service_port, camera_port))
    try:
        try:
            autopilot = await relay.check_autopilot()
        except ValueError as error:
            raise SimSessionError(str(error)) from error
        arguments = ["camera", "--vehicle-url", f"udpin://127.0.0.1:{camera_port}"]
        process = SimProcess(
            await _spawn(arguments, options), service_port, options.log_path, autopilot.system_id
        )
        try:
            yield process
        finally:
            await process.end()
    finally:
        await relay.close()


async def _spawn(arguments: Sequence[str], options: SimOptions) -> asyncio.subprocess.Process:
    arguments = [*arguments, "--seed", str(options.seed)]
    if options.camera is not None:
        arguments += ["--camera", options.camera]
        if options.camera_rate_hz is not None:
            arguments += ["--camera-rate", f"{options.camera_rate_hz:g}"]
    if options.scene is not None:
        arguments += ["--scene", options.scene]
    if options.truth_path is not None:
        arguments += ["--truth", str(options.truth_path)]
    return await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "mavlink_sim",
        *arguments,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        # Ctrl-C must not end the simulator before the service has released the vehicle.
        process_group=0,
        preexec_fn=_end_with_us,
    )


def _end_with_us() -> None:
    """Run in the new process: it receives SIGTERM when this process ends (prctl(2))."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def camera_name(camera: str, number: int) -> str:
    """Return the name of a fleet's shared memory with the frames of a vehicle, counted from 1."""
    return camera if number == 1 else f"{camera}-{number}"


def session_settings(
    port: int,
    camera: str | None,
    *,
    chosen: Settings | None = None,
    video: Path | None = None,
    video_rate_hz: float = 7.5,
    driver: str = "pymavlink",
    system_id: int = 1,
) -> Settings:
    """Return settings for a vehicle on a loopback port and a simulated camera whose frames carry the lens.

    Args:
        camera: name of the shared memory with the frames; None: no camera and no perception.
        chosen: settings to keep, except vehicle, source, camera and cameras; None: defaults, and zenoh on a
            free port.
    """
    values: dict[str, Any] = {} if chosen is None else chosen.model_dump(exclude_unset=True)
    for section in ("source", "camera", "cameras"):
        values.pop(section, None)
    values["guidance"] = {"perception_max_age_s": 1.0, **values.get("guidance", {})}
    # One computer renders, detects and records at once: frames may be late.
    detector = {"threads": 1, **values.get("detector", {})}
    if detector.get("model", DEFAULT_MODEL) == DEFAULT_MODEL:
        # The image size of the bundled model's training; see docs/models.md.
        detector.setdefault("image_size", 320)
    values["detector"] = detector
    values["guidance"].pop("camera", None)
    values["vehicle"] = {"driver": driver, **values.get("vehicle", {})}
    values["vehicle"] |= {"url": f"udpin://127.0.0.1:{port}", "system_id": system_id}
    # The worker starts together with the simulator, whose first frame takes some seconds.
    values["source"] = {"uri": f"shm://{camera}", "open_timeout_s": _SIMULATOR_START_S}
    if camera is None:
        values["source"], values["detector"]["enabled"] = {"uri": NO_SOURCE}, False
    if chosen is None:
        values["zenoh"] = {"listen": (f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",)}
    if video is not None:
        values["recording"] = {"video": str(video), "rate_hz": video_rate_hz}
    return Settings.model_validate(values)


def with_lens(settings: Settings, camera: CameraSettings = CameraSettings()) -> Settings:  # noqa: B008 - frozen
    """Return the settings with a simulated camera's lens and mount, for frames without them."""
    calibration = CameraCalibration(camera.model, camera.mount)
    adopted = adopt_calibration(settings.camera, calibration).camera
    return settings.model_copy(update={"camera": adopted})


async def with_service(service: Service, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run one service, as `with_services`."""
    await with_services([service], work)


async def with_services(services: Sequence[Service], work: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run services, and `work` once they, their vehicles and cameras are up; then end the services.

    An error of a service ends the work and is raised here, and vice versa.

    Raises:
        LinkError, PerceptionStartError, BusError: as `Service.run` and `Parts.complete`.
    """
    ready = [asyncio.Event() for _ in services]

    async def when_ready() -> None:
        for event, service in zip(ready, services, strict=True):
            await event.wait()
            await service.parts.complete(service.settings.vehicle.connect_timeout_s)
        await work()

    running = [
        asyncio.create_task(service.run(event.set)) for service, event in zip(services, ready, strict=True)
    ]
    working = asyncio.create_task(when_ready())
    try:
        await asyncio.wait({*running, working}, return_when=asyncio.FIRST_COMPLETED)
        for task in running:
            if task.done():
                task.result()
                raise SimSessionError("the service ended before the work was done")
        working.result()
    finally:
        working.cancel()
        for service, task in zip(services, running, strict=True):
            # Before it is ready there is nothing to shut down.
            service.stop() if service.ready else task.cancel()
        ended = await asyncio.gather(*running, return_exceptions=True)
        await asyncio.gather(working, return_exceptions=True)
    for error in ended:
        if isinstance(error, BaseException):
            raise error  # failed after the work was done


async def until_ready_to_arm(service: Service) -> None:
    """Wait until the autopilot's pre-arm checks pass. Raises SimSessionError after a time-out."""
    armable = asyncio.Event()
    unsubscribe = service.driver.subscribe(lambda state: armable.set() if state.ready_to_arm else None)
    try:
        async with asyncio.timeout(_ARMABLE_S):
            await armable.wait()
    except TimeoutError as error:
        raise SimUnavailableError(f"the vehicle was not ready to arm within {_ARMABLE_S:g} s") from error
    finally:
        unsubscribe()
