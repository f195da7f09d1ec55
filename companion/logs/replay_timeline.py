"""What differs between a recorded flight and its replay, in the order of time."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

# Shorter pauses do not end a difference.
_PAUSE_S = 0.5
# Smaller differences of a setpoint are not listed: field → tolerance, and the factor and unit to print it.
_TOLERANCES = {
    "velocity_ned_mps": (0.1, 1.0, "m/s"),
    "position_ned_m": (0.1, 1.0, "m"),
    "yaw_rad": (math.radians(1.0), math.degrees(1.0), "degrees"),
    "yaw_rate_radps": (math.radians(1.0), math.degrees(1.0), "degrees/s"),
}
TOLERANCES_TEXT = "0.1 m/s, 0.1 m, 1 degree or 1 degree/s"


@dataclass(slots=True)
class Change:
    """One difference. Times are seconds since the first replayed step; the text is of the largest moment."""

    seconds: float
    until_s: float
    text: str


class Timeline:
    """Collects differences; those with one key and short pauses become one."""

    def __init__(self) -> None:
        self._changes: list[Change] = []
        self._newest: dict[Hashable, tuple[Change, float]] = {}

    def add(self, key: Hashable, seconds: float, text: str, size: float = 0.0) -> None:
        """Add a difference at a time. `size`: the text of the largest is kept."""
        change, largest = self._newest.get(key, (None, 0.0))
        if change is None or seconds - change.until_s > _PAUSE_S:
            change, largest = Change(seconds, seconds, text), size
            self._changes.append(change)
        elif size > largest:
            change.text, largest = text, size
        change.until_s = seconds
        self._newest[key] = change, largest

    def sorted(self) -> list[Change]:
        """The differences by their begin; of one step in the order of adding."""
        return sorted(self._changes, key=lambda change: change.seconds)


def setpoint_difference(
    recorded: dict[str, Any] | None, replayed: dict[str, Any] | None
) -> tuple[float, str] | None:
    """Return how much two setpoints of outputs differ, in tolerances, and in words; None: not more."""
    if recorded is None or replayed is None:
        if recorded is replayed:
            return None
        return math.inf, f"setpoint: recorded {_words(recorded)}, replayed {_words(replayed)}"
    largest, text = 1.0, None
    for name, (tolerance, factor, unit) in _TOLERANCES.items():
        was, again = recorded[name], replayed[name]
        if (was is None) != (again is None):
            return math.inf, f"setpoint: recorded {_words(recorded)}, replayed {_words(replayed)}"
        if was is None:
            continue
        apart = math.dist(was, again) if isinstance(was, list) else abs(was - again)
        if name == "yaw_rad":
            apart = abs(math.remainder(apart, math.tau))
        if apart / tolerance > largest:
            largest = apart / tolerance
            text = (
                f"setpoint differs by {apart * factor:.2f} {unit}: recorded {_words(recorded)}, "
                f"replayed {_words(replayed)}"
            )
    return None if text is None else (largest, text)


def _words(setpoint: dict[str, Any] | None) -> str:
    if setpoint is None:
        return "none"
    words = []
    for name, (_, factor, unit) in _TOLERANCES.items():
        value = setpoint[name]
        if value is not None:
            values = value if isinstance(value, list) else [value]
            numbers = ", ".join(f"{each * factor:.2f}" for each in values)
            words.append(
                f"{name.partition('_ned')[0].removesuffix('_rad').removesuffix('_radps')} ({numbers}) {unit}"
            )
    return ", ".join(words).replace("_", " ")
