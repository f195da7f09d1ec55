"""The faults of one vehicle: begin, end, schedule and list them.

Every vehicle has a `Faults`; it is used alike in lockstep and over sockets:

>>> from mavlink_sim.vehicles.vehicle import Vehicle
>>> vehicle = Vehicle()
>>> number = vehicle.faults.begin("gps_loss at=20 for=10")
>>> vehicle.faults.end(number)
1

Times are simulated seconds since the vehicle was created, independent of reboots, time jumps and stalls. The
grammar is in `grammar`, the effect of each fault in `kinds` and in docs/faults.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Any

from mavlink_sim.camera.freeze import CameraFreeze
from mavlink_sim.faults.context import ActiveFault, CommandCheck, FaultTarget, Gate
from mavlink_sim.faults.grammar import Fault, FaultError, kind_named, parse_fault
from mavlink_sim.faults.kinds import EFFECTS, KINDS
from mavlink_sim.faults.link_effects import chosen_links
from mavlink_sim.faults.message_effects import shifted
from mavlink_sim.physics.fallible_estimate import as_reported
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.wire.link_faults import LinkStage
from mavlink_sim.wire.links import Link


@dataclass(frozen=True)
class Outcome:
    """The answer to one line of the grammar: whether it succeeded, and one or more lines of text."""

    ok: bool
    text: str


class Faults:
    """The faults of one vehicle.

    Attributes:
        deaf: the vehicle neither receives nor sends (it reboots).
        command_checks: called before each command is executed; by fault number.
        gates: every message that the vehicle sends passes these; by fault number.
        boot_offset_us: added to the boot time in everything that is sent.
        elapsed_us: `now_s` in microseconds.
        known: active and scheduled faults, by number; without any, `step` need not be called if `elapsed_us`
            is advanced.
        second: other autopilots on the same links; by fault number.
        frozen_camera: the frozen parts of the vehicle's camera; by fault number.
        winds: added to the wind, NED m/s; by fault number.
        pace: simulated seconds of the vehicle per second of the faults' clock; 0 while it is frozen.
    """

    def __init__(self, vehicle: FaultTarget, seed: int, on_event: Callable[[str], None]) -> None:
        self.vehicle = vehicle
        self._on_event = on_event
        self.deaf = False
        self.gates: dict[int, Gate] = {}
        self.command_checks: dict[int, CommandCheck] = {}
        self.boot_offset_us = 0
        self.second: dict[int, FaultTarget] = {}
        self.winds: dict[int, Vector] = {}
        self.frozen_camera: dict[int, CameraFreeze] = {}
        self.pace = 1.0
        self._seed = seed
        self.elapsed_us = 0
        self._credit = 0.0
        self._count = 0
        self.known: dict[int, ActiveFault] = {}
        self._stages: dict[str, LinkStage] = {}
        self._held: list[tuple[str, Any]] = []
        self._reads_held = False

    # ---- control ----------------------------------------------------------------------------------------

    @property
    def now_s(self) -> float:
        """Simulated seconds since the vehicle was created."""
        return self.elapsed_us / 1e6

    @property
    def camera_freeze(self) -> CameraFreeze:
        """The frozen parts of the camera."""
        return reduce(or_, self.frozen_camera.values(), CameraFreeze.NOTHING)

    @property
    def active(self) -> list[ActiveFault]:
        """The active faults, oldest first."""
        return [one for one in self.known.values() if one.active]

    @property
    def scheduled(self) -> list[ActiveFault]:
        """The faults that have not begun."""
        return [one for one in self.known.values() if not one.active]

    def begin(
        self,
        fault: str | Fault,
        *values: float | str,
        at_s: float | None = None,
        duration_s: float | None = None,
        seed: int | None = None,
        **options: float | str,
    ) -> int:
        """Begin a fault, now or at a time.

        Args:
            fault: a whole line of the grammar, or a fault's name that `values` and `options` complete.
            at_s: when; None: now.
            duration_s: for how long; None: until `end`.
            seed: of its random numbers; None: derived from the vehicle's seed and the fault's number.

        Returns:
            Its number.

        Raises:
            FaultError: an unknown fault, or invalid values.
        """
        if isinstance(fault, str):
            timing = {"at": at_s, "for": duration_s, "seed": seed}
            words = [str(value) for value in values]
            words += [f"{name}={value}" for name, value in options.items()]
            words += [f"{name}={value}" for name, value in timing.items() if value is not None]
            fault = parse_fault(" ".join([fault, *words]), KINDS)
        if "link" in fault.values:
            chosen_links(self.vehicle, fault.values["link"])
        self._count += 1
        number = self._count
        begins_s = self.now_s if fault.at_s is None else fault.at_s
        if begins_s < self.now_s - 1e-9:
            raise FaultError(f"{fault.kind.name}: at={begins_s:g} is in the past, now is {self.now_s:.1f} s")
        own_seed = self._seed * 1_000_003 + number if fault.seed is None else fault.seed
        one = self.known[number] = ActiveFault(number, fault, own_seed, begins_s)
        if begins_s <= self.now_s + 1e-9:
            self._start(one)
        return number

    def end(self, which: int | str = "all") -> int:
        """End or unschedule faults: one number, all of one name, or "all". Returns how many.

        Raises FaultError if there is none.
        """
        text = str(which)
        chosen = [
            one
            for one in self.known.values()
            if text == "all" or text == one.fault.kind.name or text == str(one.number)
        ]
        if not chosen and text != "all":
            raise FaultError(f"there is no fault {text[:40]} to end; `list` shows the active ones")
        for one in chosen:
            self._finish(one)
        return len(chosen)

    def command(self, line: str) -> Outcome:
        """Execute a line of the grammar: a fault, `list`, `help [FAULT]`, `end NUMBER|FAULT|all`."""
        words = line.split()
        try:
            if not words or words[0] == "list":
                return Outcome(True, "\n".join(self.listing()))
            if words[0] == "help":
                return Outcome(True, "\n".join(_help(words[1:])))
            if words[0] == "end":
                if len(words) != 2:
                    raise FaultError("usage: end NUMBER|FAULT|all")
                return Outcome(True, f"ended {self.end(words[1])}")
            number = self.begin(line)
        except FaultError as error:
            return Outcome(False, str(error))
        one = self.known.get(number)
        if one is None:
            return Outcome(True, f"fault {number}: done")
        return Outcome(True, f"fault {one}" + ("" if one.active else f" at {one.begins_s:g} s"))

    def listing(self) -> list[str]:
        """One line for each active or scheduled fault."""
        lines = []
        for one in self.known.values():
            if one.active:
                left = "" if math.isinf(one.ends_s) else f", {one.ends_s - self.now_s:.1f} s left"
                lines.append(f"{one}: since {one.begins_s:.1f} s{left}")
            else:
                lines.append(f"{one}: begins at {one.begins_s:g} s")
        return lines or ["no faults"]

    # ---- for the vehicle --------------------------------------------------------------------------------

    def stage(self, link: str) -> LinkStage:
        """The impairments of a link's datagrams."""
        return self._stages.setdefault(link, LinkStage())

    def step(self, dt_s: float) -> bool:
        """Advance time: begin and end what is due. True: the vehicle is stalled in this step."""
        self.elapsed_us += int(dt_s * 1e6 + 0.5)
        if not self.known:
            return False
        now_s = self.now_s + 1e-9
        self.vehicle.estimate.refresh()
        for one in list(self.known.values()):
            if not one.active and one.begins_s <= now_s:
                self._start_scheduled(one)
            elif one.active and one.ends_s <= now_s:
                self._finish(one)
        stands_still = False
        if self.pace < 1.0:
            self._credit += self.pace
            if self._credit < 1.0:
                stands_still = True
            else:
                self._credit -= 1.0
        for one in list(self.known.values()):
            if one.active and one.each_step is not None and (one.apart or not stands_still):
                one.each_step(dt_s)
        if stands_still:
            return True
        if self.winds:
            self.vehicle.reload_wind(self.winds.values())
        return False

    def intercepts(self, link: str, message: Any) -> bool:
        """Whether the vehicle must not handle a received message now."""
        if not self._reads_held:  # the others have received those
            for other in self.second.values():
                other.handle(link, message)
        if self.deaf:
            return True
        if self.pace == 0.0:
            self._held.append((link, message))
            return True
        return False

    def take_in_held(self) -> None:
        """Handle the messages that arrived while the vehicle was stalled."""
        held, self._held = self._held, []
        self._reads_held = True
        for link, message in held:
            self.vehicle.handle(link, message)
        self._reads_held = False

    def gate(self, link: Link, message: Any) -> Any:
        """The message to send instead of this one; None: nothing."""
        if self.deaf:
            return None
        for gate in self.gates.values():
            message = gate(link, message)
            if message is None:
                return None
        estimate = self.vehicle.estimate
        if estimate.reset_counter or estimate.fix_lost:
            message = as_reported(estimate, message)
        if self.boot_offset_us:
            message = shifted(message, self.boot_offset_us)
        return message

    def refuses(self, command: int, parameters: tuple[float, ...]) -> int | None:
        """The MAV_RESULT with which a fault rejects a command that is not executed yet; None: it does not."""
        for check in list(self.command_checks.values()):
            result = check(command, parameters)
            if result is not None:
                return result
        return None

    def finish(self, number: int) -> None:
        """End a fault that ends by itself."""
        if number in self.known:
            self._finish(self.known[number])

    # ---- beginning and ending ---------------------------------------------------------------------------

    def _start_scheduled(self, one: ActiveFault) -> None:
        try:
            self._start(one)
        except FaultError as error:
            self._on_event(f"fault {one} did not begin: {error}")

    def _start(self, one: ActiveFault) -> None:
        one.active = True
        one.begins_s = self.now_s
        if one.fault.duration_s is not None:
            one.ends_s = self.now_s + one.fault.duration_s
        try:
            EFFECTS[one.fault.kind.name](self.vehicle, one)
        except FaultError:
            del self.known[one.number]
            raise
        self._on_event(f"fault {one} begins")
        if one.fault.kind.momentary:
            self.known.pop(one.number, None)

    def _finish(self, one: ActiveFault) -> None:
        if self.known.pop(one.number, None) is None:
            return
        if one.active:
            one.active = False
            for undo in reversed(one.undo):
                undo()
            self._on_event(f"fault {one} ends")


def _help(words: list[str]) -> list[str]:
    if words:
        kind = kind_named(words[0], KINDS)
        lines = [f"{kind.usage} [at=S] {'' if kind.momentary else '[for=S] '}[seed=N]", f"  {kind.summary}"]
        return lines + [f"  {one.name}: {one.meaning}" for one in kind.fields]
    width = max(map(len, KINDS))
    lines = [f"{name:{width}}  {kind.summary}" for name, kind in KINDS.items()]
    return [*lines, "at=S begins later, for=S ends by itself; list, help FAULT, end NUMBER|FAULT|all"]
