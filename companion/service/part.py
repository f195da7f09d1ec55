"""A part of the service that may be missing, and what is known of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from companion.perception.cameras import WorkerCamera
from companion.perception.status import PerceptionState


class PartState(StrEnum):
    """State of a part."""

    STARTING = "starting"
    READY = "ready"
    MISSING = "missing"  # nothing answers; it is used as soon as it does
    RETRYING = "retrying"  # has failed, and is tried again within seconds
    FAILED = "failed"  # repeatedly, and is tried again every 30 s; a client with wrong settings is not
    FINISHED = "finished"  # a source that has ended


_OF_CAMERAS = {
    PerceptionState.STOPPED: PartState.STARTING,
    PerceptionState.STARTING: PartState.STARTING,
    PerceptionState.RUNNING: PartState.READY,
    PerceptionState.RESTARTING: PartState.RETRYING,
    PerceptionState.FINISHED: PartState.FINISHED,
    PerceptionState.FAILED: PartState.FAILED,
}


@dataclass(frozen=True, slots=True)
class Part:
    """What is known of a part. Times are CLOCK_MONOTONIC nanoseconds.

    Attributes:
        name: autopilot, zenoh, camera, `camera NAME`, recorder, foxglove, ros2 or ground_station.
        reason: why it is not ready; empty: it is, or it is not known yet.
        since_ns: begin of the state. next_try_ns: None: it is tried all the time, or needs no try.
    """

    name: str
    state: PartState
    reason: str = ""
    next_try_ns: int | None = None
    since_ns: int = 0

    @property
    def up(self) -> bool:
        """Whether it needs nothing more."""
        return self.state in (PartState.READY, PartState.FINISHED)

    def text(self, now_ns: int) -> str:
        """What is missing and why, for an operator."""
        text = f"{self.name}: {self.reason or self.state.value}"
        if self.next_try_ns is not None:
            text += f" (next try in {max(self.next_try_ns - now_ns, 0) / 1e9:.0f} s)"
        return text


def part_of_camera(camera: WorkerCamera) -> Part:
    """Return a camera as a part."""
    supervisor = camera.supervisor
    name = "camera" if camera.name is None else f"camera {camera.name}"
    state = _OF_CAMERAS[supervisor.state]
    reason = "" if state is PartState.READY else supervisor.problem
    if state is PartState.FINISHED:
        reason = "its source has ended"
    return Part(name, state, reason, supervisor.next_try_ns)
