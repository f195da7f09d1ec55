"""Every input that ages, and a suspend of 30 s at any moment: nothing from before it is used after it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from companion.bench.lockstep_flight import plain_settings
from companion.bus.vehicle_messages import pose_message
from companion.guidance.core import Guidance
from companion.guidance.formation.pose import Pose
from companion.guidance.interface import GuidanceInput, GuidanceOutput
from companion.guidance.mode_control import Phase
from companion.host.clock import StandstillWatch
from companion.perception.cameras import PerceptionCamera
from companion.service import command_handler, guidance_loop
from companion.service.guidance_loop import GuidanceLoop
from companion.service.inputs import InputAssembler
from companion.service.publisher import Publisher
from companion.vehicle.gimbal import GimbalState
from companion.vehicle.global_position import global_problem
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, Vector3, VehicleState
from companion.vehicle.streamer import Streamer
from companion.vehicle.telemetry_state import TelemetryState
from vision.detections import Detections
from vision.obstacle_sectors import SECTORS, ObstacleSectors
from vision.path_planner import PlannedPath
from vision.pipeline import PerceptionResult

SUSPENDED_S, STEP_S = 30.0, 0.05
MS = 1_000_000


class World:
    """Guidance loop, inputs and telemetry of the service, with clocks that the test sets.

    Attributes:
        now_ns: CLOCK_MONOTONIC. inputs: what guidance got in the newest step.
        sent: setpoints.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns, self._suspended_ns = 10**12, 0
        self.watch = StandstillWatch(lambda: self.now_ns + self._suspended_ns, lambda: self.now_ns)
        self.camera = PerceptionCamera(plain_settings({"vehicle.name": "own"}))
        self.assembler = InputAssembler(self.camera.settings, [self.camera], lambda *event: None)
        self.telemetry = TelemetryState("test", lambda: None)
        self.telemetry.subscribe(self.assembler.on_state)
        self.sent: list[Setpoint] = []
        self.streamer = Streamer(self.sent.append, clock_ns=self.watch.now_ns)
        self.guidance = Guidance()
        self.got: list[GuidanceInput] = []
        self.outputs: list[GuidanceOutput] = []
        self.driver = cast(Any, Driver(self))
        clock = SimpleNamespace(
            monotonic_ns=lambda: self.now_ns, thread_time_ns=lambda: 0, monotonic=lambda: self.now_ns / 1e9
        )
        for module in (guidance_loop, command_handler):
            monkeypatch.setattr(module, "time", clock)
        self.loop = GuidanceLoop(
            self.guidance,
            self.assembler,
            self.driver,
            self.streamer,
            rate_hz=20.0,
            on_event=lambda *event: None,
            on_step=lambda now_ns: None,
            others=SimpleNamespace(check_requirements=lambda *command, **more: None),  # type: ignore[arg-type]
            record=self._record,
        )
        self.fly()
        self.step()

    def _record(self, _now_ns: int, _context: object, inputs: GuidanceInput, output: GuidanceOutput) -> None:
        self.got.append(inputs)
        self.outputs.append(output)

    def suspend(self) -> None:
        self._suspended_ns += round(SUSPENDED_S * 1e9)
        self.now_ns += MS

    def step(self) -> GuidanceInput:
        self.now_ns += round(STEP_S * 1e9)
        self.loop._running = True
        self.loop._step(self.now_ns)
        self.streamer.tick(self.watch.now_ns())
        return self.got[-1]

    def fly(self, position_ned_m: Vector3 = (0.0, 0.0, -5.0)) -> None:
        """All telemetry of a vehicle in the air."""
        now_ns = self.now_ns
        state = VehicleState(
            heartbeat_ns=now_ns,
            attitude_ns=now_ns,
            position_ns=now_ns,
            global_ns=now_ns,
            battery_ns=now_ns,
            battery_fraction=0.9,
            attitude=(1.0, 0.0, 0.0, 0.0),
            position_ned_m=position_ned_m,
            velocity_ned_mps=(0.0, 0.0, 0.0),
            latitude_deg=47.0,
            longitude_deg=8.0,
            altitude_amsl_m=505.0,
            home_position_ned_m=(0.0, 0.0, 0.0),
            home_altitude_amsl_m=500.0,
            armed=True,
            mode=FlightMode.HOLD,
            landed=LandedState.IN_AIR,
            gimbal=GimbalState(1, now_ns, now_ns, now_ns),
        )
        self.telemetry._publish(state, "TEST", {})

    def frame(self, captured_ns: int) -> None:
        """A result with an object, and depth."""
        box = np.array([[300.0, 200.0, 340.0, 300.0]], np.float32)
        found = Detections(box, np.ones(1, np.float32), np.zeros(1, np.int64), ("person",))
        obstacles = ObstacleSectors(captured_ns, (5.0,) * SECTORS)
        result = PerceptionResult(0, captured_ns, captured_ns, 640, 480, found, {}, 0, obstacles=obstacles)
        self.camera.update(result)
        self.assembler.on_result(self.camera, result)

    def pose(self, receipt_ns: int) -> None:
        place = (47.0, 8.0001, 505.0)
        pose = Pose("alpha", "a", receipt_ns, 0.0, *place, (0.0, 0.0, 0.0), 0.0, 0.0, "alone", True, None)
        self.assembler.poses.on_message(json.dumps(pose_message(pose)).encode(), receipt_ns)

    def velocity(self, receipt_ns: int) -> None:
        body = {"source": "pad", "stamp_ns": receipt_ns, "forward_mps": 1.0}
        self.assembler.velocities.on_message(json.dumps(body).encode(), receipt_ns)


class Driver:
    """The real telemetry and watch; requests are never answered. `started`: those that began."""

    def __init__(self, world: World) -> None:
        self._world, self.watch = world, world.watch
        self.started: list[str] = []
        self.discard_received = world.telemetry.discard_received

    @property
    def state(self) -> VehicleState:
        return self._world.telemetry.state

    def abandon(self, why: str) -> None:
        self.started.clear()

    def send_landing_target(self, target: object) -> None: ...

    def send_obstacle_distance(self, sectors: object) -> None: ...

    async def set_mode(self, mode: FlightMode, **_more: object) -> None:
        self.started.append(mode)
        await asyncio.Event().wait()


def _in(world: World, get: Callable[[GuidanceInput, int], object]) -> bool:
    return bool(get(world.got[-1], world.now_ns))


# Kind → (how it arrives, with its stamp; whether guidance's newest input has it as fresh).
KINDS: dict[str, tuple[Callable[[World, int], None], Callable[[GuidanceInput, int], object]]] = {
    "heartbeat": (lambda world, _: world.fly(), lambda got, now: got.state.connected(now)),
    "position": (lambda world, _: world.fly(), lambda got, now: got.state.position_fault(now) is None),
    "global position": (lambda world, _: world.fly(), lambda got, now: not global_problem(got.state, now)),
    "battery": (lambda world, _: world.fly(), lambda got, now: now - got.state.battery_ns < 5e9),
    "gimbal": (lambda world, _: world.fly(), lambda got, now: got.state.gimbal is not None),
    "image": (World.frame, lambda got, now: got.seen_ns is not None and now - got.seen_ns < 1e9),
    "object": (World.frame, lambda got, now: got.targets),
    "depth": (World.frame, lambda got, now: got.obstacles),
    "path": (
        lambda world, stamp_ns: world.camera.on_path(PlannedPath(stamp_ns, ((0.0, 0.0), (1.0, 0.0)))),
        lambda got, now: got.planned,
    ),
    "pose": (World.pose, lambda got, now: got.neighbourhood and got.neighbourhood.vehicles),
    "velocity": (World.velocity, lambda got, now: any(each.expires_ns > now for each in got.velocities)),
}
TELEMETRY = {"heartbeat", "position", "global position", "battery", "gimbal"}


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


@pytest.mark.parametrize("kind", KINDS)
def test_input_is_fresh_without_a_suspend(kind: str, world: World) -> None:
    arrive, fresh = KINDS[kind]
    arrive(world, world.now_ns)
    world.step()
    assert _in(world, fresh)


@pytest.mark.parametrize("steps_before", [0, 1])
@pytest.mark.parametrize("kind", KINDS)
def test_input_from_before_a_suspend_is_not_fresh(kind: str, steps_before: int, world: World) -> None:
    arrive, fresh = KINDS[kind]
    arrive(world, world.now_ns)
    for _ in range(steps_before):
        world.step()
    world.suspend()
    for _ in range(3):
        world.step()
        assert not _in(world, fresh)
    # What arrives from then on is.
    world.fly()
    arrive(world, world.now_ns)
    world.step()
    assert _in(world, fresh)


@pytest.mark.parametrize("steps_after", [0, 1])
@pytest.mark.parametrize("kind", sorted(KINDS.keys() - TELEMETRY))
def test_input_stamped_before_and_processed_after_is_not_fresh(
    kind: str, steps_after: int, world: World
) -> None:
    """It waited in a queue of this process: a result of perception, a message from zenoh's thread."""
    arrive, fresh = KINDS[kind]
    stamp_ns = world.now_ns
    world.suspend()
    for _ in range(steps_after):
        world.step()
    arrive(world, stamp_ns)
    world.fly()
    world.step()
    assert not _in(world, fresh)


def test_pose_is_not_interpolated_across_a_suspend(world: World) -> None:
    before_ns = world.now_ns
    world.suspend()
    world.step()
    world.fly((50.0, 0.0, -5.0))
    between_ns = (before_ns + world.now_ns) // 2
    assert world.assembler.history.at(between_ns).position_ned_m == (50.0, 0.0, -5.0)


async def test_setpoint_from_before_a_suspend_is_not_sent(world: World) -> None:
    world.streamer.submit(Setpoint.brake(world.now_ns, lifetime_s=0.3))
    world.streamer.tick(world.watch.now_ns())
    assert len(world.sent) == 1
    world.suspend()
    world.streamer.tick(world.watch.now_ns())  # before guidance's next step
    world.streamer.send_now(world.watch.now_ns())
    assert len(world.sent) == 1


async def test_command_from_before_a_suspend_does_not_begin(world: World) -> None:
    answer = asyncio.create_task(world.loop.execute("hold"))
    await asyncio.sleep(0)
    world.suspend()
    world.step()
    assert not (await answer)["success"]
    assert world.guidance.phase is Phase.IDLE


@pytest.mark.parametrize("after_s", [0.1, 5.0, 29.0])
async def test_command_that_arrives_late_does_not_begin(after_s: float, world: World) -> None:
    world.suspend()
    for _ in range(round(after_s / STEP_S)):
        world.step()
    world.fly()
    answer = asyncio.create_task(world.loop.execute("hold"))
    await asyncio.sleep(0)
    world.step()
    assert not (await answer)["success"]


async def test_request_from_before_a_suspend_is_abandoned(world: World) -> None:
    world.fly()
    command = asyncio.create_task(world.loop.execute("land"))
    await asyncio.sleep(0)
    world.step()
    (request,) = world.outputs[-1].requests
    await asyncio.sleep(0)
    assert world.driver.started == ["land"]
    world.suspend()
    world.step()
    assert world.driver.started == []
    assert [answer.identifier for answer in world.got[-1].answers] == [request.identifier]
    assert not (await command)["success"]


def test_own_pose_from_before_a_suspend_is_not_published(world: World) -> None:
    published: list[str] = []
    bus: Any = SimpleNamespace(publish=lambda topic, body, *more: published.append(topic.name))
    publisher = Publisher("own", bus, world.driver, world.assembler, SimpleNamespace())  # type: ignore[arg-type]
    world.fly()
    publisher._publish_vehicle(world.guidance, world.streamer, world.now_ns)
    assert "pose" in published
    published.clear()
    world.suspend()
    publisher._publish_vehicle(world.guidance, world.streamer, world.now_ns)  # before guidance's next step
    assert "pose" not in published
