"""Height above the ground by a range finder that looks down (DISTANCE_SENSOR)."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from companion.guidance.objects.from_detections import StateHistory
from companion.settings import Settings
from companion.vehicle.state import HeightSource, VehicleState
from companion.vehicle.telemetry import apply_message
from vision.attitude import quaternion_from_euler

PERIOD_NS = 100_000_000
DOWN, FORWARD = 25, 0  # MAV_SENSOR_ROTATION_PITCH_270, _NONE


def message(range_m: float, **changes: Any) -> dict[str, Any]:
    fields = {
        "time_boot_ms": 1,
        "min_distance": 20,
        "max_distance": 4000,
        "current_distance": round(range_m * 100),
        "orientation": DOWN,
        "signal_quality": 0,
    }
    return fields | changes


class Flight:
    """A vehicle whose range finder measures 10 times a second; `home` is 2 m below its local origin."""

    def __init__(self, height_m: float = 5.0) -> None:
        self.now_ns = 1_000_000_000
        self.north_m = 0.0
        self.down_m = 2.0 - height_m
        self.attitude = quaternion_from_euler(0.0, 0.0, 0.0)
        self.state = VehicleState(home_position_ned_m=(0.0, 0.0, 2.0), range_finder_height=True)

    def measure(self, range_m: float, count: int = 1, moved_m: float = 0.0, **changes: Any) -> VehicleState:
        """Receive as many measurements, the vehicle having moved on before each."""
        for _ in range(count):
            self.north_m += moved_m
            self.now_ns += PERIOD_NS
            self._place()
            self.state = apply_message(
                self.state, "DISTANCE_SENSOR", message(range_m, **changes), self.now_ns
            )
        return self.state

    def wait(self, seconds: float) -> VehicleState:
        self.now_ns += round(seconds * 1e9)
        self._place()
        return self.state

    def _place(self) -> None:
        self.state = replace(
            self.state,
            attitude=self.attitude,
            attitude_ns=self.now_ns,
            position_ned_m=(self.north_m, 0.0, self.down_m),
            position_ns=self.now_ns,
        )


def test_height_is_that_of_the_range_finder() -> None:
    flight = Flight()
    state = flight.measure(5.6)
    assert state.ground_height_m == pytest.approx(5.6)
    assert state.height_m == pytest.approx(5.6)
    assert state.height_source is HeightSource.DISTANCE_SENSOR
    assert state.altitude_m == pytest.approx(5.0)
    flight.down_m -= 1.0
    assert flight.wait(0.05).height_m == pytest.approx(6.6)


def test_ranges_use_the_height_above_home_by_default() -> None:
    flight = Flight()
    flight.state = replace(flight.state, range_finder_height=False)
    state = flight.measure(5.6, count=5)
    assert state.ground_height_m == pytest.approx(5.6)
    assert state.height_m == pytest.approx(5.0)
    assert state.height_source is HeightSource.HOME
    assert Settings().guidance.range_finder_height is False


def test_tilt_of_the_vehicle_is_compensated() -> None:
    flight = Flight()
    flight.attitude = quaternion_from_euler(math.radians(15.0), math.radians(-20.0), 1.0)
    cosine = math.cos(math.radians(15.0)) * math.cos(math.radians(20.0))
    assert flight.measure(5.0 / cosine).height_m == pytest.approx(5.0, abs=0.01)
    steep = Flight()
    steep.attitude = quaternion_from_euler(0.0, math.radians(40.0), 0.0)
    assert steep.measure(5.0).ground_height_m is None


@pytest.mark.parametrize(
    "changes",
    [
        {"orientation": FORWARD},
        {"current_distance": 20},
        {"current_distance": 4000},
        {"current_distance": 65521},
        {"signal_quality": 1},
    ],
    ids=["forward", "minimum", "maximum", "no echo", "invalid"],
)
def test_measurement_that_is_not_of_the_ground_is_not_used(changes: dict[str, int]) -> None:
    state = Flight().measure(5.0, **changes)
    assert state.ground_height_m is None
    assert state.height_m == pytest.approx(5.0)
    assert state.height_source is HeightSource.HOME


def test_message_without_quality_is_used() -> None:
    flight = Flight()
    flight.measure(5.0)
    fields = message(5.0)
    del fields["signal_quality"]
    assert apply_message(flight.state, "DISTANCE_SENSOR", fields, flight.now_ns).ground is not None


def test_without_position_nothing_is_measured() -> None:
    state = VehicleState()
    assert apply_message(state, "DISTANCE_SENSOR", message(5.0), 1) is state
    assert state.height_source is None


@pytest.mark.parametrize(
    ("top_m", "length_m"), [(1.5, 4.5), (2.5, 6.0), (3.2, 12.0)], ids=["car", "van", "bus"]
)
def test_object_below_does_not_change_the_height(top_m: float, length_m: float) -> None:
    flight = Flight()
    flight.measure(5.3, count=10, moved_m=0.2)
    for _ in range(round(length_m / 0.3)):
        assert flight.measure(5.3 - top_m, moved_m=0.3).height_m == pytest.approx(5.3)
    assert flight.measure(5.3, count=10, moved_m=0.3).height_m == pytest.approx(5.3)


def test_hover_above_an_object_ends_at_the_height_above_home() -> None:
    flight = Flight()
    flight.measure(5.3, count=5)
    assert flight.measure(3.8, count=45).height_m == pytest.approx(5.3)
    state = flight.measure(3.8, count=10)
    assert state.height_source is HeightSource.HOME
    assert state.height_m == pytest.approx(5.0)
    # The ground again, which it has known.
    assert flight.measure(5.3, count=5, moved_m=0.3).height_m == pytest.approx(5.3)


def test_first_surface_above_home_is_not_taken_for_the_ground() -> None:
    flight = Flight()
    assert flight.measure(3.5, count=20).height_source is HeightSource.HOME
    assert flight.measure(5.7, count=5).height_m == pytest.approx(5.7)


def test_ledge_is_followed_and_one_outlier_is_not() -> None:
    flight = Flight()
    flight.measure(5.0, count=10)
    assert flight.measure(9.0).height_m == pytest.approx(5.0)
    assert flight.measure(5.0, count=5).height_m == pytest.approx(5.0)
    assert flight.measure(9.0, count=13).height_m == pytest.approx(9.0)
    assert flight.state.height_disagreement_m == pytest.approx(4.0)
    assert flight.measure(9.0, count=12, moved_m=0.4).height_disagreement_m == 0.0


def test_false_echoes_do_not_change_the_height() -> None:
    flight = Flight()
    flight.measure(5.0, count=10)
    state = flight.measure(10.0, count=3)
    assert state.height_m == pytest.approx(5.0)
    assert state.height_disagreement_m == pytest.approx(5.0)
    # Even where they last: the ground at home's level is accepted again.
    flight.measure(10.0, count=20)
    assert flight.measure(5.0, count=5, moved_m=0.05).height_m == pytest.approx(5.0)


def test_measurements_before_a_gap_do_not_count() -> None:
    flight = Flight()
    flight.measure(5.0, count=10)
    flight.measure(9.0, count=5)
    flight.wait(3.0)
    assert flight.measure(5.2).height_m == pytest.approx(5.2)
    flight.wait(3.0)
    assert flight.measure(9.0).height_m == pytest.approx(5.2)


def test_error_of_the_height_is_the_disagreement() -> None:
    flight, history = Flight(), StateHistory()
    flight.measure(5.0, count=10)
    history.add(flight.measure(3.8, count=5))
    assert history.at(flight.now_ns).height_m == pytest.approx(5.0)
    assert history.at(flight.now_ns).error.height_m == pytest.approx(1.2)
    # After 5 s the height is that above home, and the sensor still measures another one.
    state = flight.measure(3.8, count=50)
    assert state.height_source is HeightSource.HOME
    assert state.height_disagreement_m == pytest.approx(1.2)
    assert replace(state, range_finder_height=False).height_disagreement_m == 0.0


def test_quay_at_the_level_of_home_ends_the_water_below() -> None:
    flight = Flight(height_m=3.0)
    assert flight.measure(8.0, count=20, moved_m=0.2).height_m == pytest.approx(8.0)
    state = flight.measure(3.0, count=3, moved_m=0.2)
    assert state.height_m == pytest.approx(3.0)
    assert state.height_disagreement_m == pytest.approx(5.0)


@pytest.mark.parametrize("moved_m", [0.05, 0.2], ids=["0.5 m/s", "2 m/s"])
@pytest.mark.parametrize(
    "tops_m",
    [((0.9, 1.1), (1.45, 2.3), (1.05, 1.2)), ((1.2, 13.6),), ((0.9, 3.0),)],
    ids=["car with a boot", "flatbed", "bonnet"],
)
def test_low_object_does_not_become_the_ground(
    tops_m: tuple[tuple[float, float], ...], moved_m: float
) -> None:
    flight = Flight()
    flight.measure(5.0, count=50, moved_m=moved_m)
    for top_m, length_m in tops_m:
        for _ in range(round(length_m / moved_m)):
            assert flight.measure(5.0 - top_m, moved_m=moved_m).height_m == pytest.approx(5.0)
    assert flight.state.height_disagreement_m == pytest.approx(tops_m[-1][0])
    assert flight.measure(5.0, count=10, moved_m=moved_m).height_m == pytest.approx(5.0)


def test_tent_is_within_the_stated_error() -> None:
    flight = Flight()
    flight.measure(5.0, count=100, moved_m=0.1)
    for step in range(41):
        top_m = 2.0 - abs(step - 20) * 0.1
        state = flight.measure(5.0 - top_m, moved_m=0.0625)
        assert state.height_m is not None
        error_m = abs(state.height_m - 5.0)
        assert error_m < 0.8
        assert error_m < max(state.height_disagreement_m + 0.01, 0.51)


def test_rising_slope_is_followed() -> None:
    flight = Flight()
    flight.measure(5.0, count=10)
    for step in range(120):
        flight.measure(5.0 - 0.03 * step, moved_m=0.3)
    # The median is two measurements old.
    assert flight.state.height_m == pytest.approx(1.43 + 0.06, abs=0.01)
    assert flight.state.height_disagreement_m < 0.1


def test_old_level_is_not_used() -> None:
    flight = Flight()
    flight.measure(5.6, count=5)
    assert flight.wait(4.9).height_source is HeightSource.DISTANCE_SENSOR
    state = flight.wait(0.2)
    assert state.height_source is HeightSource.HOME
    assert state.height_m == pytest.approx(5.0)


def test_accuracy_of_the_estimator_is_read() -> None:
    fields = {"flags": 895, "pos_horiz_accuracy": 0.28, "pos_vert_accuracy": 0.19}
    state = apply_message(VehicleState(), "ESTIMATOR_STATUS", fields, 1)
    assert (state.horizontal_sigma_m, state.vertical_sigma_m) == (0.28, 0.19)
    unknown = fields | {"pos_horiz_accuracy": None, "pos_vert_accuracy": 0.0}
    state = apply_message(state, "ESTIMATOR_STATUS", unknown, 2)
    assert (state.horizontal_sigma_m, state.vertical_sigma_m) == (None, None)
