"""Changes a few settings of the running service: the query `settings`."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from companion.bus.bodies.service import ChangedSettingBody, LiveSettingBody
from companion.bus.command_intake import Allowance
from companion.guidance.interface import ChangedLimits
from companion.host.peer_data import PeerDataError, parse_object
from companion.perception.cameras import WorkerCamera
from companion.service.inputs import InputAssembler
from companion.settings import DetectorSection, Settings
from companion.settings.fields import shown
from companion.settings.live import LIMITS, describe_live, live_values, with_live_values
from companion.settings.reading import ConfigurationError
from companion.vehicle.driver import Driver

# Queries that change something: a ground station sends one for each of its parameters.
CHANGES_PER_S, CHANGES_AT_ONCE = 2.0, 20


class LiveSettings:
    """The settings as they are now. A restart returns to those of the file.

    Args:
        settings: those of the file.
        on_event: called with (level, text) for every changed value.

    Attributes:
        now: the settings with all changes.
    """

    def __init__(
        self,
        settings: Settings,
        driver: Driver,
        inputs: InputAssembler,
        cameras: Sequence[WorkerCamera],
        on_event: Callable[[str, str], None],
    ) -> None:
        self._file = self.now = settings
        self._driver, self._inputs, self._cameras = driver, inputs, cameras
        self._on_event = on_event
        self._allowance = Allowance(CHANGES_PER_S, CHANGES_AT_ONCE)

    async def answer(self, payload: bytes) -> dict[str, LiveSettingBody]:
        """Set all values of a JSON object, or none, and return those of now; empty: only return them.

        Raises:
            PeerDataError: not such an object, too many, or a value that is refused.
        """
        if payload:
            values = parse_object(payload)
            if not self._allowance.take():
                raise PeerDataError(f"more than {CHANGES_PER_S:g} changes a second; send it again later")
            try:
                self.change(values)
            except ConfigurationError as error:
                raise PeerDataError("; ".join(error.problems)) from None
        file = live_values(self._file)
        return {
            key: {"value": value, "file": file[key], **describe_live(key)}  # type: ignore[typeddict-item]
            for key, value in live_values(self.now).items()
        }

    def change(self, values: Mapping[str, Any]) -> None:
        """Set all values or none. Raises ConfigurationError."""
        state, before = self._driver.state, live_values(self.now)
        disarmed = state.connected(time.monotonic_ns()) and not state.armed
        changed = with_live_values(self.now, values, disarmed=disarmed)
        after = live_values(changed)
        differing = [key for key in after if after[key] != before[key]]
        detecting: list[tuple[WorkerCamera, DetectorSection]] = []
        for camera in self._cameras:
            prefix = f"cameras.{camera.name}." if camera.name else ""
            if any(key.startswith(f"{prefix}detector.") for key in differing):
                section = changed.of_camera(camera.name).detector
                try:
                    camera.supervisor.check_detecting(section)
                except ValueError as error:
                    raise ConfigurationError(f"{prefix}{error}") from None
                detecting.append((camera, section))
        # All of them are accepted from here on.
        self.now = changed
        for camera, section in detecting:
            camera.supervisor.change_detecting(section)
        if any(key.startswith("guidance.") for key in differing):
            self._inputs.limits = ChangedLimits(**{name: getattr(changed.guidance, name) for name in LIMITS})
        for key in differing:
            self._on_event("info", f"setting changed: {key} = {shown(after[key])}, was {shown(before[key])}")

    def changes(self) -> list[ChangedSettingBody]:
        """The values that differ from the file."""
        file = live_values(self._file)
        return [
            {"key": key, "value": value, "file": file[key]}
            for key, value in live_values(self.now).items()
            if value != file[key]
        ]
