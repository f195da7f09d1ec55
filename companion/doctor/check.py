"""One result of `companion doctor`: what was checked, what was found, and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class Verdict(StrEnum):
    """The result of a check, the worst first."""

    FAULT = "fault"  # a part does not work, or the vehicle is in danger
    WARNING = "warning"  # it works, and worse than it could
    UNKNOWN = "unknown"  # it could not be checked
    OK = "ok"


@dataclass(frozen=True, slots=True)
class Check:
    """One result.

    Attributes:
        name: what was checked, a few words; with the name of a camera or of a part.
        found: what is so, one sentence without a full stop.
        advice: the line that mends it, a command where there is one; empty: nothing to do.
    """

    name: str
    verdict: Verdict
    found: str
    advice: str = ""


def ok(name: str, found: str) -> Check:
    """Nothing to do."""
    return Check(name, Verdict.OK, found)


def warning(name: str, found: str, advice: str) -> Check:
    """It works, and worse than it could."""
    return Check(name, Verdict.WARNING, found, advice)


def fault(name: str, found: str, advice: str) -> Check:
    """It does not work, or the vehicle is in danger."""
    return Check(name, Verdict.FAULT, found, advice)


def unknown(name: str, found: str, advice: str = "") -> Check:
    """It could not be checked."""
    return Check(name, Verdict.UNKNOWN, found, advice)


def worst_first(checks: Iterable[Check]) -> list[Check]:
    """Return the checks in the order of their verdicts."""
    order = list(Verdict)
    return sorted(checks, key=lambda check: order.index(check.verdict))


def exit_code(checks: Iterable[Check]) -> int:
    """0: sound; 1: warnings; 2: faults."""
    verdicts = {check.verdict for check in checks}
    return 2 if Verdict.FAULT in verdicts else 1 if Verdict.WARNING in verdicts else 0
