"""What a failed check does: its action, when it ends, and how a pilot may end it.

The rules are those of PX4 v1.14 to v1.18. Names in capitals are PX4's parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum

from mavlink_sim.physics.battery import BatteryWarning


class Action(IntEnum):
    """The failsafe actions in order of severity; the worst wins. The values are those of PX4's events."""

    NONE = 0
    WARN = 1
    FALLBACK_POSITION = 2
    FALLBACK_ALTITUDE = 3
    FALLBACK_STABILIZED = 4
    HOLD = 5
    RETURN = 6
    LAND = 7
    DESCEND = 8
    DISARM = 9
    TERMINATE = 10


class Cause(IntEnum):
    """The cause, by PX4's events."""

    GENERIC = 0
    MANUAL_CONTROL_LOSS = 1
    GROUND_STATION_LOSS = 2
    BATTERY_LOW = 3
    BATTERY_CRITICAL = 4
    BATTERY_EMERGENCY = 5


class Clears(Enum):
    """What ends an action once its condition is over."""

    WITH_CONDITION = "with its condition"
    ON_MODE_CHANGE_OR_DISARM = "on a change of mode or on disarming"
    NEVER = "never"


class Takeover(IntEnum):
    """How a pilot may end an action; the strictest of all active actions applies."""

    ALWAYS = 0
    MODE_SWITCH_ONLY = 1
    AFTER_DELAY = 2  # one of the two above, by COM_FAIL_ACT_T
    NEVER = 3


@dataclass(frozen=True, slots=True)
class Response:
    """The action of a failed check."""

    action: Action
    cause: Cause = Cause.GENERIC
    clears: Clears = Clears.WITH_CONDITION
    takeover: Takeover = Takeover.AFTER_DELAY


UNTIL_MODE_CHANGE = Clears.ON_MODE_CHANGE_OR_DISARM


def link_loss_response(value: int, cause: Cause) -> Response:
    """NAV_RCL_ACT and NAV_DLL_ACT: 1 hold, 2 return, 3 land, 5 terminate, 6 disarm; else nothing."""
    if value in (1, 2, 3):
        action = (Action.HOLD, Action.RETURN, Action.LAND)[value - 1]
        return Response(action, cause, UNTIL_MODE_CHANGE)
    if value == 5:
        return Response(Action.TERMINATE, cause, Clears.NEVER, Takeover.NEVER)
    if value == 6:
        return Response(Action.DISARM, cause, takeover=Takeover.NEVER)
    return Response(Action.NONE, cause)


def battery_response(value: int, warning: BatteryWarning) -> Response:
    """COM_LOW_BAT_ACT: 0 warn, 1 return, 2 land, 3 return when critical and land in an emergency."""
    if warning is BatteryWarning.CRITICAL:
        action = {1: Action.RETURN, 2: Action.LAND, 3: Action.RETURN}.get(value, Action.WARN)
        return Response(action, Cause.BATTERY_CRITICAL)
    if warning is BatteryWarning.EMERGENCY:
        action = {1: Action.RETURN, 2: Action.LAND, 3: Action.LAND}.get(value, Action.WARN)
        return Response(action, Cause.BATTERY_EMERGENCY)
    return Response(Action.WARN, Cause.BATTERY_LOW)


def geofence_response(value: int) -> Response:
    """GF_ACTION and COM_WIND_MAX_ACT: 0 nothing, 1 warn, 2 hold, 3 return, 4 terminate, 5 land."""
    if value == 2:
        return Response(Action.HOLD, clears=UNTIL_MODE_CHANGE, takeover=Takeover.MODE_SWITCH_ONLY)
    if value == 4:
        return Response(Action.TERMINATE, clears=Clears.NEVER, takeover=Takeover.NEVER)
    actions = {0: Action.NONE, 3: Action.RETURN, 5: Action.LAND}
    return Response(actions.get(value, Action.WARN), clears=UNTIL_MODE_CHANGE)


def motor_response(value: int) -> Response:
    """COM_ACT_FAIL_ACT: 0 warn, 1 hold, 2 land, 3 return, 4 terminate."""
    if value == 4:
        return Response(Action.TERMINATE, clears=Clears.NEVER)
    if value == 1:
        return Response(Action.HOLD)
    actions = {2: Action.LAND, 3: Action.RETURN}
    return Response(actions.get(value, Action.WARN), clears=UNTIL_MODE_CHANGE)
