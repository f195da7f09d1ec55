"""The occupancy grid and paths on it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vision.occupancy_grid import BLOCK, CELL_M, DIRECTIONS, RANGE_M, SIZE, OccupancyGrid, Point
from vision.path_planner import PathRequest, PlannedPath, plan_path

AHEAD = ((0.0, 0.0), (15.0, 0.0))
CLEARANCE_M = 1.3
# A path's corners are cut between cells, and a cell's obstacle may be half a diagonal from its centre.
CELL_TOLERANCE_M = 0.3


def scan(position: Point, trunks: list[tuple[Point, float]]) -> NDArray[np.float64]:
    """True ranges to round trunks (centre, radius) in every direction."""
    ranges = np.full(DIRECTIONS, np.inf)
    bearings = np.arange(DIRECTIONS) * math.tau / DIRECTIONS
    for (north, east), radius in trunks:
        away = np.array([north - position[0], east - position[1]])
        along = away[0] * np.cos(bearings) + away[1] * np.sin(bearings)
        across = np.hypot(*away) ** 2 - along**2
        met = (along > 0) & (across <= radius**2)
        ranges[met] = np.minimum(ranges[met], along[met] - np.sqrt(radius**2 - across[met]))
    return ranges


def grid_with(*trunks: tuple[Point, float], position: Point = (0.0, 0.0), images: int = 5) -> OccupancyGrid:
    grid = OccupancyGrid()
    for number in range(images):
        grid.update(scan(position, list(trunks)), (*position, -3.0), number + 1)
    return grid


def at(grid: OccupancyGrid, point: Point) -> float:
    row, column = grid.cells(np.array([point]))[0]
    return float(grid.log_odds[row, column])


def planned(grid: OccupancyGrid, reference: tuple[Point, ...] = AHEAD, at: Point = (0.0, 0.0)) -> PlannedPath:
    return plan_path(grid, PathRequest(reference, CLEARANCE_M), at)


def nearest_m(path: PlannedPath, point: Point) -> float:
    """Least distance of the path's lines from a point."""
    line = np.concatenate(
        [np.linspace(a, b, 50) for a, b in zip(path.points[:-1], path.points[1:], strict=True)]
    )
    return float(np.hypot(*(line - point).T).min())


def length_m(path: PlannedPath) -> float:
    return sum(math.dist(a, b) for a, b in zip(path.points[:-1], path.points[1:], strict=True))


def test_cells_before_an_obstacle_are_free() -> None:
    grid = grid_with(((5.0, 0.0), 0.5))
    assert at(grid, (4.5, 0.0)) > 0.6
    assert at(grid, (3.0, 0.0)) < -0.6
    assert at(grid, (6.0, 0.0)) == 0.0  # hidden
    assert at(grid, (-8.0, 1.0)) < -0.6
    assert at(grid, (-RANGE_M - 1.0, 0.0)) == 0.0


def test_unobserved_directions_stay_unknown() -> None:
    grid = OccupancyGrid()
    grid.update(np.full(DIRECTIONS, np.nan), (0.0, 0.0, -3.0), 1)
    assert not grid.log_odds.any()


def test_obstacle_stays_until_the_camera_looks_through_it() -> None:
    grid = grid_with(((5.0, 0.0), 0.5))
    behind = np.full(DIRECTIONS, np.nan)
    behind[135:226] = np.inf
    for number in range(600):  # a minute, looking south
        grid.update(behind, (0.0, 0.0, -3.0), 10 + number)
    assert at(grid, (4.5, 0.0)) > 0.6
    assert max(abs(east) for _, east in planned(grid).points) > 1.0
    for number in range(10):
        grid.update(scan((0.0, 0.0), []), (0.0, 0.0, -3.0), 1000 + number)
    assert at(grid, (4.5, 0.0)) < -0.6
    assert max(abs(east) for _, east in planned(grid).points) < 0.3


@given(north=st.floats(-15.0, 15.0), east=st.floats(-15.0, 15.0))
@settings(max_examples=30, deadline=None)
def test_obstacle_keeps_its_position_while_the_grid_rolls(north: float, east: float) -> None:
    grid = grid_with(((5.0, 0.0), 0.5))
    grid.update(np.full(DIRECTIONS, np.nan), (north, east, -3.0), 10)
    assert at(grid, (4.5, 0.0)) > 0.6
    row, column = grid.cells(np.array([(north, east)]))[0]
    assert {int(row), int(column)} <= {SIZE // 2, SIZE // 2 + 1}
    assert (grid.corner[0] % BLOCK, grid.corner[1] % BLOCK) == (0, 0)


def test_far_jump_clears_the_grid() -> None:
    grid = grid_with(((5.0, 0.0), 0.5))
    grid.update(np.full(DIRECTIONS, np.nan), (100.0, 0.0, -3.0), 10)
    assert not grid.log_odds.any()


@pytest.mark.parametrize(
    ("down_m", "free", "occupied"),
    [(-3.55, True, True), (-3.7, False, True), (-2.3, False, True), (-4.6, False, False)],
)
def test_map_is_kept_at_heights_of_which_it_was_observed(down_m: float, free: bool, occupied: bool) -> None:
    grid = grid_with(((5.0, 0.0), 0.5))
    known = (grid.free.copy(), grid.occupied.copy())
    grid.update(np.full(DIRECTIONS, np.nan), (0.0, 0.0, down_m), 10)
    assert (bool(grid.free.any()), bool(grid.occupied.any())) == (free, occupied)
    grid.update(np.full(DIRECTIONS, np.nan), (0.0, 0.0, -3.0), 11)
    assert (grid.free == known[0]).all()
    assert (grid.occupied == known[1]).all()


def test_what_is_seen_at_another_height_replaces_what_was_seen() -> None:
    grid = grid_with()
    for number in range(2):
        grid.update(scan((0.0, 0.0), [((5.0, 0.0), 0.5)]), (0.0, 0.0, -6.0), 10 + number)
    assert at(grid, (4.5, 0.0)) > 0.6
    assert grid.free.any()


def test_free_reference_is_flown_straight() -> None:
    path = planned(grid_with())
    assert path.points[0] == (0.0, 0.0)
    assert path.points[-1] == pytest.approx((15.0, 0.0))
    assert max(abs(east) for _, east in path.points) < 0.3
    assert path.free_m == pytest.approx(RANGE_M, abs=0.5)  # beyond it nothing was observed
    assert (path.captured_ns, path.reason) == (5, "")


def test_path_leads_around_an_obstacle() -> None:
    path = planned(grid_with(((6.0, 0.2), 0.6)))
    assert path.points[-1] == pytest.approx((15.0, 0.0))
    assert nearest_m(path, (6.0, 0.2)) > 0.6 + CLEARANCE_M - CELL_TOLERANCE_M
    assert 15.0 < length_m(path) < 17.0


def test_corner_of_the_reference_is_kept_where_it_is_free() -> None:
    path = planned(grid_with(), ((0.0, 0.0), (7.0, 0.0), (7.0, 7.0)))
    assert nearest_m(path, (7.0, 0.0)) < 1.5
    assert path.points[-1] == pytest.approx((7.0, 7.0))


def test_blocked_goal_is_approached_then_refused() -> None:
    grid = grid_with(((8.0, 0.0), 0.5))
    path = planned(grid, ((0.0, 0.0), (7.5, 0.0)))
    assert 4.0 < path.points[-1][0] < 6.7
    near = planned(grid, ((5.5, 0.0), (7.5, 0.0)), (5.5, 0.0))
    assert near.points == ()
    assert "goal" in near.reason
    assert "1.3 m" in near.reason


def test_blocked_reference_is_passed_to_point_nearest_its_end() -> None:
    path = planned(grid_with(((6.0, 0.0), 0.5)), ((6.0, 0.0), (6.4, 0.0)))
    assert path.reason == ""
    assert math.dist(path.points[-1], (6.4, 0.0)) < 1.0
    assert nearest_m(path, (5.5, 0.0)) > CLEARANCE_M - CELL_TOLERANCE_M


def test_of_two_ways_the_one_begun_is_kept() -> None:
    grid = grid_with(((6.0, 0.0), 0.6))
    references = [((0.0, side), (15.0, side)) for side in (-0.1, 0.1)]
    west, east = (planned(grid, reference) for reference in references)
    kept = plan_path(grid, PathRequest(references[1], CLEARANCE_M), (0.0, 0.0), west)
    sides = [max((point[1] for point in path.points), key=abs) for path in (west, east, kept)]
    assert sides[0] < -1.0
    assert sides[1] > 1.0
    assert sides[2] < -1.0


@pytest.mark.parametrize("east", [0.1, 0.3, 0.5, 0.7])
def test_gap_is_open_from_every_cell(east: float) -> None:
    """The gap's middle is in no fixed place of the search's blocks of cells."""
    row = [((6.0, 0.3 + side * (1.75 + 0.8 * number)), 0.4) for side in (-1, 1) for number in range(12)]
    path = planned(grid_with(*row, position=(0.0, east)), ((0.0, 0.0), (12.0, 0.0)), (0.0, east))
    assert path.points[-1] == pytest.approx((12.0, 0.0))
    assert max(abs(point[1]) for point in path.points) < 1.0


def test_way_out_of_the_clearance_leads_through_no_obstacle() -> None:
    """The nearest cells with enough clearance are behind the walls."""
    walls = [((north, east), 0.1) for north in (0.4, -1.3) for east in np.arange(-4.0, 4.01, 0.1)]
    path = planned(grid_with(*walls))
    assert path.points == ()
    assert "all sides" in path.reason


def test_enclosed_vehicle_has_no_way() -> None:
    ring = [((5.0 * math.cos(a), 5.0 * math.sin(a)), 0.6) for a in np.arange(0.0, math.tau, 0.3)]
    path = planned(grid_with(*ring), ((0.0, 0.0), (1.0, 0.0), (9.0, 0.0)))
    assert path.points  # to the last point before the ring
    assert path.points[-1][0] < 3.5
    near = planned(grid_with(*ring), ((2.9, 0.0), (9.0, 0.0)), (2.9, 0.0))
    assert near.points == ()
    assert "gap" in near.reason


def test_vehicle_inside_the_clearance_flies_out_of_it() -> None:
    path = planned(grid_with(((1.2, 0.0), 0.4)))
    assert path.points
    assert path.points[-1][0] == pytest.approx(15.0)
    assert path.inside
    assert planned(grid_with(((1.5, 0.0), 0.4))).inside  # by 0.3 m, the grid's cells are 0.2 m
    assert not planned(grid_with(((1.6, 0.0), 0.4))).inside  # by 0.1 m
    crowded = [((1.2 * math.cos(a), 1.2 * math.sin(a)), 0.4) for a in np.arange(0.0, math.tau, 0.5)]
    assert "all sides" in planned(grid_with(*crowded)).reason


def test_nearest_occupied_cells_are_in_the_result() -> None:
    path = planned(grid_with(((2.0, 0.0), 0.4), ((0.0, -2.5), 0.4), ((8.0, 0.0), 0.4)))
    away = [math.hypot(*point) for point in path.near]
    assert min(away) == pytest.approx(1.6, abs=CELL_M)
    assert max(away) <= 3.0
    assert min(point[1] for point in path.near) < -1.9
    assert planned(grid_with()).near == ()


def test_goal_outside_the_map_is_refused() -> None:
    assert "outside" in planned(grid_with(), ((100.0, 0.0), (120.0, 0.0))).reason


@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_any_path_keeps_the_clearance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    trunks = [
        ((float(north), float(east)), 0.4) for north, east in rng.uniform((2.5, -8.0), (14.0, 8.0), (12, 2))
    ]
    grid = grid_with(*trunks)
    path = planned(grid)
    occupied = grid.points(np.argwhere(grid.occupied))
    gaps = [nearest_m(path, (float(n), float(e))) for n, e in occupied] if path.points else []
    assert bool(path.points) is not bool(path.reason)
    assert min(gaps, default=math.inf) > CLEARANCE_M - CELL_M
