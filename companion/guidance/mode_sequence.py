"""A mode request as a sequence of actions: mode, pre-arm checks, arming, take-off."""

from __future__ import annotations

from companion.guidance.behaviour import ModeRequest
from companion.guidance.interface import Arm, SetMode, TakeOff
from companion.vehicle.state import FlightMode, VehicleState

# After a change of mode PX4 runs its pre-arm checks again; the result comes with the next heartbeat.
READY_TIMEOUT_S = 3.0


class ModeSequence:
    """The actions of one mode request. Only a take-off with `arm` set arms."""

    def __init__(self, request: ModeRequest, state: VehicleState) -> None:
        self._actions: list[SetMode | Arm | TakeOff] = []
        self._waiting_since_ns: int | None = None
        if request.mode is not FlightMode.TAKEOFF or request.altitude_m is None:
            self._actions.append(SetMode(request.mode))
            return
        if request.arm and not state.armed:
            # After a landing PX4 may show the mode from before the landing, in which it does not arm.
            if state.mode is not FlightMode.HOLD:
                self._actions.append(SetMode(FlightMode.HOLD))
            self._actions.append(Arm())
        self._actions.append(TakeOff(request.altitude_m))

    @property
    def finished(self) -> bool:
        """Whether every action was returned by `next`."""
        return not self._actions

    def next(self, now_ns: int, state: VehicleState) -> SetMode | Arm | TakeOff | None:
        """The next action, once the previous one is done. None: the pre-arm checks still run.

        After `READY_TIMEOUT_S` arming is requested anyway: the autopilot then reports what is wrong.
        """
        if not self._actions:
            return None
        if isinstance(self._actions[0], Arm) and not state.ready_to_arm:
            if self._waiting_since_ns is None:
                self._waiting_since_ns = now_ns
            if now_ns - self._waiting_since_ns <= READY_TIMEOUT_S * 1e9:
                return None
        return self._actions.pop(0)
