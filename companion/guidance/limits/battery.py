"""Minimum battery charge: below it no behaviour begins, and an active one is ended.

The charge is the autopilot's estimate (SYS_STATUS and BATTERY_STATUS, `battery_remaining`). Without a fresh
value no behaviour begins. Losing it does not end a flight: a lost message is no reason to land, and the
autopilot's own battery failsafe stays active.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from companion.guidance.behaviour import Behaviour, Requirement
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.land import LandBehaviour, ReturnBehaviour
from companion.guidance.motion import Lasting
from companion.vehicle.state import VehicleState

# BATTERY_STATUS comes every 2 s, SYS_STATUS more often: three of the slower one are missing.
BATTERY_MAX_AGE_S = 6.0
# A short dip under load is not a low battery.
LOW_FOR_S = 1.0

BatteryAction = Literal["rtl", "land", "hold"]
ENDINGS: dict[str, type[Behaviour]] = {
    "rtl": ReturnBehaviour,
    "land": LandBehaviour,
    "hold": HoldBehaviour,
}


@dataclass(frozen=True, slots=True)
class BatteryMinimum:
    """The minimum charge, 0..1 (0: no limit), and the action in flight below it.

    Raises:
        ValueError: the fraction is outside 0..1, or the action is unknown.
    """

    fraction: float = 0.0
    action: BatteryAction = "rtl"

    def __post_init__(self) -> None:
        if not 0.0 <= self.fraction <= 1.0:
            raise ValueError(f"the minimum charge must be 0 to 1, got {self.fraction}")
        if self.action not in ENDINGS:
            raise ValueError(f"the action must be one of {', '.join(ENDINGS)}, got {self.action!r}")

    def missing(self, behaviour: Behaviour, state: VehicleState, now_ns: int) -> str | None:
        """What is missing for a behaviour that needs charge, in words; None: nothing."""
        charge = fresh_charge(state, now_ns)
        if not self.applies_to(behaviour) or (charge is not None and charge >= self.fraction):
            return None
        return f"a battery above {self.fraction:.0%} ({_known(state, now_ns)}; guidance.min_battery_percent)"

    def applies_to(self, behaviour: Behaviour) -> bool:
        """Whether there is a minimum for this behaviour."""
        return self.fraction > 0.0 and needs_charge(behaviour)


NO_MINIMUM = BatteryMinimum()


def needs_charge(behaviour: Behaviour) -> bool:
    """Whether a behaviour keeps flying, so that the minimum applies: not landing, returning and stopping."""
    flies = {Requirement.BATTERY, Requirement.POSITION, Requirement.ON_GROUND}
    return not behaviour.needs.isdisjoint(flies)


def fresh_charge(state: VehicleState, now_ns: int) -> float | None:
    """The charge, 0..1; None when unknown or stale."""
    if state.battery_fraction is None or now_ns - state.battery_ns > BATTERY_MAX_AGE_S * 1e9:
        return None
    return state.battery_fraction


def _known(state: VehicleState, now_ns: int) -> str:
    if state.battery_fraction is None:
        return "battery state not received"
    if fresh_charge(state, now_ns) is None:
        return f"battery state stale ({(now_ns - state.battery_ns) / 1e9:.0f} s)"
    return f"battery at {state.battery_fraction:.0%}"


class BatteryMonitor:
    """Monitors the charge in flight; reports a low battery and a stale battery state once each."""

    def __init__(self, minimum: BatteryMinimum) -> None:
        self.minimum = minimum
        self.reset()

    def reset(self) -> None:
        """Start over for a new command: everything is reported again."""
        self._low, self._unknown, self._acted = Lasting(), False, False

    def ending(self, behaviour: Behaviour, state: VehicleState, now_ns: int) -> str | None:
        """Why the active behaviour must end; reported once per command."""
        charge = fresh_charge(state, now_ns)
        low = self.minimum.applies_to(behaviour) and charge is not None and charge < self.minimum.fraction
        if self._low.held_s(low, now_ns) < LOW_FOR_S or self._acted:
            return None
        self._acted = True
        return (
            f"battery at {state.battery_fraction:.0%}, below guidance.min_battery_percent = "
            f"{self.minimum.fraction * 100:g}"
        )

    def unknown(self, behaviour: Behaviour, state: VehicleState, now_ns: int) -> str | None:
        """That the battery state is unknown or stale; reported once until it is fresh again."""
        if not self.minimum.applies_to(behaviour):
            return None
        before, self._unknown = self._unknown, fresh_charge(state, now_ns) is None
        if before or not self._unknown:
            return None
        return f"{_known(state, now_ns)}; the flight continues, the autopilot's battery failsafe stays active"
