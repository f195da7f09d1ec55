"""One PX4-like vehicle without sockets: messages in by `handle`, time by `step`, messages out by `outgoing`.

Several links may be attached, as on a real vehicle: an onboard computer's and a ground station's. The vehicle
reads no clock: it can be stepped at any speed (lockstep), and its flights are repeatable.
"""

from __future__ import annotations

import heapq
import itertools
import math
import random
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavlink_sim.autopilot.commander import Autopilot
from mavlink_sim.faults.schedule import Faults
from mavlink_sim.flight.transmitter import Transmitter
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.contact import HARD_LANDING_MPS, Collision
from mavlink_sim.physics.fallible_estimate import FallibleEstimate
from mavlink_sim.physics.geography import LocalFrame
from mavlink_sim.physics.gimbal import Gimbal
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.physics.vision_aiding import VisionAiding
from mavlink_sim.px4.modes import Mode
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.releases import NEWEST, release_named
from mavlink_sim.services import file_transfer, mission_link, parameter_protocol, telemetry
from mavlink_sim.services.event_protocol import EventBuffer
from mavlink_sim.services.gimbal_protocol import GimbalManager
from mavlink_sim.services.microservices import HANDLERS
from mavlink_sim.services.vehicle_files import vehicle_files
from mavlink_sim.vehicles.wind_model import WindModel
from mavlink_sim.wire.announcements import CRITICAL, INFO, Text
from mavlink_sim.wire.links import AUTOPILOT_COMPONENT, Link, forward, target_of
from mavlink_sim.wire.messages import Outgoing, dialect, link_node_status
from mavlink_sim.wire.signing import Signing, timestamp_now
from mavlink_sim.wire.signing import Streams as SigningStreams
from mavlink_sim.wire.streams import EQUIPMENT_RATES_HZ, ONBOARD_RATES_HZ, PX4_CLOCK_RATE, Streams

if TYPE_CHECKING:
    from mavlink_sim.camera.scene import Scene
    from mavlink_sim.vehicles.collision_world import CollisionWorld
    from mavlink_sim.world.world import World


# UTC at the boot of a stepped vehicle: midnight of the day its PX4 was built.
BOOT_UTC_NS = 1_773_273_600 * 10**9  # 2026-03-12
STEP_S = 0.004
STEP_US = 4000
# PX4 runs its position control with its estimator, at about 100 Hz, and its attitude control at every step.
STEPS_PER_CONTROL = 3
CONTROL_STEP_S = STEPS_PER_CONTROL * STEP_S
# Gusts without wind: with these, and the estimate's errors, a held position varies as measured
# (std 0.12 to 0.54 m, 0.09 to 0.16 m of height).
BACKGROUND_GUSTS_MPS = 0.4
GUST_SHARE_OF_WIND = 0.15
OBSTACLE_SENSOR_PERIOD_S = 0.1
CLEAR_OF_GROUND_M = 1.0  # above this height no contact is possible before the next control step
MAX_WIND_MPS = 40.0  # a hurricane; a client may set any number
# Measured: "Connection to mission computer lost" comes 7 s after the last heartbeat; COM_OBC_LOSS_T is 5 s.
COMPANION_LOSS_MARGIN_S = 2.0


class Vehicle:
    """A quadrotor with PX4's behaviour.

    Args:
        system_id: its MAVLink system; the component is 1.
        seed: of its random numbers, and of wind direction and gusts unless they are shared.
        air_seed: of the wind's direction and gusts, shared by all vehicles of this seed; None: its own.
        wind_mps: steady horizontal wind, from a random direction by the seed.
        gusts_mps: standard deviation of the gusts per axis; None for the default.
        noise: scale of the errors of sensors and estimates; 1: a real vehicle's, 0: they are the truth.
        parameters: PX4 parameters that differ from `parameters.txt`.
        gimbal: with a two-axis gimbal and its parameters.
        ready_after_s: how long after boot the estimator allows arming.
        px4: the release of PX4 to emulate (`releases.RELEASES`); None: the newest.
        start_ned_m: where it starts, north and east of SIH's home; the origin of its local NED frame.
        scene: its obstacles: a `Scene`, a `World`, a scene file or an example's name, with its origin at
        SIH's
            home and its time that of the faults. None: only level ground.
        obstacle_sensor: with a 360° range sensor for collision prevention; needs a scene.
        on_event: called with one readable line per event ("armed", "mode HOLD", "landed"…).

    Raises:
        ValueError: an obstacle at its start, or a sensor without a scene.
        SceneError: the scene cannot be used.

    Attributes:
        airframe: the motion (truth). collision_world: the scene, None without one.
        estimate: the vehicle's estimate of it. faults: the active and scheduled faults.
        autopilot: Commander and Navigator. parameters: the parameter set. links: by name.
        clock_ns: the boot clock of TIMESYNC; by default the stepped time.
        utc_ns: the time of SYSTEM_TIME; by default stepped too, from a day of 2026.
        events: the newest EVENTs. files: those of MAVLink FTP.

    Another firmware is a subclass (see `firmware`): the classes of its autopilot and parameters, the handlers
    of messages, and the telemetry.

    >>> from mavlink_sim import LockstepVehicle
    >>> vehicle = LockstepVehicle(seed=1, parameters={"MPC_LAND_SPEED": 1.0}).vehicle
    >>> vehicle.parameters.get("MPC_LAND_SPEED").value, vehicle.system_id
    (1.0, 1)
    """

    autopilot_class: type[Autopilot] = Autopilot
    parameters_class: type[Parameters] = Parameters
    handlers: Mapping[str, Callable[[Any, Link, Any], None]] = HANDLERS
    modes: type[Enum] = Mode
    # of the clock by which the interval of a SET_MESSAGE_INTERVAL is measured
    stream_clock_rate = PX4_CLOCK_RATE

    def __init__(
        self,
        *,
        system_id: int = 1,
        seed: int = 0,
        air_seed: int | None = None,
        wind_mps: float = 0.0,
        gusts_mps: float | None = None,
        noise: float = 1.0,
        parameters: Mapping[str, float] | None = None,
        gimbal: bool = False,
        ready_after_s: float = 3.0,
        px4: str | None = None,
        start_ned_m: tuple[float, float] = (0.0, 0.0),
        scene: Scene | World | str | Path | None = None,
        obstacle_sensor: bool = False,
        on_event: Callable[[str], None] | None = None,
    ) -> None:
        self.system_id = system_id
        self.release = release_named(NEWEST if px4 is None else px4)
        self.parameters = self.parameters_class(parameters, gimbal, self.release.override_by_speed)
        self.parameters.set("MAV_SYS_ID", system_id)
        if wind_mps:
            direction = random.Random(seed if air_seed is None else air_seed).uniform(0.0, math.tau)
            self.parameters.set("SIH_WIND_N", wind_mps * math.cos(direction))
            self.parameters.set("SIH_WIND_E", wind_mps * math.sin(direction))
        if gusts_mps is None:
            gusts_mps = BACKGROUND_GUSTS_MPS + GUST_SHARE_OF_WIND * wind_mps
        if obstacle_sensor and scene is None:
            raise ValueError("obstacle_sensor=True needs a scene: there is nothing to measure without one")
        self.collision_world: CollisionWorld | None = None
        self._obstacle_sensor = obstacle_sensor
        if scene is None:
            self.airframe = Multirotor(seed, gusts_mps=gusts_mps)
        else:
            # imported here: without a scene neither the shapes nor their libraries are needed
            from mavlink_sim.vehicles.collision_world import CollisionWorld

            self.collision_world = CollisionWorld(
                scene,
                seed=seed,
                gusts_mps=gusts_mps,
                noise=noise > 0.0,
                start_ned_m=start_ned_m,
                clock=self._scene_time_s,
            )
            self.airframe = self.collision_world.airframe
        self.airframe.on_touch = self._on_touch
        self.airframe.on_collision = self._on_collision
        self._air = None if air_seed is None else WindModel(air_seed, gusts_mps)
        self.estimate = FallibleEstimate(self.airframe, seed, noise)
        self.links: dict[str, Link] = {}
        self.files = vehicle_files(self.parameters, self.release)
        self._signing_streams: SigningStreams = {}
        self.clock_ns: Callable[[], int] = self._simulated_clock_ns
        self.utc_ns: Callable[[], int] = self._simulated_utc_ns
        self.start_ned_m = start_ned_m
        self.local_frame = LocalFrame(*start_ned_m)
        self._on_event = on_event or _no_observer
        self.ready_after_s = ready_after_s
        self.faults = Faults(self, seed, self._on_event)
        self._leftover_s = 0.0
        self._wind_revision = -1
        self._boot()
        self.gimbal_manager = GimbalManager(self) if gimbal else None

    def _boot(self) -> None:
        """Initialize the state that does not survive a reboot."""
        self._boot_us = 0
        self._steps_to_control = 0
        self.autopilot = self.autopilot_class(
            self.estimate,
            self.parameters,
            local_frame=self.local_frame,
            ready_after_s=self.ready_after_s,
            on_event=self._on_event,
            release=self.release,
        )
        self.autopilot.position_valid = self.estimate.position_valid
        self.vision = VisionAiding(self.estimate, self.parameters)
        self.events = EventBuffer()
        self._ping_sequence = itertools.count()
        self._companion_seen_s: float | None = None
        self._companion_lost = False
        self._origin_sent = False
        self._later: list[tuple[float, int, Callable[[], object]]] = []
        self._later_count = itertools.count()
        self.after(parameter_protocol.SENT_AT_START_S, self._send_parameters)
        if self._obstacle_sensor:
            self.after(OBSTACLE_SENSOR_PERIOD_S, self._sense_obstacles)

    # ---- state ------------------------------------------------------------------------------------------

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
        """The true `ned_from_body`, (w, x, y, z)."""
        return self.airframe.quaternion

    @property
    def home_altitude_m(self) -> float:
        """Of home above mean sea level."""
        return self.local_frame.geographic(self.autopilot.home.position)[2]

    @property
    def gimbal(self) -> Gimbal | None:
        """The gimbal, for its pose: angles, `quaternion` and `body_quaternion`; None without one."""
        return None if self.gimbal_manager is None else self.gimbal_manager.gimbal

    @property
    def transmitter(self) -> Transmitter:
        """The pilot's remote control, initially switched off (COM_RC_IN_MODE selects whether it is used)."""
        return self.autopilot.supervision.transmitter

    def obstacle_below_m(self) -> float:
        """From the legs along the body's down axis to the scene; inf: none."""
        return math.inf if self.collision_world is None else self.collision_world.range_below_m()

    def second_autopilot(self, system_id: int, seed: int, east_m: float) -> Vehicle:
        """Another vehicle of the same firmware, ready at once, that starts `east_m` east of this one."""
        north, east = self.start_ned_m
        return type(self)(
            system_id=system_id, seed=seed, ready_after_s=0.0, start_ned_m=(north, east + east_m)
        )

    def mode_parameters(self, mode: Any) -> tuple[float, float]:
        """DO_SET_MODE's parameters 2 and 3 for one of `modes`."""
        return mode.custom_mode >> 16 & 0xFF, mode.custom_mode >> 24 & 0xFF

    @property
    def setpoint_mode(self) -> str:
        """The name of the mode for setpoints."""
        return Mode.OFFBOARD.name

    def takeoff_plan(self, height_m: float) -> tuple[str | None, float, Callable[[], bool]]:
        """The mode required, NAV_TAKEOFF's altitude for a height above home, and whether it is complete."""
        return None, self.home_altitude_m + height_m, self._holds

    def _holds(self) -> bool:
        return self.autopilot.mode is Mode.HOLD

    def _scene_time_s(self) -> float:
        return self.faults.now_s

    def _simulated_clock_ns(self) -> int:
        return self._boot_us * 1000

    def _simulated_utc_ns(self) -> int:
        return BOOT_UTC_NS + self.faults.elapsed_us * 1000

    def next_ping(self) -> int:
        """The sequence number of the vehicle's next PING."""
        return next(self._ping_sequence)

    # ---- links ------------------------------------------------------------------------------------------

    def add_link(self, name: str, rates_hz: dict[str, float] | None = None) -> Link:
        """Attach a link with the onboard link's rates, or others (`streams.GCS_RATES_HZ`)."""
        equipment = {name: rates[rates_hz is not None] for name, rates in EQUIPMENT_RATES_HZ.items()}
        rates = equipment | (ONBOARD_RATES_HZ if rates_hz is None else rates_hz)
        if not self.release.has_current_mode:
            rates.pop("CURRENT_MODE", None)
        # links start with different phases, so that they do not all send in the same millisecond
        link = self.links[name] = Link(
            name, self.system_id, Streams(rates, 0.0017 * len(self.links), self.stream_clock_rate)
        )
        link.gate = self.faults.gate
        link.has_parameter_errors = self.release.has_parameter_errors
        link.signing = Signing(
            link_id=len(self.links) - 1,
            streams=self._signing_streams,
            policy=self._signing_policy,
            is_usb=name == "gcs",  # the ground station's link represents the USB port
        )
        return link

    def _signing_policy(self) -> int:
        return int(self.parameters.number("MAV_SIGN_CFG"))

    def sign_everything(self, key: bytes, timestamp: int | None = None) -> None:
        """Give every link a signing key; `timestamp` counts 10 us since 2015, None for now."""
        for link in self.links.values():
            link.signing.set_up(key, timestamp_now() if timestamp is None else timestamp)

    def outgoing(self, link: str) -> list[Outgoing]:
        """Remove and return everything queued on a link."""
        outbox = self.links[link].outbox
        messages = list(outbox)
        outbox.clear()
        return messages

    def handle(self, link_name: str, message: Any) -> None:
        """Process one MAVLink message (of any pymavlink dialect) received on a link."""
        link = self.links[link_name]
        source = (message.get_srcSystem(), message.get_srcComponent())
        if source == (self.system_id, AUTOPILOT_COMPONENT):
            return  # an echo of the vehicle's own
        if self.faults.intercepts(link_name, message):
            return
        link.received += 1
        link.components.add(source)
        forward(message, link, self.links.values(), self.system_id)
        system, component = target_of(message)
        if system in (0, self.system_id) and component in (0, AUTOPILOT_COMPONENT):
            handler = self.handlers.get(message.get_type())
            if handler is not None:
                handler(self, link, message)

    def send_built(self, link: Link, name: str) -> bool:
        """Send one telemetry message by name; False if it has nothing to report now."""
        builder = telemetry.BUILDERS.get(name)
        if builder is not None:
            message = builder(self)
        elif name == "LINK_NODE_STATUS":
            message = link_node_status(self.boot_ms, link.sent, link.received, 0)
        else:
            message = telemetry.REQUESTED[name](self)
        if message is not None:
            link.send(message)
        return message is not None

    # ---- time -------------------------------------------------------------------------------------------

    def step(self, dt_s: float) -> None:
        """Advance time by any amount, in physics steps of 4 ms; a remainder waits for the next call."""
        left_s, steps = self._leftover_s + dt_s, 0
        while left_s >= STEP_S - 1e-9:
            left_s -= STEP_S
            steps += 1
        self._leftover_s = left_s
        while steps > 0:
            steps -= self._step(steps)
        self.estimate.refresh()

    def _quiet_steps(self, most: int) -> int:
        """The number of steps, at least 1, in which only the airframe moves, clear of ground and objects."""
        steps = most if most < self._steps_to_control else self._steps_to_control
        airframe, autopilot = self.airframe, self.autopilot
        if (
            self.faults.known
            or airframe.on_ground
            or airframe.position[2] > -CLEAR_OF_GROUND_M
            or self.collision_world is not None
            or self._air is not None
            or not self._origin_sent
            or autopilot.texts
            or autopilot.gimbal_commands
            or self._wind_revision != self.parameters.revision
            or (self._later and self._later[0][0] <= (self._boot_us + steps * STEP_US) / 1e6)
        ):
            return 1
        for link in self.links.values():
            if link.status_is_due or link.parameters_left or link.file_transfer is not None:
                return 1
            free = (link.streams.next_us - 1 - self._boot_us) // STEP_US + 1
            steps = free if free < steps else steps
        return steps if steps > 1 else 1

    def after(self, delay_s: float, action: Callable[[], object]) -> None:
        """Call `action` in a later step."""
        heapq.heappush(self._later, (self.now_s + delay_s, next(self._later_count), action))

    def _send_parameters(self) -> None:
        """Send the parameters that differ from the defaults on every link, shortly after the start."""
        parameter_protocol.broadcast(self, [item.name for item in self.parameters.customised()])

    def on_companion_heartbeat(self) -> None:
        """Note an onboard controller's heartbeat."""
        self._companion_seen_s = self.now_s
        if self._companion_lost:
            self._companion_lost = False
            self.autopilot.texts.append(Text(INFO, "Onboard controller regained\t"))
            self._on_event("the companion's heartbeat is back")

    def _on_touch(self, down_mps: float) -> None:
        """Report a hard ground contact."""
        if self.airframe.crashed:
            self._on_event(f"crashed at {down_mps:.1f} m/s")
        elif down_mps > HARD_LANDING_MPS:
            self._on_event(f"hard landing at {down_mps:.1f} m/s")

    def _on_collision(self, collision: Collision) -> None:
        """Report a collision with the scene."""
        self._on_event(str(collision))

    def _sense_obstacles(self) -> None:
        """Add the obstacle sensor's measurement to the map of collision prevention."""
        assert self.collision_world is not None
        self.estimate.refresh()
        autopilot = self.autopilot
        self.collision_world.sense_obstacles(
            autopilot.navigator.obstacles, self.estimate.yaw_rad, autopilot.now_s
        )
        self.after(OBSTACLE_SENSOR_PERIOD_S, self._sense_obstacles)

    def reboot(self) -> None:
        """Reboot after a short power loss: the motors are off, and the time since boot restarts.

        Stored data stay: parameters, plans with the current mission item, signing keys. So does what is no
        part of the autopilot: the airframe, the battery, the gimbal, the transmitter. `autopilot` is a new
        object afterwards.
        """
        before = self.autopilot
        self.estimate.restart([one.number for one in self.faults.active])
        self._boot()
        self.autopilot.navigator.take_stored(before.navigator)
        self.autopilot.supervision.keep_equipment(before.supervision)
        for link in self.links.values():
            link.reset()
        if self.gimbal_manager is not None:
            gimbal, self.gimbal_manager = self.gimbal_manager.gimbal, GimbalManager(self)
            self.gimbal_manager.gimbal = gimbal

    def reload_wind(self, more: Iterable[Vector] = ()) -> None:
        """Set the wind of SIH_WIND_N and SIH_WIND_E plus additional ones."""
        self._wind_revision = self.parameters.revision
        north, east = (
            min(max(self.parameters.number(name), -MAX_WIND_MPS), MAX_WIND_MPS)
            for name in ("SIH_WIND_N", "SIH_WIND_E")
        )
        for wind in more:
            north, east = north + wind[0], east + wind[1]
        self.airframe.wind = (north, east, 0.0)

    def _step(self, most: int) -> int:
        """Advance by 1 to `most` steps: by several if nothing is due between them. Returns their number."""
        faults = self.faults
        if not faults.known:
            faults.elapsed_us += STEP_US
        elif faults.step(STEP_S):
            return 1
        self._boot_us += STEP_US
        estimate = self.estimate  # updated from the truth only before it is read
        if self._later and self._later[0][0] <= self._boot_us / 1e6 + 1e-9:
            estimate.refresh()
            while self._later and self._later[0][0] <= self._boot_us / 1e6 + 1e-9:
                heapq.heappop(self._later)[2]()
        if self._wind_revision != self.parameters.revision:
            self.reload_wind(self.faults.winds.values())
        self._steps_to_control -= 1
        if self._steps_to_control <= 0:
            self._steps_to_control = STEPS_PER_CONTROL
            self._control()
        if self._air is not None:
            self.airframe.blow(self._air.gust_at(self.faults.elapsed_us))
        steps = self._quiet_steps(most) if most > 1 else 1
        if steps > 1:
            faults.elapsed_us += (steps - 1) * STEP_US
            self._boot_us += (steps - 1) * STEP_US
            self._steps_to_control -= steps - 1
        self.airframe.advance(STEP_S, steps)
        estimate.age(STEP_S, steps)
        if steps == 1:  # else nothing is due
            self._send_due()
        return steps

    def _control(self) -> None:
        """One step of the autopilot and of what runs with it."""
        self.estimate.refresh()
        self.autopilot.update(CONTROL_STEP_S)
        mission_link.update(self)
        self.vision.update(self.now_s)
        if self.gimbal_manager is not None:
            self.gimbal_manager.step(CONTROL_STEP_S)
        self._check_companion()

    def _send_due(self) -> None:
        """Send what is due on each link: queued texts and commands, streams, lists, files."""
        if not self._origin_sent and self.autopilot.sensors_ready:
            self._origin_sent = True  # GPS_GLOBAL_ORIGIN is sent when it changes: once
            for link in self.links.values():
                self.send_built(link, "GPS_GLOBAL_ORIGIN")
        if self.autopilot.texts or self.autopilot.gimbal_commands:
            self._send_queued()
        for link in self.links.values():
            if link.streams.next_us <= self._boot_us:
                self.estimate.refresh()
                for name in link.streams.due(self._boot_us):
                    if name == "CURRENT_MODE":
                        link.status_is_due = True
                    else:
                        self.send_built(link, name)
            if link.status_is_due and link.is_new_status(self.autopilot.status, self.now_s):
                link.status_is_due = False
                self.send_built(link, "CURRENT_MODE")
            if link.parameters_left:
                parameter_protocol.continue_list(link, self.parameters, STEP_S)
            if link.file_transfer is not None:
                file_transfer.continue_transfer(link, self.now_s)

    def _check_companion(self) -> None:
        seen = self._companion_seen_s
        if seen is None or self._companion_lost:
            return
        if self.now_s - seen > self.parameters.number("COM_OBC_LOSS_T") + COMPANION_LOSS_MARGIN_S:
            self._companion_lost = True
            self.autopilot.texts.append(Text(CRITICAL, "Connection to mission computer lost\t"))
            self._on_event("the companion's heartbeat is lost")

    def _send_queued(self) -> None:
        """Send texts on links with a ground station, events and gimbal commands on every link."""
        autopilot = self.autopilot
        while autopilot.texts:
            text = autopilot.texts.popleft()
            for link in self.links.values():
                link.send_text(text, self.now_s)
            if text.event is not None:
                identifier, levels, arguments = text.event
                self.events.emit(self.links.values(), identifier, self.boot_ms, levels, arguments)
        while autopilot.gimbal_commands:
            command, confirmation, values = autopilot.gimbal_commands.popleft()
            if self.gimbal_manager is not None:
                if confirmation:
                    continue  # a repetition of the first one
                self.gimbal_manager.own_command((command, confirmation, values))
            for link in self.links.values():
                link.send(
                    dialect.MAVLink_command_long_message(self.system_id, 0, command, confirmation, *values)
                )


def _no_observer(text: str) -> None:
    """The default of `on_event`."""
