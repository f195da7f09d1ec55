"""The MAVLink link to ground stations: frames in and out, for the components of this vehicle.

A router delivers nothing to an endpoint that has itself sent with the same system and component id. So the
ids of other components are received before the first own message, and those of ours are free ones.
"""

from __future__ import annotations

import asyncio
import random
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial

from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station.camera import COMPONENT_IDS
from companion.ground_station.component import Component, Message, is_addressed
from companion.host.clock import StandstillWatch
from companion.host.tasks import error_text
from companion.vehicle.autopilot_driver import AUTOPILOT_COMPONENT
from companion.vehicle.byte_link import ByteLink, Source, open_link
from companion.vehicle.framing import Frame
from companion.vehicle.link_url import LinkScheme, LinkUrl
from companion.vehicle.own_address import LISTEN_JITTER_S, LISTEN_S
from companion.vehicle.reception import Reception
from companion.vehicle.signing import FrameSigner

TICK_S = 0.05
# In one tick; more wait, and of these the oldest are left out.
_BATCH, _MOST_WAITING = 16, 256
_GONE_NS = 5_000_000_000
_HEARTBEAT_ID = mavlink.MAVLINK_MSG_ID_HEARTBEAT
_REQUEST_IDS = {
    mavlink.MAVLINK_MSG_ID_COMMAND_LONG,
    mavlink.MAVLINK_MSG_ID_COMMAND_INT,
    mavlink.MAVLINK_MSG_ID_PARAM_EXT_REQUEST_READ,
    mavlink.MAVLINK_MSG_ID_PARAM_EXT_REQUEST_LIST,
    mavlink.MAVLINK_MSG_ID_PARAM_EXT_SET,
}
# A router learns where we are from the first message, which must not have an id of a camera yet. A component
# without a heartbeat is listed nowhere.
_INTRODUCING_COMPONENT = mavlink.MAV_COMP_ID_USER1
_INTRODUCTIONS = 3


class StationLink:
    """The link. Everything runs in one asyncio loop.

    Args:
        url: of the station or router. system_id: of the vehicle. components: those that are on it.
        signer: signs what is sent, and checks what is received; None: nothing is signed.
        say: called with a line. on_standstill: called after the computer or this process stood still, when
            what waited on the link has been left out.

    Attributes:
        components: those that have an id. dropped: requests that were too many.
    """

    def __init__(
        self,
        url: LinkUrl,
        system_id: int,
        components: Sequence[Component],
        *,
        signer: FrameSigner | None,
        say: Callable[[str], None],
        on_standstill: Callable[[], None] = lambda: None,
    ) -> None:
        self.url, self.components = url, list(components)
        self._on_standstill, self._watch = on_standstill, StandstillWatch()
        self.dropped = 0
        self._system_id, self._signer, self._say = system_id, signer, say
        self._reception = Reception()
        self._decoder = mavlink.MAVLink(None)
        self._link: ByteLink | None = None
        self._waiting: deque[Message] = deque()
        self._codecs: dict[int, mavlink.MAVLink] = {}
        self._received_ns: dict[int, int] = {}  # camera's component id → newest heartbeat of another program
        self._sent: deque[bytes] = deque(maxlen=64)  # heartbeats, which may come back
        self._peer: Source = None
        self._peer_ns = 0
        self._allowance = 0  # requests that this tick still allows
        self._other_vehicle: int | None = None

    @property
    def refused(self) -> int:
        """Messages that signing refused."""
        return 0 if self._signer is None else sum(self._signer.refused.values())

    async def run(self, on_open: Callable[[], None]) -> None:
        """Open the link and serve it until cancelled.

        Raises:
            LinkError: it cannot be opened.
        """
        self._link = await open_link(self.url, self._on_bytes)
        try:
            await self._choose_ids()
            on_open()
            while True:
                self._tick(time.monotonic_ns())
                await asyncio.sleep(TICK_S)
        finally:
            await self._link.close()

    def send(self, component_id: int, message: Message) -> None:
        """Send a message of a component now, or drop it."""
        codec = self._codecs.setdefault(component_id, mavlink.MAVLink(None, self._system_id, component_id))
        frame = bytes(message.pack(codec))
        codec.seq = (codec.seq + 1) % 256
        if self._signer is not None:
            frame = self._signer.signed(frame)
        if message.get_msgId() == _HEARTBEAT_ID:
            self._sent.append(frame)
        if self._link is not None:
            self._link.send(frame)

    # --- ids -----------------------------------------------------------------------------------------

    async def _choose_ids(self) -> None:
        pause_s = (LISTEN_S + random.uniform(0.0, LISTEN_JITTER_S)) / _INTRODUCTIONS
        for _ in range(_INTRODUCTIONS):
            if self.url.scheme is LinkScheme.UDP_OUT:
                message = mavlink.MAVLink_named_value_int_message(0, b"ground_sta", 0)
                self.send(_INTRODUCING_COMPONENT, message)
            await asyncio.sleep(pause_s)
        now_ns = time.monotonic_ns()
        for component in self.components:
            if component.component_id in self._taken(now_ns):
                self._change_id(component, now_ns)
        self._waiting.clear()

    def _taken(self, now_ns: int) -> set[int]:
        return {number for number, ns in self._received_ns.items() if now_ns - ns < _GONE_NS}

    def _change_id(self, component: Component, now_ns: int, *, at_random: bool = False) -> None:
        """Give a component a free id: another program uses its own. At random where that may do the same."""
        ours = {each.component_id for each in self.components}
        free = [number for number in COMPONENT_IDS if number not in ours | self._taken(now_ns)]
        before = f"MAVLink id {self._system_id}/{component.component_id} is used by another camera"
        if not free:
            self.components.remove(component)
            self._say(f"{before}, and no other is free: that camera of ours is not announced")
            return
        component.component_id = random.choice(free) if at_random else free[0]
        self._say(f"{before}: ours is now {self._system_id}/{component.component_id}")

    # --- received ------------------------------------------------------------------------------------

    def _on_bytes(self, data: bytes, source: Source) -> None:
        link = self._link
        if link is None:  # in the call that opens it
            return
        if self._stood_still():
            return
        now_ns = time.monotonic_ns()
        for frame in self._reception.feed(data, source, datagram=link.datagrams, keep=self._peer):
            if not frame.checked or (
                frame.message_id != _HEARTBEAT_ID and frame.message_id not in _REQUEST_IDS
            ):
                continue
            if self._signer is not None and not self._signer.accepts(frame):
                continue
            if source == self._peer or now_ns - self._peer_ns > _GONE_NS:
                self._peer, self._peer_ns = source, now_ns
                link.answer_to(source)
            message = self._decode(frame)
            if message is None:
                continue
            if frame.message_id == _HEARTBEAT_ID and message.type != mavlink.MAV_TYPE_GCS:
                self._on_heartbeat(frame, message, now_ns)
                continue
            self._waiting.append(message)
            if len(self._waiting) > _MOST_WAITING:
                self._waiting.popleft()
                self.dropped += 1
        self._handle(now_ns)

    def _decode(self, frame: Frame) -> Message | None:
        try:
            return self._decoder.decode(bytearray(frame.raw))
        except mavlink.MAVError:
            return None

    def _on_heartbeat(self, frame: Frame, message: Message, now_ns: int) -> None:
        if frame.system_id != self._system_id:
            autopilot = message.autopilot != mavlink.MAV_AUTOPILOT_INVALID
            if autopilot and frame.component_id == AUTOPILOT_COMPONENT and self._other_vehicle is None:
                self._other_vehicle = frame.system_id
                self._say(
                    f"the autopilot of system {frame.system_id} is on the link too; the cameras are those of "
                    f"system {self._system_id} (vehicle.system_id)"
                )
            return
        if frame.component_id not in COMPONENT_IDS or frame.raw in self._sent:
            return
        self._received_ns[frame.component_id] = now_ns
        if not self._codecs.keys() - {_INTRODUCING_COMPONENT}:  # none was sent yet
            return
        for component in self.components:
            if component.component_id == frame.component_id:
                self._change_id(component, now_ns, at_random=True)
                return

    def _handle(self, now_ns: int) -> None:
        """Handle requests, the oldest first, as many as this tick allows."""
        while self._waiting and self._allowance > 0:
            self._allowance -= 1
            message = self._waiting.popleft()
            for component in tuple(self.components):
                heartbeat = message.get_msgId() == _HEARTBEAT_ID
                if heartbeat or is_addressed(message, self._system_id, component.component_id):
                    self._send_all(component, partial(component.handle, message, now_ns))

    def _stood_still(self) -> bool:
        """Whether the computer or this process stood still; then what waits is left out: it is outdated."""
        seen = self._watch.observe()
        if seen.standstill is None or self._link is None:
            return False
        self._watch.acknowledge(seen)
        self._link.discard_received()
        self._reception.discard_received()
        self._waiting.clear()
        self._on_standstill()
        self._say(f"stood still for {seen.standstill.seconds:.1f} s: requests from before are left out")
        return True

    def _tick(self, now_ns: int) -> None:
        self._stood_still()
        self._watch.acknowledge(self._watch.observe())
        self._allowance = _BATCH
        self._handle(now_ns)
        for component in tuple(self.components):
            self._send_all(component, partial(component.due, now_ns))

    def _send_all(self, component: Component, messages: Callable[[], Iterable[Message]]) -> None:
        """Send what a component returns. A fault in one answer must not end the others."""
        try:
            for message in messages():
                self.send(component.component_id, message)
        except Exception as error:
            self._say(f"camera {component.component_id}: {error_text(error)}")
