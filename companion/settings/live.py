"""The settings that can be changed while the service runs, and the rule when.

A limit can be made narrower at any time, wider only while the vehicle is disarmed. Confidence and classes of
a detector only change what is detected: a behaviour that flies to an object which is not detected any more
brakes, as for every lost object. Anything else needs the file and a restart.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Literal

from annotated_types import Ge, Gt, Le, Lt
from pydantic.fields import FieldInfo

from companion.settings.fields import expectation, fields_of_sections, section_of, value_from_text
from companion.settings.reading import ConfigurationError, with_values
from companion.settings.settings import Settings

NARROWER: Final[Mapping[str, Literal["smaller", "larger"] | None]] = {
    "guidance.max_horizontal_speed_mps": "smaller",
    "guidance.max_climb_mps": "smaller",
    "guidance.max_descend_mps": "smaller",
    "guidance.max_altitude_m": "smaller",
    "guidance.min_altitude_m": "larger",
    "guidance.max_distance_m": "smaller",
    "detector.confidence": None,
    "detector.classes": None,
}
"""Key → which values are narrower; None: neither. Each further camera has `cameras.NAME.detector.…`."""

LIMITS: Final = tuple(key.partition(".")[2] for key, narrower in NARROWER.items() if narrower)
"""The names of the limits in `[guidance]`."""


def live_values(settings: Settings) -> dict[str, Any]:
    """Return key → value of all settings that can be changed."""
    keys = [*NARROWER, *(f"cameras.{name}.{key}" for name in settings.cameras for key in _DETECTOR)]
    return {key: _value(settings, key) for key in keys}


def with_live_values(settings: Settings, values: Mapping[str, Any], *, disarmed: bool) -> Settings:
    """Return the settings with changed values.

    Args:
        values: key → value, as in the file.
        disarmed: whether the vehicle is known to be disarmed.

    Raises:
        ConfigurationError: a key that cannot be changed, an invalid value, as at the start, or a limit that
            would be wider in an armed vehicle.
    """
    before = live_values(settings)
    if unknown := [key for key in values if key not in before]:
        raise ConfigurationError(_cannot_change(", ".join(unknown), before))
    changed = with_values(settings, values, "to be set")
    if not disarmed:
        wider = [key for key in values if _is_wider(key, before[key], _value(changed, key))]
        if wider:
            raise ConfigurationError(
                *(
                    f"{key}: {_value(changed, key):g} is wider than {before[key]:g}: accepted only while the "
                    "vehicle is known to be disarmed"
                    for key in wider
                )
            )
    return changed


def live_value_of_text(key: str, text: str) -> Any:
    """Parse a value given as text. Raises ConfigurationError, also for a key that can never be changed."""
    table, _, name = key.rpartition(".")
    section = section_of(table)
    if section is None or f"{section}.{name}" not in NARROWER:
        raise ConfigurationError(_cannot_change(key, NARROWER))
    field = _field(key)
    try:
        return value_from_text(field, text)
    except ValueError:
        raise ConfigurationError(f"{key}: must be {expectation(field)}, got {text!r}") from None


def describe_live(key: str) -> dict[str, Any]:
    """Return the range of a setting that can be changed: `expected`, `minimum`, `maximum`, `narrower`."""
    bounds: dict[str, float | None] = {"minimum": None, "maximum": None}
    for rule in _field(key).metadata:
        if isinstance(rule, Ge | Gt):
            bounds["minimum"] = rule.ge if isinstance(rule, Ge) else rule.gt  # type: ignore[assignment]
        elif isinstance(rule, Le | Lt):
            bounds["maximum"] = rule.le if isinstance(rule, Le) else rule.lt  # type: ignore[assignment]
    return {"expected": expectation(_field(key)), **bounds, "narrower": NARROWER.get(key)}


_DETECTOR = tuple(key for key in NARROWER if key.startswith("detector."))


def _is_wider(key: str, before: Any, after: Any) -> bool:
    narrower = NARROWER.get(key)
    return narrower is not None and bool(after > before if narrower == "smaller" else after < before)


def _cannot_change(key: str, known: Mapping[str, Any]) -> str:
    return f"{key}: cannot be changed while the service runs; these can: {', '.join(known)}"


def _field(key: str) -> FieldInfo:
    table, _, name = key.rpartition(".")
    return fields_of_sections()[table.rpartition(".")[2]][name]


def _value(settings: Settings, key: str) -> Any:
    value: Any = settings
    for word in key.split("."):
        value = value[word] if isinstance(value, dict) else getattr(value, word)
    return value
