"""Reports once that a camera's images do not change, and once that they do again."""

from __future__ import annotations

from collections.abc import Callable

from companion.perception.cameras import PerceptionCamera


class FreezeReports:
    """The frozen cameras of a vehicle. `on_event` is called with (level, text) for the operator.

    Attributes:
        frozen: those that were reported.
    """

    def __init__(self, on_event: Callable[[str, str], None]) -> None:
        self._on_event = on_event
        self.frozen: set[PerceptionCamera] = set()

    def update(self, camera: PerceptionCamera, now_ns: int) -> None:
        """A result of a camera was received; the targets of a frozen one are removed."""
        frozen = camera.frozen(now_ns)
        prefix = "" if camera.name is None else f"camera {camera.name}: "
        if frozen:
            camera.targets, camera.localization_error = (), frozen
            if camera not in self.frozen:
                self.frozen.add(camera)
                self._on_event("warning", f"{prefix}{frozen}; nothing of it is used")
        elif not camera.repeats and camera in self.frozen:
            self.frozen.discard(camera)
            self._on_event("info", f"{prefix}the camera's images change again")
