"""`companion play`: vehicle, camera and service together, taking commands until Ctrl-C."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, suppress
from dataclasses import dataclass
from typing import Any

from companion.bus.config import EndpointTakenError
from companion.dashboard.process import dashboard_process
from companion.language.process import AskProcess
from companion.operator.console import run_console, terminal_is_free
from companion.service import Event, Service
from companion.service.ending import on_ending
from companion.settings import Settings
from companion.settings.perception import NO_SOURCE
from companion.simulation.session import (
    SimOptions,
    SimProcess,
    SimSessionError,
    camera_name,
    camera_of_autopilot,
    session_settings,
    simulator,
    with_services,
)
from mavlink_sim.camera.scene import Scene
from mavlink_sim.camera.scene_file import SceneError, scene_or_demo
from mavlink_sim.testing import free_port

Say = Callable[[str], None]

_GCS_PORT = 14550  # where ground stations listen
_TCP = "tcp/"
_PAGE_S = 10.0  # the page's address is waited for
_CAMERA_RATE_HZ = 20.0
"""Frames a second of all cameras together, for two cores that also detect objects in them."""
_MAX_CAMERAS = 4
"""At this number each has 5 frames a second; fewer would make tracks uncertain."""


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """Options of `play`.

    Attributes:
        scene: scene file or name of a bundled scene; None: the demo world.
        seed: random seed of the world and the simulated vehicles.
        vehicles: number of simulated vehicles, one service each; see `cameras`.
        with_camera: whether any vehicle has a camera.
        vehicle_url: `udpin://HOST:PORT` to which an autopilot sends; None: the simulated vehicle.
        autopilot: autopilot firmware to emulate: px4 or ardupilot.
    """

    scene: str | None = None
    seed: int = 1
    vehicles: int = 1
    vehicle_url: str | None = None
    autopilot: str = "px4"
    with_camera: bool = True

    @property
    def cameras(self) -> int:
        """How many vehicles have a camera: all of up to `_MAX_CAMERAS`, else the first one."""
        if not self.with_camera:
            return 0
        return self.vehicles if self.vehicles <= _MAX_CAMERAS else 1


class SimulationLostError(SimSessionError):
    """The simulator or its camera ended in operation."""


def play(settings: Settings, options: PlayOptions, say: Say) -> None:
    """Start everything, print example commands, and take commands until a signal or `quit` ends it.

    Raises:
        SimSessionError: it cannot start, for example for an unknown scene. EndpointTakenError: another
            program has the port of zenoh.
        SimulationLostError: the simulator ended in operation.
        LinkError, PerceptionStartError, BusError: as `Service.run`.
    """
    _check_zenoh_ports(settings)
    try:
        scene = scene_or_demo(options.scene, options.seed)
    except SceneError as error:
        raise SimSessionError(str(error)) from error
    say(_starting_text(options))
    asyncio.run(_play(settings, options, scene, say))


def _starting_text(options: PlayOptions) -> str:
    """What is started, in one line: it takes seconds."""
    if options.vehicle_url is not None:
        starting = ["a rendered camera"]
    else:
        several = options.vehicles > 1
        starting = [f"{options.vehicles} simulated vehicles" if several else "the simulated vehicle"]
        if options.cameras:
            starting.append("a camera each" if options.cameras > 1 else "a camera")
    return f"starting {', '.join(starting)} and the service"


def _check_zenoh_ports(settings: Settings) -> None:
    """Check that the zenoh ports are free; usually another `companion` uses them."""
    for endpoint in settings.zenoh.listen if settings.zenoh.mode == "peer" else ():
        host, _, port = endpoint.removeprefix(_TCP).rpartition(":")
        if not endpoint.startswith(_TCP) or not port.isdigit():
            continue
        family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host.strip("[]"), int(port)))
            except OSError as error:
                raise EndpointTakenError(
                    f"{endpoint}: {error.strerror}; expected a free port. End the other companion play or "
                    "companion run, or set --zenoh-listen tcp/127.0.0.1:PORT"
                ) from error


async def _play(settings: Settings, options: PlayOptions, scene: Scene, say: Say) -> None:
    stop = asyncio.Event()
    watch = on_ending(stop.set)
    starting = asyncio.create_task(_until_stopped(settings, options, scene, say, stop))
    stopping = asyncio.create_task(stop.wait())
    try:
        await asyncio.wait({starting, stopping}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        stopping.cancel()
        watch.cancel()
        if not starting.done():
            starting.cancel()
        ended = (await asyncio.gather(starting, return_exceptions=True))[0]
    if isinstance(ended, Exception):
        raise ended


async def _until_stopped(
    settings: Settings, options: PlayOptions, scene: Scene, say: Say, stop: asyncio.Event
) -> None:
    async with _opened(options, scene) as vehicle:
        services = _services(settings, options, vehicle, say)
        ready, page_said = False, asyncio.Event()

        def say_page(line: str) -> None:
            say(line)
            page_said.set()

        async def work() -> None:
            nonlocal ready
            await vehicle.until_ready()
            ready = True
            if settings.dashboard.listen:  # its address stands above what to do next
                with suppress(TimeoutError):
                    async with asyncio.timeout(_PAGE_S):
                        await page_said.wait()
            _print_next_commands(services, options.cameras, scene, say)
            if terminal_is_free(settings.source.uri):
                await run_console(
                    {service.settings.vehicle.name: service.target for service in services},
                    stop.set,
                    lambda level, text: say(text),
                    AskProcess(services[0].settings),
                )
            await stop.wait()

        async with dashboard_process(services[0].settings, say_page):
            running = asyncio.create_task(with_services(services, work))
            lost = asyncio.create_task(vehicle.until_lost())
            try:
                await asyncio.wait({running, lost}, return_when=asyncio.FIRST_COMPLETED)
            finally:
                # The services end first: they switch a flying vehicle to hold.
                running.cancel()
                lost.cancel()
                service_end, loss = await asyncio.gather(running, lost, return_exceptions=True)
        if isinstance(loss, SimSessionError):
            raise SimulationLostError(str(loss)) if ready else loss
        if isinstance(service_end, Exception):
            raise service_end


def _opened(options: PlayOptions, scene: Scene) -> AbstractAsyncContextManager[SimProcess]:
    rate_hz = None if options.scene else _CAMERA_RATE_HZ
    if options.cameras > 1:
        rate_hz = min(scene.camera.rate_hz, _CAMERA_RATE_HZ / options.cameras)
    camera = SimOptions(
        camera=_camera_name(options),
        seed=options.seed,
        scene=options.scene,
        camera_rate_hz=rate_hz,
        vehicles=options.vehicles,
        cameras=options.cameras,
        autopilot=options.autopilot,
        gcs_port=_GCS_PORT,
    )
    if options.vehicle_url is None:
        return simulator(camera)
    return camera_of_autopilot(options.vehicle_url, camera)


def _camera_name(options: PlayOptions) -> str | None:
    return f"companion-play-{os.getpid()}" if options.with_camera else None


def _services(settings: Settings, options: PlayOptions, vehicle: SimProcess, say: Say) -> list[Service]:
    """Create a service for each vehicle; that of one without a camera has no perception."""
    name = _camera_name(options)
    first = session_settings(vehicle.port, name, chosen=settings, system_id=vehicle.system_id)
    if options.vehicle_url is None:
        first = _with(
            first, vehicle={"signing_key_file": None}
        )  # the key in the settings is for another vehicle
    several = [first]
    for number in range(2, options.vehicles + 1):
        zenoh = first.zenoh
        if zenoh.mode == "peer":
            listen = (f"{_TCP}127.0.0.1:{free_port(socket.SOCK_STREAM)}",)
            zenoh = zenoh.model_copy(update={"listen": listen, "connect": zenoh.listen or zenoh.connect})
        camera = camera_name(name, number) if name is not None and number <= options.cameras else None
        several.append(
            _with(
                first,
                vehicle={
                    "name": f"vehicle{number}",
                    "system_id": number,
                    "url": f"udpin://127.0.0.1:{vehicle.port + number - 1}",
                },
                source={"uri": NO_SOURCE if camera is None else f"shm://{camera}"},
                detector={"enabled": first.detector.enabled and camera is not None},
                recording={"video": None},
                metrics={"listen": None},
            ).model_copy(update={"zenoh": zenoh})
        )
    return [
        Service(one, on_event=_printer(say, one.vehicle.name if options.vehicles > 1 else None))
        for one in several
    ]


def _with(settings: Settings, **sections: dict[str, Any]) -> Settings:
    return settings.model_copy(
        update={name: getattr(settings, name).model_copy(update=keys) for name, keys in sections.items()}
    )


def _printer(say: Say, vehicle: str | None) -> Callable[[Event], None]:
    return lambda event: say(event.text if vehicle is None else f"{vehicle}: {event.text}")


def _print_next_commands(services: list[Service], cameras: int, scene: Scene, say: Say) -> None:
    zenoh = services[0].settings.zenoh
    connect = "" if zenoh == type(zenoh)() else f" --connect {(zenoh.listen or zenoh.connect)[0]}"
    known = services[0].perception.status.class_names
    classes = sorted({item.class_name for item in scene.world.objects} & set(known))
    if cameras:
        say(f"the scene {scene.name!r} has: {', '.join(classes) or 'no class of the model'}")
    else:
        say("no camera (--source none): commands that need to see an object are refused")
    if 0 < cameras < len(services):
        say(f"only {services[0].settings.vehicle.name} has a camera: more than {_MAX_CAMERAS} vehicles")
    say("ready for commands; in another terminal:")
    for number, service in enumerate(services, 1):
        name = service.settings.vehicle.name
        to = connect if len(services) == 1 else f"{connect} --vehicle-name {name}"
        say(f'  companion send{to} "takeoff 5"{"" if len(services) == 1 else f"   # {name}"}')
        if classes and number <= cameras:
            target = "car" if "car" in classes else classes[0]
            say(f'  companion send{to} "seek {target}"')
    say(f"  companion echo{connect} {'detections' if cameras else 'vehicle'}")
    say("Ctrl-C ends it")
