"""MISSION_COUNT, MISSION_ACK and MISSION_CURRENT with the plan identifiers ("opaque ids") of PX4 v1.16.

pymavlink's definitions lack them.
"""

from __future__ import annotations

import struct
from typing import Any

from mavlink_sim.missions.items import PlanType
from mavlink_sim.services.context import ServiceContext
from mavlink_sim.wire.messages import dialect

NO_MISSION_TOTAL = 65535

_COUNT = struct.Struct("<HBBBI")
_ACK = struct.Struct("<BBBBI")
_CURRENT = struct.Struct("<HHBBIII")


class MissionCount(dialect.MAVLink_mission_count_message):  # type: ignore[misc]
    """MISSION_COUNT; `opaque_id` names the plan that would be downloaded."""

    def __init__(self, target: tuple[int, int], count: int, plan_type: int, opaque_id: int) -> None:
        super().__init__(*target, count, plan_type)
        self.opaque_id = opaque_id

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        payload = _COUNT.pack(
            self.count, self.target_system, self.target_component, self.mission_type, self.opaque_id
        )
        packed: bytes = self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1)
        return packed


class MissionAck(dialect.MAVLink_mission_ack_message):  # type: ignore[misc]
    """MISSION_ACK; `opaque_id` names the plan that was uploaded, 0 for none."""

    def __init__(self, target: tuple[int, int], result: int, plan_type: int, opaque_id: int = 0) -> None:
        super().__init__(*target, result, plan_type)
        self.opaque_id = opaque_id

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        payload = _ACK.pack(
            self.target_system, self.target_component, self.type, self.mission_type, self.opaque_id
        )
        packed: bytes = self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1)
        return packed


class MissionCurrent(dialect.MAVLink_mission_current_message):  # type: ignore[misc]
    """MISSION_CURRENT; the identifiers name mission, geofence and rally points on board, 0 for none."""

    def __init__(
        self,
        sequence: int,
        total: int,
        state: int,
        mode: int,
        mission_id: int,
        fence_id: int,
        rally_points_id: int,
    ) -> None:
        super().__init__(sequence, total, state, mode)
        self.mission_id, self.fence_id, self.rally_points_id = mission_id, fence_id, rally_points_id

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        payload = _CURRENT.pack(
            self.seq,
            self.total,
            self.mission_state,
            self.mission_mode,
            self.mission_id,
            self.fence_id,
            self.rally_points_id,
        )
        packed: bytes = self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1)
        return packed


def mission_current(vehicle: ServiceContext) -> MissionCurrent:
    """The current MISSION_CURRENT."""
    navigator = vehicle.autopilot.navigator
    mission, plans = navigator.mission, navigator.plans
    return MissionCurrent(
        mission.current,
        len(mission.items) or NO_MISSION_TOTAL,
        navigator.mission_state(),
        navigator.mission_mode,
        plans[PlanType.MISSION].identifier,
        plans[PlanType.FENCE].identifier,
        plans[PlanType.RALLY].identifier,
    )
