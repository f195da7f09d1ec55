"""Answers the queries besides `command`: status, settings, images, models, ports, command grammar."""

from __future__ import annotations

import asyncio
import re
from collections import defaultdict
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from companion.bus.bodies.service import ModelBody, ModelsBody, PortParametersBody, StatusBody
from companion.bus.session import QueryHandler
from companion.bus.topics import IMAGE
from companion.guidance.grammar import json_schema
from companion.operator.console import Target
from companion.perception.cameras import WorkerCamera
from companion.perception.supervisor import PerceptionState
from companion.service.live_settings import LiveSettings
from companion.vehicle.driver import Driver
from companion.vehicle.port_parameters import read_port_parameters
from vision.model_files import kept_models
from vision.redaction import without_password

IMAGE_TIMEOUT_S = 3.0
# User and password in an address, and what follows its path: an access token, a network interface.
_CREDENTIALS = re.compile(r"(?<=://)[^/@\s]+@")
_PARAMETERS = re.compile(r"(?<=[?])\S+")


class Queries:
    """The queryables of one service. Every handler is called in its loop.

    Args:
        status: returns the state of the service.
        driver: whose autopilot's parameters are read.
    """

    def __init__(self, live: LiveSettings, status: Callable[[], StatusBody], driver: Driver) -> None:
        self._live, self._status, self._driver = live, status, driver
        self._reading = asyncio.Lock()
        self._ports: tuple[int, dict[str, float]] = (0, {})  # of which opening of the link
        self._cameras: Sequence[WorkerCamera] = ()
        self._waiting: dict[str | None, list[asyncio.Future[bytes]]] = defaultdict(list)

    def handlers(self, cameras: Sequence[WorkerCamera]) -> dict[str, QueryHandler]:
        """Return path of each queryable → handler."""
        self._cameras = cameras
        images = {IMAGE.path(camera.name): self._image_of(camera) for camera in cameras}
        return {
            "status": self._status_now,
            "config": self._config,
            "models": self._models,
            "commands": self._commands,
            "port_parameters": self._port_parameters,
            **images,
        }

    def target(self, command: Callable[[str], Awaitable[dict[str, Any]]]) -> Target:
        """Return what a console in this process needs, after `handlers` was called."""
        return Target(command, self._live.answer, self._status_now, self._commands)

    def image_wanted(self, camera: WorkerCamera) -> bool:
        """Whether a query waits for this camera's next image."""
        return bool(self._waiting[camera.name])

    def on_image(self, camera: WorkerCamera, jpeg: bytes) -> None:
        """Answer the queries that wait for this camera's image."""
        for waiting in self._waiting.pop(camera.name, ()):
            if not waiting.done():
                waiting.set_result(jpeg)

    async def _status_now(self) -> StatusBody:
        return self._status()

    async def _config(self) -> Any:
        return without_secrets(self._live.now.model_dump(mode="json"))

    async def _models(self) -> ModelsBody:
        loaded: list[ModelBody] = []
        for camera in self._cameras:
            ready = camera.supervisor.ready
            if ready is not None and ready.model is not None:
                loaded.append(
                    {
                        "camera": camera.name,
                        "running": camera.supervisor.state is PerceptionState.RUNNING,
                        "model": ready.model,
                        "model_sha256": ready.model_sha256,
                        "class_names": list(ready.class_names),
                        "runtime": ready.runtime,
                        "precision": ready.precision,
                    }
                )
        files = await asyncio.to_thread(kept_models)
        return {"loaded": loaded, "files": [path.name for path in files]}

    async def _commands(self) -> dict[str, Any]:
        steering = next(camera for camera in self._cameras if camera.name == self._live.now.guidance.camera)
        return json_schema(steering.class_names)

    async def _port_parameters(self) -> PortParametersBody:
        """Read them once for each connection: the autopilot has to restart for another value of most."""
        async with self._reading:
            state, link_count = self._driver.state, self._driver.link_count
            if not state.connected(self._driver.watch.now_ns()):
                return {"parameters": {}, "not_read": "no autopilot"}
            if self._ports[0] != link_count:
                if state.armed:
                    return {"parameters": {}, "not_read": "the vehicle is armed"}
                self._ports = (link_count, await read_port_parameters(self._driver))
            return {"parameters": self._ports[1], "not_read": ""}

    def _image_of(self, camera: WorkerCamera) -> QueryHandler:
        async def image() -> bytes:
            waiting: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
            self._waiting[camera.name].append(waiting)
            camera.supervisor.watch(True)
            try:
                async with asyncio.timeout(IMAGE_TIMEOUT_S):
                    return await waiting
            except TimeoutError:
                state = camera.supervisor.state.value
                raise TimeoutError(f"no image within {IMAGE_TIMEOUT_S:g} s; the camera is {state}") from None
            finally:
                if waiting in self._waiting[camera.name]:
                    self._waiting[camera.name].remove(waiting)

        return image


def without_secrets(value: Any) -> Any:
    """Replace credentials in addresses, and the names of files with keys, by `***`."""
    if isinstance(value, dict):
        return {
            key: "***" if key.endswith("key_file") and item is not None else without_secrets(item)
            for key, item in value.items()
        }
    if isinstance(value, list):
        return [without_secrets(item) for item in value]
    if isinstance(value, str):
        value = without_password(value)
        return _PARAMETERS.sub("***", _CREDENTIALS.sub("***@", value)) if "://" in value else value
    return value
