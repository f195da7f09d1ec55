"""Velocities on the bus: which are flown, a gap, two senders, the pilot."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from companion.bench.lockstep_flight import LockstepFlight
from companion.guidance.behaviour import Behaviour, VelocityInput
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.velocity import VelocityBehaviour
from companion.guidance.interface import EventKind, GuidanceInput
from companion.guidance.missions.sequence import Plan, PlannedStep, SequenceBehaviour
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    Pending,
    assert_failed,
    engaged,
    flying,
)

S = 1_000_000_000
OF_FIRST = "velocity of first"  # `Steering` of companion.client reads it


class Steered(GuidanceHarness):
    """A vehicle in the air under `velocity`. `sending`: sender → its velocity, while it sends."""

    def __init__(self, source: str | None = None, yaw_rad: float = 0.0) -> None:
        super().__init__(replace(flying(), yaw_rad=yaw_rad), inputs=self._with_velocities)
        self.sending: dict[str, dict[str, float]] = {}
        self.command_of_velocity: Pending = engaged(self, VelocityBehaviour(source))

    def _with_velocities(self, inputs: GuidanceInput) -> GuidanceInput:
        now_ns = self.vehicle.now_ns
        velocities = tuple(
            VelocityInput(source, now_ns, now_ns + S // 5, **values)
            for source, values in self.sending.items()
        )
        return replace(inputs, velocities=velocities)

    @property
    def notes(self) -> list[str]:
        return [event.message for event in self.events if event.kind is EventKind.NOTED]


def test_axes_are_those_of_the_level_frame() -> None:
    harness = Steered(yaw_rad=math.pi / 2)
    harness.sending["a"] = {"forward_mps": 1.0, "right_mps": 0.5, "up_mps": 0.25}
    harness.run(2.0)
    assert harness.vehicle.velocity == pytest.approx([-0.5, 1.0, -0.25], abs=0.05)
    harness.sending["a"] = {"turn_radps": 0.5}
    harness.run(2.0)
    before = harness.vehicle.yaw_rad
    harness.run(1.0)
    assert harness.vehicle.yaw_rad - before == pytest.approx(0.5, abs=0.02)
    assert math.hypot(*harness.vehicle.velocity) < 0.1


def test_heading_and_height_are_held_without_turn_and_climb() -> None:
    harness = Steered()
    harness.sending["a"] = {"turn_radps": 1.0}
    harness.run(1.0)
    harness.sending["a"] = {"forward_mps": 1.0}
    harness.run(2.0)
    heading = harness.vehicle.yaw_rad
    harness.vehicle.position[2] -= 0.4  # a gust
    harness.run(6.0)
    assert harness.vehicle.yaw_rad == pytest.approx(heading, abs=0.02)
    assert harness.vehicle.position[2] == pytest.approx(-5.0, abs=0.05)


def test_gap_brakes_then_holds_and_a_new_message_flies_again() -> None:
    harness = Steered()
    harness.sending["a"] = {"forward_mps": 2.0}
    harness.run(3.0)
    assert harness.vehicle.velocity[0] == pytest.approx(2.0, abs=0.05)
    del harness.sending["a"]
    harness.run(3.0)
    held = list(harness.vehicle.position)
    harness.run(5.0)
    assert math.dist(held, harness.vehicle.position) < 0.1
    assert harness.guidance.status == "velocity of a, silent"
    harness.sending["a"] = {"forward_mps": 1.0}
    harness.run(2.0)
    assert harness.vehicle.velocity[0] == pytest.approx(1.0, abs=0.05)
    begun, silent, again = harness.notes
    assert begun == again == "a steers"
    assert silent.startswith("a is silent")


@pytest.mark.parametrize("source", [None, "first"])
def test_first_sender_keeps_it_and_the_other_is_reported(source: str | None) -> None:
    harness = Steered(source)
    harness.sending["first"] = {"forward_mps": 1.0}
    harness.run(1.0)
    harness.sending["second"] = {"forward_mps": -1.0}
    harness.run(1.0)
    assert harness.vehicle.velocity[0] == pytest.approx(1.0, abs=0.1)
    begun, ignored = harness.notes
    assert begun == "first steers"
    assert "second ignored" in ignored
    assert ignored.endswith(": first steers")
    del harness.sending["first"]
    harness.run(4.0)
    assert abs(harness.vehicle.velocity[0]) < 0.05


def test_named_sender_is_waited_for() -> None:
    harness = Steered("page")
    harness.sending["other"] = {"forward_mps": 1.0}
    harness.run(1.0)
    assert math.hypot(*harness.vehicle.velocity) < 0.05
    harness.sending["page"] = {"forward_mps": 1.0}
    harness.run(2.0)
    assert harness.vehicle.velocity[0] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("source", [None, "first"])
@pytest.mark.parametrize("other", [None, "second"])
def test_another_sender_is_refused_while_the_first_is_flown(source: str | None, other: str | None) -> None:
    harness = Steered(source)
    harness.sending["first"] = {"forward_mps": 1.0}
    harness.run(1.0)
    harness.sending = {"second": {"forward_mps": -1.0}, **harness.sending}  # also as the first in the list
    assert_failed(harness.outcome(harness.command(VelocityBehaviour(other), endless=True)), "first steers")
    harness.run(1.0)
    assert harness.vehicle.velocity[0] == pytest.approx(1.0, abs=0.1)
    assert harness.guidance.status == OF_FIRST
    assert harness.outcome(harness.command(VelocityBehaviour("first"), endless=True)).success
    harness.command("hold", endless=True)
    assert harness.outcome(harness.command(VelocityBehaviour(other), endless=True)).success
    harness.run(2.0)
    assert harness.vehicle.velocity[0] == pytest.approx(-1.0, abs=0.1)


def test_mission_that_begins_with_another_sender_is_refused() -> None:
    harness = Steered("first")
    harness.sending["first"] = {"forward_mps": 1.0}
    harness.run(1.0)

    def mission(behaviour: Behaviour) -> SequenceBehaviour:
        step = PlannedStep("steer", "steer", lambda: behaviour, on_success=0)
        return SequenceBehaviour(
            Plan("other", (step,), lambda _: HoldBehaviour()), harness.guidance.check_requirements
        )

    assert_failed(harness.outcome(harness.command(mission(VelocityBehaviour("second")))), "first steers")
    assert harness.guidance.status == OF_FIRST
    harness.command(mission(HoldBehaviour()))
    harness.run(0.1)
    assert harness.guidance.status.startswith("mission other")


def test_sender_whose_lifetime_is_over_is_replaced() -> None:
    harness = Steered("first")
    assert harness.guidance.status.startswith(f"{OF_FIRST}, ")
    assert "no message" in harness.guidance.status
    harness.sending["first"] = {}  # zero: it holds, and still steers
    harness.run(1.0)
    assert_failed(harness.outcome(harness.command(VelocityBehaviour("second"), endless=True)), "first")
    del harness.sending["first"]
    harness.run(0.1)
    assert harness.outcome(harness.command(VelocityBehaviour("second"), endless=True)).success


def test_envelope_limits_the_velocity() -> None:
    harness = Steered()
    harness.sending["a"] = {"forward_mps": 20.0, "turn_radps": 9.0}
    harness.run(5.0)
    setpoint = harness.autopilot.setpoints[-1]
    assert math.hypot(*setpoint.velocity_ned_mps or ()) <= 5.0 + 1e-9
    assert abs(setpoint.yaw_rate_radps or 0.0) <= 1.0


def test_simulated_vehicle_flies_messages_and_stops_in_a_gap() -> None:
    flight = LockstepFlight.airborne(seed=11, height_m=5.0)
    identifier = flight.command("velocity source=a")
    flight.run_until(lambda: flight.outcome(identifier), 5.0)
    start = flight.vehicle.truth.position_ned_m
    heading = flight.state.yaw_rad or 0.0

    for _ in range(60):
        sent = {"source": "a", "stamp_ns": flight.now_ns, "forward_mps": 1.5, "lifetime_s": 0.2}
        flight.inputs.velocities.on_message(json.dumps(sent).encode(), flight.now_ns)
        flight.run(0.1)
    flown = [now - before for now, before in zip(flight.vehicle.truth.position_ned_m, start, strict=True)]
    forward_m = flown[0] * math.cos(heading) + flown[1] * math.sin(heading)
    right_m = flown[1] * math.cos(heading) - flown[0] * math.sin(heading)
    assert (forward_m, right_m, flown[2]) == pytest.approx((7.5, 0.0, 0.0), abs=0.9)
    flight.run(6.0)
    held = flight.vehicle.truth.position_ned_m
    flight.run(5.0)
    assert math.dist(held, flight.vehicle.truth.position_ned_m) < 0.4
