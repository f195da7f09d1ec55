"""The least charge to fly with: below it no behaviour begins, and one that flies is ended.

The autopilot's own estimate is taken as it is told (SYS_STATUS and BATTERY_STATUS, `battery_remaining`). One
that does not come, or comes no more, is not guessed: nothing begins without it. It does not end a flight: to
lose a message is no reason to land somewhere, and the autopilot's own battery failsafe goes on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from companion.guidance.behaviour import Behaviour, Requirement
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.land import LandBehaviour, ReturnBehaviour
from companion.vehicle.state import VehicleState

# BATTERY_STATUS comes every two seconds, SYS_STATUS more often: three of the slower one are missing.
BATTERY_MAX_AGE_S = 6.0
# A charge that dips while the motors pull is not a low battery.
LOW_FOR_S = 1.0

BatteryAction = Literal["rtl", "land", "hold"]
ENDINGS: dict[str, type[Behaviour]] = {
    "rtl": ReturnBehaviour,
    "land": LandBehaviour,
    "hold": HoldBehaviour,
}


@dataclass(frozen=True, slots=True)
class BatteryMinimum:
    """What charge a behaviour needs, 0..1 (0: none), and what follows a flight that falls below it.

    Raises:
        ValueError: the fraction is outside 0..1, or the action is none.
    """

    fraction: float = 0.0
    action: BatteryAction = "rtl"

    def __post_init__(self) -> None:
        if not 0.0 <= self.fraction <= 1.0:
            raise ValueError(f"the least charge must be 0 to 1, got {self.fraction}")
        if self.action not in ENDINGS:
            raise ValueError(f"the action must be one of {', '.join(ENDINGS)}, got {self.action!r}")

    def missing(self, behaviour: Behaviour, state: VehicleState, now_ns: int) -> str | None:
        """What a behaviour that needs charge lacks, in words; None: nothing."""
        if self.fraction == 0.0 or not needs_charge(behaviour):
            return None
        charge = fresh_charge(state, now_ns)
        needed = f"a battery above {self.fraction:.0%}"
        if charge is not None and charge >= self.fraction:
            return None
        return f"{needed} ({_known(state, now_ns)}; guidance.min_battery_percent)"

    def below(self, state: VehicleState, now_ns: int) -> bool:
        """A fresh value says that the charge is less than allowed."""
        charge = fresh_charge(state, now_ns)
        return charge is not None and charge < self.fraction


NO_MINIMUM = BatteryMinimum()


def needs_charge(behaviour: Behaviour) -> bool:
    """It flies on: it says so, or it begins on the ground or steers. Ways down and handing back do not."""
    flies = {Requirement.BATTERY, Requirement.POSITION, Requirement.ON_GROUND}
    return not behaviour.requirements.isdisjoint(flies)


def fresh_charge(state: VehicleState, now_ns: int) -> float | None:
    """The charge, 0..1; None when it is not known or too old."""
    if state.battery_fraction is None or now_ns - state.battery_ns > BATTERY_MAX_AGE_S * 1e9:
        return None
    return state.battery_fraction


def _known(state: VehicleState, now_ns: int) -> str:
    if state.battery_fraction is None:
        return "the autopilot does not tell its charge"
    if fresh_charge(state, now_ns) is None:
        return f"its charge is not known: last told {(now_ns - state.battery_ns) / 1e9:.0f} s ago"
    return f"it has {state.battery_fraction:.0%}"


class BatteryMonitor:
    """Looks at the charge in flight: says once when it has run low, and once when it is not told any more."""

    def __init__(self, minimum: BatteryMinimum) -> None:
        self.minimum = minimum
        self._low_since_ns: int | None = None
        self._unknown = False
        self._acted = False

    def reset(self) -> None:
        """A new command: what was said of the one before is said again."""
        self._low_since_ns, self._unknown, self._acted = None, False, False

    def ending(self, behaviour: Behaviour, state: VehicleState, now_ns: int) -> str | None:
        """Why what flies now must end; told once for each command."""
        if self._acted or self.minimum.fraction == 0.0 or not needs_charge(behaviour):
            return None
        if not self.minimum.below(state, now_ns):
            self._low_since_ns = None
            return None
        if self._low_since_ns is None:
            self._low_since_ns = now_ns
        if now_ns - self._low_since_ns < LOW_FOR_S * 1e9:
            return None
        self._acted = True
        return (
            f"the battery has {state.battery_fraction:.0%}, below the {self.minimum.fraction:.0%} of "
            f"guidance.min_battery_percent"
        )

    def unknown(self, behaviour: Behaviour, state: VehicleState, now_ns: int) -> str | None:
        """That the charge is not told any more; said once until it is told again."""
        if self.minimum.fraction == 0.0 or not needs_charge(behaviour):
            return None
        before, self._unknown = self._unknown, fresh_charge(state, now_ns) is None
        if before or not self._unknown:
            return None
        return f"battery: {_known(state, now_ns)}; flying on, the autopilot's own failsafe watches it"
