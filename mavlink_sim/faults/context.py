"""What the effects of faults use: the fault itself, the state of all faults, and the vehicle they act on."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

from mavlink_sim.autopilot.commander import Autopilot
from mavlink_sim.camera.freeze import CameraFreeze
from mavlink_sim.faults.grammar import Fault
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.fallible_estimate import FallibleEstimate
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.physics.vision_aiding import VisionAiding
from mavlink_sim.wire.link_faults import LinkStage
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import Outgoing

# Of a message that the vehicle sends: the one to send instead, or None to drop it.
Gate = Callable[[Link, Any], Any]
# Of a command's identifier and parameters: the MAV_RESULT that it is refused with, or None.
CommandCheck = Callable[[int, tuple[float, ...]], int | None]


@dataclass
class ActiveFault:
    """One requested fault.

    Attributes:
        number: its identifier; counts from 1.
        seed: of its random numbers.
        begins_s, ends_s: on the faults' clock; `ends_s` is infinite without a duration.
        undo: called at the end in reverse order, to restore the state before.
        each_step: called with the step's seconds while it is active.
        apart: independent of the vehicle; continues while the vehicle is stalled.
    """

    number: int
    fault: Fault
    seed: int
    begins_s: float
    ends_s: float = math.inf
    active: bool = False
    undo: list[Callable[[], object]] = field(default_factory=list)
    each_step: Callable[[float], None] | None = None
    apart: bool = False

    def __str__(self) -> str:
        return f"{self.number} {self.fault}"


class FaultState(Protocol):
    """The state of `schedule.Faults` that effects use; see there."""

    deaf: bool
    gates: dict[int, Gate]
    command_checks: dict[int, CommandCheck]
    boot_offset_us: int
    second: dict[int, FaultTarget]
    winds: dict[int, Vector]
    frozen_camera: dict[int, CameraFreeze]
    pace: float

    @property
    def now_s(self) -> float: ...

    @property
    def active(self) -> list[ActiveFault]: ...

    def stage(self, link: str) -> LinkStage: ...

    def finish(self, number: int) -> None: ...

    def take_in_held(self) -> None: ...


class FaultTarget(Protocol):
    """The vehicle that faults act on; `vehicle.Vehicle` is one."""

    system_id: int
    links: dict[str, Link]
    autopilot: Autopilot
    airframe: Multirotor
    estimate: FallibleEstimate
    vision: VisionAiding

    @property
    def faults(self) -> FaultState: ...

    def add_link(self, name: str, rates_hz: dict[str, float] | None = None) -> Link: ...

    def handle(self, link_name: str, message: Any) -> None: ...

    def outgoing(self, link: str) -> list[Outgoing]: ...

    def step(self, dt_s: float) -> None: ...

    def after(self, delay_s: float, action: Callable[[], object]) -> None: ...

    def reboot(self) -> None: ...

    def reload_wind(self, more: Iterable[Vector] = ()) -> None: ...

    def second_autopilot(self, system_id: int, seed: int, east_m: float) -> FaultTarget: ...
