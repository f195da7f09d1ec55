"""One PX4-like vehicle without sockets: messages in by `handle`, time by `step`, messages out by `outgoing`.

Several links may be attached, as on a real vehicle: an onboard computer's and a ground station's. The vehicle
reads no clock of its own: it can be stepped as fast or as slowly as wanted (lockstep) and repeats itself.
"""

from __future__ import annotations

import heapq
import itertools
import math
import random
from collections.abc import Callable, Mapping
from typing import Any

from mavlink_sim import parameter_protocol, telemetry
from mavlink_sim.announcements import CRITICAL, INFO, Text
from mavlink_sim.autopilot import Autopilot
from mavlink_sim.gimbal import Gimbal
from mavlink_sim.gimbal_protocol import GimbalManager
from mavlink_sim.links import AUTOPILOT_COMPONENT, Link, forward, target_of
from mavlink_sim.messages import Outgoing, dialect, event, link_node_status
from mavlink_sim.microservices import HANDLERS
from mavlink_sim.parameters import Parameters
from mavlink_sim.physics import Multirotor
from mavlink_sim.streams import EQUIPMENT_RATES_HZ, ONBOARD_RATES_HZ
from mavlink_sim.transmitter import Transmitter
from vision.rotation import quaternion_from_euler

STEP_S = 0.004
STEP_US = 4000
# The air is never still: with these gusts a held position wanders as measured (std 0.26/0.25/0.09 m).
BACKGROUND_GUSTS_MPS = 0.6
GUST_SHARE_OF_WIND = 0.15
MAX_WIND_MPS = 40.0  # a hurricane; a client may set any number
# Measured: "Connection to mission computer lost" comes 7 s after the last heartbeat; COM_OBC_LOSS_T is 5 s.
COMPANION_LOSS_MARGIN_S = 2.0


class Vehicle:
    """A quadrotor with PX4's behaviour.

    Args:
        system_id: its MAVLink system; the component is 1.
        seed: of wind direction and gusts.
        wind_mps: steady horizontal wind, from a direction that the seed chooses.
        gusts_mps: standard deviation of the gusts per axis; None for the usual amount.
        parameters: PX4 parameters that differ from `parameters.txt`.
        gimbal: with a two-axis gimbal and its parameters.
        ready_after_s: how long after boot the estimator allows arming.
        on_event: called with one readable line per event ("armed", "mode HOLD", "landed"…).

    Attributes:
        airframe: the motion (truth). autopilot: the decisions. parameters: the parameter set. links: by name.
        clock_ns: the boot clock that TIMESYNC tells; by default the stepped time.
        event_sequence: number of the newest EVENT.
    """

    def __init__(
        self,
        *,
        system_id: int = 1,
        seed: int = 0,
        wind_mps: float = 0.0,
        gusts_mps: float | None = None,
        parameters: Mapping[str, float] | None = None,
        gimbal: bool = False,
        ready_after_s: float = 3.0,
        on_event: Callable[[str], None] | None = None,
    ) -> None:
        self.system_id = system_id
        self.parameters = Parameters(parameters, gimbal)
        self.parameters.set("MAV_SYS_ID", system_id)
        if wind_mps:
            direction = random.Random(seed).uniform(0.0, math.tau)
            self.parameters.set("SIH_WIND_N", wind_mps * math.cos(direction))
            self.parameters.set("SIH_WIND_E", wind_mps * math.sin(direction))
        if gusts_mps is None:
            gusts_mps = BACKGROUND_GUSTS_MPS + GUST_SHARE_OF_WIND * wind_mps
        self.airframe = Multirotor(seed, gusts_mps=gusts_mps)
        self.links: dict[str, Link] = {}
        self.event_sequence = 0
        self.clock_ns: Callable[[], int] = lambda: self._boot_us * 1000
        self._on_event = on_event or (lambda text: None)
        self.autopilot = Autopilot(
            self.airframe, self.parameters, ready_after_s=ready_after_s, on_event=self._on_event
        )
        self.gimbal_manager = GimbalManager(self) if gimbal else None
        self._boot_us = 0
        self._leftover_s = 0.0
        self._ping_sequence = itertools.count()
        self._wind_revision = -1
        self._companion_seen_s: float | None = None
        self._companion_lost = False
        self._origin_told = False
        self._later: list[tuple[float, int, Callable[[], None]]] = []
        self._later_count = itertools.count()

    # ---- what is known of it ----------------------------------------------------------------------------

    @property
    def boot_us(self) -> int:
        return self._boot_us

    @property
    def boot_ms(self) -> int:
        return self._boot_us // 1000

    @property
    def now_s(self) -> float:
        return self._boot_us / 1e6

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """`ned_from_body`, (w, x, y, z)."""
        frame = self.airframe
        return quaternion_from_euler(frame.roll_rad, frame.pitch_rad, frame.yaw_rad)

    @property
    def gimbal(self) -> Gimbal | None:
        """The gimbal, for its pose: angles, `quaternion` and `body_quaternion`; None without one."""
        return None if self.gimbal_manager is None else self.gimbal_manager.gimbal

    @property
    def battery_remaining(self) -> float:
        """0..1, as the autopilot believes it to be."""
        return self.autopilot.supervision.battery.remaining

    @property
    def battery_volts(self) -> float:
        return self.autopilot.supervision.battery.volts

    @property
    def transmitter(self) -> Transmitter:
        """The pilot's remote control, switched off at first (COM_RC_IN_MODE decides whether it counts)."""
        return self.autopilot.supervision.transmitter

    def next_ping(self) -> int:
        """The sequence number of the next PING of its own."""
        return next(self._ping_sequence)

    # ---- links ------------------------------------------------------------------------------------------

    def add_link(self, name: str, rates_hz: dict[str, float] | None = None) -> Link:
        """Attach a link with the onboard link's rates, or others (`streams.GCS_RATES_HZ`)."""
        equipment = {name: rates[rates_hz is not None] for name, rates in EQUIPMENT_RATES_HZ.items()}
        rates = equipment | (ONBOARD_RATES_HZ if rates_hz is None else rates_hz)
        # links start out of step, so that they do not all send everything in the same millisecond
        link = self.links[name] = Link(name, self.system_id, rates, 0.0017 * len(self.links))
        return link

    def outgoing(self, link: str) -> list[Outgoing]:
        """Take everything that waits to be sent on a link."""
        outbox = self.links[link].outbox
        taken = list(outbox)
        outbox.clear()
        return taken

    def handle(self, link_name: str, message: Any) -> None:
        """Take in one MAVLink message (of any pymavlink dialect) that arrived on a link."""
        link = self.links[link_name]
        source = (message.get_srcSystem(), message.get_srcComponent())
        if source == (self.system_id, AUTOPILOT_COMPONENT):
            return  # an echo of our own
        link.received += 1
        link.components.add(source)
        forward(message, link, self.links.values(), self.system_id)
        system, component = target_of(message)
        if system in (0, self.system_id) and component in (0, AUTOPILOT_COMPONENT):
            handler = HANDLERS.get(message.get_type())
            if handler is not None:
                handler(self, link, message)

    def send_built(self, link: Link, name: str) -> bool:
        """Send one telemetry message by name; False if it has nothing to say now."""
        if name == "LINK_NODE_STATUS":
            message = link_node_status(self.boot_ms, link.sent, link.received, 0)
        elif name in telemetry.BUILDERS:
            message = telemetry.BUILDERS[name](self)
        else:
            message = telemetry.REQUESTED[name](self)
        if message is not None:
            link.send(message)
        return message is not None

    # ---- time -------------------------------------------------------------------------------------------

    def step(self, dt_s: float) -> None:
        """Advance time by any amount, in physics steps of 4 ms; a remainder waits for the next call."""
        self._leftover_s += dt_s
        while self._leftover_s >= STEP_S - 1e-9:
            self._leftover_s -= STEP_S
            self._step()

    def after(self, delay_s: float, action: Callable[[], None]) -> None:
        """Do something in a later step."""
        heapq.heappush(self._later, (self.now_s + delay_s, next(self._later_count), action))

    def companion_heard(self) -> None:
        """An onboard controller's heartbeat arrived."""
        self._companion_seen_s = self.now_s
        if self._companion_lost:
            self._companion_lost = False
            self.autopilot.texts.append(Text(INFO, "Onboard controller regained\t"))
            self._on_event("the companion's heartbeat is back")

    def _step(self) -> None:
        self._boot_us += STEP_US
        while self._later and self._later[0][0] <= self.now_s + 1e-9:
            heapq.heappop(self._later)[2]()
        if self._wind_revision != self.parameters.revision:
            self._wind_revision = self.parameters.revision
            north, east = (
                min(max(self.parameters.number(name), -MAX_WIND_MPS), MAX_WIND_MPS)
                for name in ("SIH_WIND_N", "SIH_WIND_E")
            )
            self.airframe.wind = (north, east, 0.0)
        self.autopilot.update(STEP_S)
        if self.gimbal_manager is not None:
            self.gimbal_manager.step(STEP_S)
        if self.autopilot.sensors_ready and not self._origin_told:
            self._origin_told = True  # GPS_GLOBAL_ORIGIN is sent when it changes, which is once
            for link in self.links.values():
                self.send_built(link, "GPS_GLOBAL_ORIGIN")
        self._watch_companion()
        if self.autopilot.texts or self.autopilot.gimbal_commands:
            self._tell()
        for link in self.links.values():
            for name in link.streams.due(self._boot_us):
                self.send_built(link, name)
            if link.parameters_left:
                parameter_protocol.continue_list(link, self.parameters, STEP_S)

    def _watch_companion(self) -> None:
        seen = self._companion_seen_s
        if seen is None or self._companion_lost:
            return
        if self.now_s - seen > self.parameters.number("COM_OBC_LOSS_T") + COMPANION_LOSS_MARGIN_S:
            self._companion_lost = True
            self.autopilot.texts.append(Text(CRITICAL, "Connection to mission computer lost\t"))
            self._on_event("the companion's heartbeat is lost")

    def _tell(self) -> None:
        """Texts to the links with a ground station, events and gimbal commands to every link."""
        autopilot = self.autopilot
        while autopilot.texts:
            text = autopilot.texts.popleft()
            for link in self.links.values():
                link.send_text(text, self.now_s)
            if text.event is not None:
                self.event_sequence = (self.event_sequence + 1) & 0xFFFF
                identifier, levels, arguments = text.event
                for link in self.links.values():
                    link.send(event(identifier, self.boot_ms, self.event_sequence, levels, arguments))
        while autopilot.gimbal_commands:
            command, confirmation, values = autopilot.gimbal_commands.popleft()
            if self.gimbal_manager is not None:
                if confirmation:
                    continue  # the first one was answered
                self.gimbal_manager.own_command((command, confirmation, values))
            for link in self.links.values():
                link.send(
                    dialect.MAVLink_command_long_message(self.system_id, 0, command, confirmation, *values)
                )
