"""The mission protocol: up- and download of mission, geofence and rally points, one session per link.

As in PX4's MavlinkMissionManager: it requests items one by one, repeats a request after 250 ms, aborts after
5 s without a message, and allows one upload at a time, over all links.
"""

from __future__ import annotations

import enum
import math
from typing import Any

from mavlink_sim.missions import items as mission_items
from mavlink_sim.missions.items import ItemRejectedError, MissionItem, PlanType
from mavlink_sim.missions.plan import Plan
from mavlink_sim.services.context import ServiceContext
from mavlink_sim.services.mission_messages import MissionAck, MissionCount
from mavlink_sim.wire.announcements import CRITICAL, INFO, Text
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import dialect

RETRY_S = 0.25  # MAVLINK_MISSION_RETRY_TIMEOUT_DEFAULT
TIMEOUT_S = 5.0  # MAVLINK_MISSION_PROTOCOL_TIMEOUT_DEFAULT
# PX4's storage: CONFIG_NUM_MISSION_ITMES_SUPPORTED of SITL, DM_KEY_FENCE_POINTS_MAX, DM_KEY_SAFE_POINTS_MAX.
MAX_COUNT = {PlanType.MISSION: 10000, PlanType.FENCE: 64, PlanType.RALLY: 32}
ALL_TYPES = 255  # MAV_MISSION_TYPE_ALL
OPERATION_CANCELLED = 15  # MAV_MISSION_RESULT
MIN_VERTICES = 3


class State(enum.Enum):
    """The state of a session."""

    IDLE = "idle"
    SENDING = "sending"
    RECEIVING = "receiving"


class Session:
    """The mission protocol on one link.

    Attributes:
        partner: (system, component) the transfer is or was with.
    """

    def __init__(self, vehicle: ServiceContext, link: Link) -> None:
        self._vehicle = vehicle
        self._navigator = vehicle.autopilot.navigator
        self._link = link
        self.state = State.IDLE
        self.partner = (0, 0)
        self._whole = True  # speaks MISSION_ITEM_INT rather than MISSION_ITEM
        self._type = PlanType.MISSION
        self._sequence = 0
        self._count = 0
        self._items: list[MissionItem] = []
        self._messages: list[Any] = []
        self._identifier = 0
        self._current = -1
        self._received_s = -math.inf
        self._sent_s = -math.inf

    # ---- time -------------------------------------------------------------------------------------------

    def update(self) -> None:
        """Repeat a request, or abort."""
        if self.state is State.IDLE:
            return
        now = self._vehicle.now_s
        if now - self._received_s > TIMEOUT_S:
            self._send_text(CRITICAL, "Mission sync timeout\t")
            self._stop()
        elif self.state is State.RECEIVING and now - self._sent_s > RETRY_S:
            self._request()

    # ---- messages ---------------------------------------------------------------------------------------

    def count(self, message: Any) -> None:
        """MISSION_COUNT: a client starts an upload."""
        source = _source(message)
        if self.state is State.RECEIVING:
            self._count_again(source)
            return
        if self.state is not State.IDLE:
            self._send_text(CRITICAL, "WPM: IGN MISSION_COUNT: Busy\t")
            self._acknowledge(source, mission_items.ERROR)
            return
        if self._navigator.uploading is not None:  # over another link
            self._acknowledge(source, mission_items.ERROR)
            return
        self.partner = source
        self._navigator.forget_reached()
        try:
            self._type = PlanType(_plan_type(message))
        except ValueError:  # an unknown type has no storage
            result = mission_items.NO_SPACE if message.count else mission_items.ACCEPTED
            self._acknowledge(source, result, _plan_type(message))
            return
        if message.count > MAX_COUNT[self._type]:
            self._acknowledge(source, mission_items.NO_SPACE)
        elif message.count == 0:
            self._navigator.store(self._type, Plan())
            self._acknowledge(source, mission_items.ACCEPTED)
        else:
            self._navigator.uploading = self._link.name
            self.state = State.RECEIVING
            self._received_s = self._vehicle.now_s
            self._sequence, self._count, self._current = 0, message.count, -1
            self._items, self._messages = [], []
            self._request()

    def _count_again(self, source: tuple[int, int]) -> None:
        if source != self.partner:
            self._acknowledge(source, mission_items.ERROR)
            return
        self._received_s = self._vehicle.now_s
        if self._sequence == 0:  # the first request was lost
            self._request()
        else:
            self._send_text(CRITICAL, "WPM: REJ. CMD: Busy\t")
            self._acknowledge(source, mission_items.ERROR)

    def item(self, message: Any) -> None:
        """MISSION_ITEM_INT or MISSION_ITEM of an upload."""
        self._whole = message.get_type() == "MISSION_ITEM_INT"
        if _source(message) != self.partner:
            self._send_text(CRITICAL, "REJ. MIS ITEM: partner id mismatch\t")
            return
        if _plan_type(message) != self._type:
            self._acknowledge(self.partner, mission_items.ERROR)
        elif self.state is State.RECEIVING:
            self._received_s = self._vehicle.now_s
            if message.seq == self._sequence:
                self._store(message)
        elif self.state is State.SENDING:
            self._send_text(CRITICAL, "IGN MISSION_ITEM: Busy\t")
            self._acknowledge(self.partner, mission_items.ERROR)
        elif self._count and message.seq + 1 == self._sequence:
            # the last item again: the acknowledgement was lost
            self._acknowledge(self.partner, mission_items.ACCEPTED, identifier=self._identifier)
        else:
            self._send_text(CRITICAL, "IGN MISSION_ITEM: No transfer\t")
            self._acknowledge(self.partner, mission_items.ERROR)

    def _store(self, message: Any) -> None:
        try:
            item = mission_items.item_of(message)
        except ItemRejectedError as error:
            self._send_text(CRITICAL, "IGN MISSION_ITEM: Invalid item\t")
            self._refuse(error.result)
            return
        strange = self._type is PlanType.MISSION and item.command in mission_items.FENCE_AND_RALLY_COMMANDS
        if self._type is PlanType.FENCE and item.command in mission_items.FENCE_POLYGONS:
            strange = item.parameters[0] < MIN_VERTICES
        if strange:
            self._refuse(mission_items.ERROR)
            return
        self._items.append(item)
        self._messages.append(message)
        if message.current:
            self._current = message.seq
        self._sequence += 1
        if self._sequence < self._count:
            self._request()
            return
        self._identifier = mission_items.plan_identifier(self._messages)
        self._navigator.store(self._type, Plan(tuple(self._items), self._identifier), self._current)
        self._stop()
        self._acknowledge(self.partner, mission_items.ACCEPTED, identifier=self._identifier)

    def request_list(self, message: Any) -> None:
        """MISSION_REQUEST_LIST: a client starts a download."""
        source, plan_type = _source(message), _plan_type(message)
        if self.state is State.SENDING and self._sequence == self._count:
            self.state = State.IDLE  # everything was sent, but the client's acknowledgement is missing
        again = self.state is State.SENDING and source == self.partner and plan_type == self._type
        if self.state is not State.IDLE and not again:
            self._send_text(INFO, "Mission download request ignored, already active\t")
            return
        try:
            self._type = PlanType(plan_type)
        except ValueError:
            self._link.send(MissionCount(source, 0, plan_type, 0))
            return
        plan = self._navigator.plans[self._type]
        self.state, self.partner = State.SENDING, source
        self._received_s = self._vehicle.now_s
        self._sequence, self._count = 0, len(plan.items)
        self._link.send(MissionCount(source, self._count, plan_type, plan.identifier))

    def request(self, message: Any) -> None:
        """MISSION_REQUEST_INT or MISSION_REQUEST of a download."""
        self._whole = message.get_type() == "MISSION_REQUEST_INT"
        if _source(message) != self.partner:
            self._send_text(CRITICAL, "WPM: REJ. CMD: partner id mismatch\t")
            return
        if self.state is State.IDLE:
            return
        if self.state is State.RECEIVING:
            self._send_text(CRITICAL, "WPM: REJ. CMD: Busy\t")
            return
        if _plan_type(message) != self._type:
            return
        self._received_s = self._vehicle.now_s
        items = self._navigator.plans[self._type].items
        if message.seq == self._sequence < self._count:
            self._sequence += 1
        elif message.seq != self._sequence - 1:
            self._unexpected()
            return
        if message.seq >= len(items):  # the plan became shorter meanwhile
            self._unexpected()
            return
        self._link.send(
            mission_items.message_of(
                items[message.seq],
                message.seq,
                self._type,
                self.partner,
                current=message.seq == self._navigator.mission.current,
                whole=self._whole,
            )
        )

    def _unexpected(self) -> None:
        self.state = State.IDLE
        self._acknowledge(self.partner, mission_items.ERROR)
        self._send_text(CRITICAL, "WPM: REJ. CMD: Req. WP was unexpected\t")

    def acknowledged(self, message: Any) -> None:
        """MISSION_ACK of the client."""
        if _source(message) != self.partner:
            self._send_text(CRITICAL, "REJ. WP CMD: partner id mismatch\t")
        elif self.state is State.SENDING and _plan_type(message) == self._type:
            self.state = State.IDLE
        elif self.state is State.RECEIVING:
            if message.type == mission_items.UNSUPPORTED:  # the client uses the other kind of item
                self._whole = not self._whole
                self._request()
            elif message.type == OPERATION_CANCELLED:
                self._stop()

    def clear(self, message: Any) -> None:
        """MISSION_CLEAR_ALL."""
        if self.state is not State.IDLE:
            self._send_text(CRITICAL, "WPM: IGN CLEAR CMD: Busy\t")
            return
        plan_type = _plan_type(message)
        for kind in PlanType:
            if plan_type in (kind, ALL_TYPES):
                self._navigator.store(kind, Plan())
        self._acknowledge(_source(message), mission_items.ACCEPTED, plan_type)

    def set_current(self, message: Any) -> None:
        """MISSION_SET_CURRENT, confirmed by MISSION_CURRENT."""
        if self.state is not State.IDLE:
            self._send_text(CRITICAL, "WPM: IGN WP CURR CMD: Busy\t")
        elif message.seq >= len(self._navigator.mission.items):
            self._send_text(CRITICAL, "WPM: WP CURR CMD: Not in list\t")
        else:
            self._navigator.set_current(message.seq)

    # ---- replies ----------------------------------------------------------------------------------------

    def _request(self) -> None:
        make = (
            dialect.MAVLink_mission_request_int_message
            if self._whole
            else dialect.MAVLink_mission_request_message
        )
        self._sent_s = self._vehicle.now_s
        self._link.send(make(*self.partner, self._sequence, int(self._type)))

    def _acknowledge(
        self, target: tuple[int, int], result: int, plan_type: int | None = None, identifier: int = 0
    ) -> None:
        kind = int(self._type) if plan_type is None else plan_type
        self._link.send(MissionAck(target, result, kind, identifier))

    def _refuse(self, result: int) -> None:
        self._acknowledge(self.partner, result)
        self._stop()

    def _stop(self) -> None:
        if self.state is State.RECEIVING:
            self._navigator.uploading = None
        self.state = State.IDLE

    def _send_text(self, severity: int, text: str) -> None:
        self._vehicle.autopilot.texts.append(Text(severity, text))  # to every link, as all of PX4's texts


def _source(message: Any) -> tuple[int, int]:
    return message.get_srcSystem(), message.get_srcComponent()


def _plan_type(message: Any) -> int:
    return int(getattr(message, "mission_type", 0))


def session_of(vehicle: ServiceContext, link: Link) -> Session:
    """The session of a link, created with the first message."""
    sessions: dict[str, Session] = vehicle.autopilot.navigator.sessions
    if link.name not in sessions:
        sessions[link.name] = Session(vehicle, link)
    return sessions[link.name]


_STEPS = {
    "MISSION_COUNT": Session.count,
    "MISSION_ITEM": Session.item,
    "MISSION_ITEM_INT": Session.item,
    "MISSION_REQUEST_LIST": Session.request_list,
    "MISSION_REQUEST": Session.request,
    "MISSION_REQUEST_INT": Session.request,
    "MISSION_ACK": Session.acknowledged,
    "MISSION_CLEAR_ALL": Session.clear,
    "MISSION_SET_CURRENT": Session.set_current,
}


def handle(vehicle: ServiceContext, link: Link, message: Any) -> None:
    """Process a message of the mission protocol that is addressed to this vehicle."""
    if message.target_system == vehicle.system_id:  # PX4 ignores broadcasts here
        _STEPS[message.get_type()](session_of(vehicle, link), message)


MESSAGES = tuple(_STEPS)
