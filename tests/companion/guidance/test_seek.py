import math

import pytest
from guidance_harness import Flight
from kinematic_vehicle import KinematicVehicle, SeenObject

from companion.guidance.seek import SeekBehaviour
from vision.attitude import wrap_angle


@pytest.mark.parametrize("degrees", [0, 30, 90, 179, 200, 300, 355])
def test_seek_finds_an_object_in_any_direction_and_ends_facing_it(degrees):
    angle = math.radians(degrees)
    car = SeenObject("car", 12.0 * math.cos(angle), 12.0 * math.sin(angle))
    vehicle = KinematicVehicle()
    outcome = Flight(SeekBehaviour("car"), vehicle, [car]).run(60.0)
    assert outcome is not None
    assert outcome.success, outcome.reason
    assert abs(wrap_angle(angle - vehicle.yaw_rad)) < math.radians(5)
    assert "12.0 m" in outcome.reason
    assert math.dist(vehicle.position, (0, 0, -5)) < 0.2


def test_seek_gives_up_after_its_laps_counted_from_the_real_heading():
    vehicle = KinematicVehicle()
    turned = [0.0, 0.0]

    def each(seconds, vehicle):
        turned[0] += wrap_angle(vehicle.yaw_rad - turned[1])
        turned[1] = vehicle.yaw_rad

    outcome = Flight(SeekBehaviour("car"), vehicle, [SeenObject("person", 5.0, 5.0)]).run(90.0, each)
    assert outcome is not None
    assert (outcome.success, outcome.reason) == (False, "no car seen in 2 laps")
    assert turned[0] / math.tau == pytest.approx(2.0, abs=0.02)


def test_seek_turns_the_other_way_when_told():
    vehicle = KinematicVehicle()
    Flight(SeekBehaviour("car", clockwise=False), vehicle).run(2.0)
    assert vehicle.yaw_rad < -0.5


def test_a_single_false_sighting_is_not_believed_and_the_turn_goes_on():
    ghost = SeenObject("car", 10.0, 3.0)

    def each(seconds, vehicle):
        ghost.visible = 0.3 < seconds < 0.42

    outcome = Flight(SeekBehaviour("car", laps=1.0), objects=[ghost]).run(60.0, each)
    assert outcome is not None
    assert outcome.reason == "no car seen in 1 lap"


def test_an_object_that_vanishes_before_it_is_faced_is_given_up_and_the_turn_goes_on():
    car = SeenObject("car", 0.0, 10.0)
    flight = Flight(SeekBehaviour("car", laps=1.0), objects=[car])
    in_view_since = []

    def each(seconds, vehicle):
        if abs(wrap_angle(math.pi / 2 - vehicle.yaw_rad)) < math.radians(40):
            in_view_since.append(seconds)
            car.visible = seconds - in_view_since[0] < 0.5

    outcome = flight.run(90.0, each)
    assert outcome is not None
    assert not outcome.success


def test_sightings_without_enough_confidence_do_not_count():
    weak = SeenObject("car", 10.0, 0.0, confidence=0.3)
    outcome = Flight(SeekBehaviour("car", laps=0.5), objects=[weak]).run(60.0)
    assert outcome is not None
    assert not outcome.success


def test_a_detector_that_falls_silent_stops_the_turn_and_then_ends_it():
    flight = Flight(SeekBehaviour("car"))

    def each(seconds, vehicle):
        flight.perception_alive = seconds < 3.0

    outcome = flight.run(60.0, each)
    assert outcome is not None
    assert not outcome.success
    assert "detector" in outcome.reason
    assert abs(flight.vehicle.yaw_rate_radps) < 0.01
