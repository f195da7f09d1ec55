"""Passes the autopilot's warnings, and what the driver restored, on to the operator."""

from __future__ import annotations

from collections.abc import Callable

from companion.vehicle.px4_modes import among_modes
from companion.vehicle.report import Report
from companion.vehicle.state import VehicleState

# Minimum interval of a repeated text, and the number of texts remembered for that.
REPEAT_INTERVAL_S, MAX_REMEMBERED = 10.0, 100


class AutopilotReports:
    """Compares each snapshot of the vehicle with the one before.

    Args:
        on_event: called with (level, text) for the operator.
    """

    def __init__(self, on_event: Callable[[str, str], None]) -> None:
        self._on_event = on_event
        self._reported: tuple[Report, ...] = ()
        self._logged_ns: dict[str, int] = {}
        self._restored = ""

    def update(self, state: VehicleState) -> None:
        """Report what is new in a snapshot: warnings about the current mode, and a restored mode."""
        if state.reports is not self._reported:
            self._log(state)
        if state.mode_restored is not self._restored:
            self._restored = state.mode_restored
            if self._restored:
                self._on_event("warning", self._restored)

    def _log(self, state: VehicleState) -> None:
        last_ns = self._reported[-1].stamp_ns if self._reported else 0
        self._reported = state.reports
        for report in state.warnings_since(last_ns + 1):
            logged_ns = self._logged_ns.get(report.text)
            due = logged_ns is None or report.stamp_ns - logged_ns >= REPEAT_INTERVAL_S * 1e9
            if due and among_modes(state.mode, report.modes):
                self._logged_ns[report.text] = report.stamp_ns
                self._on_event("warning", f"autopilot: {report.text}")
        if len(self._logged_ns) > MAX_REMEMBERED:
            self._logged_ns.clear()
