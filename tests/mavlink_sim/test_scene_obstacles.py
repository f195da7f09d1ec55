"""The geometry of obstacles, compared with brute-force sampling."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mavlink_sim.camera.scene import Path
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.mesh import Mesh, mesh_of
from mavlink_sim.world.obstacles import Obstacles
from mavlink_sim.world.sectors import SECTORS, nearest_in_sectors
from mavlink_sim.world.world import Vector, WorldObject

RADIUS_M, HALF_HEIGHT_M = 0.3, 0.12
CLASSES = ("wall", "box", "car", "tree", "shed", "pole", "bale", "person", "drone", "boat", "fence")
SPACING_M = 0.1

objects = st.builds(
    WorldObject,
    st.just(7),
    st.sampled_from(CLASSES),
    st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.sampled_from([0.0, 0.0, -1.0])),
    st.floats(-math.pi, math.pi),
    st.floats(0.5, 2.0),
    st.integers(0, 5),
)


def points(spread: float = 5.0) -> st.SearchStrategy[NDArray[np.float64]]:
    return st.tuples(st.floats(-spread, spread), st.floats(-spread, spread), st.floats(-4, -0.2)).map(
        np.array
    )


def obstacles(*found: WorldObject, paths: dict[int, Path] | None = None) -> Obstacles:
    return Obstacles(found, paths or {}, RADIUS_M, HALF_HEIGHT_M)


def to_vector(point: NDArray[np.float64]) -> Vector:
    north, east, down = point.tolist()
    return north, east, down


def corners_of(mesh: Mesh) -> list[NDArray[np.float64]]:
    ends = [*mesh.first[1:], len(mesh.starts)]
    return [mesh.starts[first:end] for first, end in zip(mesh.first, ends, strict=True)]


def surface(scene_object: WorldObject) -> NDArray[np.float64]:
    """(N, 3) NED points all over the surface of an object, none farther than SPACING_M from the next."""
    size = scene_object.size_m if scene_object.printed is None else scene_object.printed.board_size_m
    sampled = []
    for corners in corners_of(mesh_of(scene_object.class_name, scene_object.appearance, size)):
        corners = corners * scene_object.scale
        for second, third in pairwise(corners[1:]):
            motions = second - corners[0], third - corners[0]
            steps = max(2, math.ceil(max(np.linalg.norm(direction) for direction in motions) / SPACING_M) + 1)
            a, b = np.meshgrid(*[np.linspace(0.0, 1.0, min(steps, 160))] * 2)
            inside = a + b <= 1.0 + 1e-9
            sampled.append(corners[0] + a[inside][:, None] * motions[0] + b[inside][:, None] * motions[1])
    own = np.concatenate(sampled)
    c, s = math.cos(scene_object.yaw_rad), math.sin(scene_object.yaw_rad)
    turned: NDArray[np.float64] = own @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return turned + scene_object.position_ned_m


@settings(max_examples=30, deadline=None)
@given(objects, points())
def test_nearest_point_matches_brute_force(scene_object: WorldObject, point: NDArray[np.float64]) -> None:
    mesh = mesh_of(scene_object.class_name, scene_object.appearance)
    nearest, distance = mesh.nearest(point)
    assert np.linalg.norm(nearest - point) == pytest.approx(distance, abs=1e-9)
    there = WorldObject(7, scene_object.class_name, (0.0, 0.0, 0.0), appearance=scene_object.appearance)
    sampled = float(np.linalg.norm(surface(there) - point, axis=1).min())
    assert (
        sampled - SPACING_M <= distance <= sampled + 0.002
    )  # a bent face is a few tenths of a millimetre off


@settings(max_examples=30, deadline=None)
@given(st.floats(-math.pi, math.pi), st.tuples(*[st.floats(0.2, 4)] * 3), points(3.0))
def test_a_box_contains_what_is_within_its_sides(
    yaw: float, size: tuple[float, float, float], point: NDArray[np.float64]
) -> None:
    mesh = mesh_of("box", 0, size)
    length, width, height = size
    beside = np.abs(point[:2]) - (length / 2, width / 2)
    depth = max(*beside, point[2], -height - point[2])
    assume(abs(depth) > 1e-6)
    assert mesh.contains(point) == (depth < 0.0)
    _, distance = mesh.nearest(point)
    outside = np.array([*np.maximum(beside, 0.0), max(point[2], -height - point[2], 0.0)])
    assert distance == pytest.approx(-depth if depth < 0 else float(np.linalg.norm(outside)), abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(objects, points(), st.floats(-math.pi, math.pi), st.floats(-1.5, 1.5))
def test_a_ray_ends_where_the_surface_is(
    scene_object: WorldObject, origin: NDArray[np.float64], bearing: float, up: float
) -> None:
    direction = np.array([math.cos(bearing) * math.cos(up), math.sin(bearing) * math.cos(up), -math.sin(up)])
    reach = obstacles(scene_object).range_along(to_vector(origin), to_vector(direction), 0.0)
    sampled = surface(scene_object) - origin
    along = sampled @ direction
    beside = np.linalg.norm(sampled - along[:, None] * direction, axis=1)
    if math.isfinite(reach):  # there is surface where it ends
        assert np.linalg.norm(sampled - reach * direction, axis=1).min() < SPACING_M
    # a point that the ray passes within a hair ends it there at the latest
    hit = along[(beside < 1e-4) & (along > 0.0)]
    assert not len(hit) or reach <= hit.min() + 1e-2


@settings(max_examples=30, deadline=None)
@given(objects, points())
def test_gap_is_free_and_push_resolves_contact(
    scene_object: WorldObject, centre: NDArray[np.float64]
) -> None:
    found = obstacles(scene_object)
    gap = found.nearest(to_vector(centre), 0.0)
    radii = np.array([RADIUS_M, RADIUS_M, HALF_HEIGHT_M])
    sampled = surface(scene_object)

    def depth(middle: NDArray[np.float64]) -> float:
        """Depth of the surface in the ellipsoid, 0..1 (its centre); negative: outside."""
        return 1.0 - float(np.linalg.norm((sampled - middle) / radii, axis=1).min())

    if gap.clear_m > 0.0:
        assert depth(centre) < 0.01
        to = sampled[np.linalg.norm(sampled - centre, axis=1).argmin()] - centre
        towards = to / max(float(np.linalg.norm(to)), 1e-9)
        assert depth(centre + min(gap.clear_m, 20.0) * towards) < 0.01
        return
    assert gap.obstacle is not None
    assert np.linalg.norm(gap.normal_ned) == pytest.approx(1.0)
    after = found.gap_to(gap.obstacle, to_vector(centre + gap.push_ned_m)).clear_m
    if scene_object.class_name in ("box", "bale"):  # of one convex solid
        assert after == pytest.approx(0.0, abs=1e-3)
    elif depth(centre) > 0.1:  # out of one of its solids it may be pushed into the next
        assert after > 2.0 * gap.clear_m - 1e-6


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-12, 12)] * 4), min_size=1, max_size=6).map(
        lambda rows: np.array(rows).reshape(-1, 2, 2)
    )
)
def test_each_sector_has_its_nearest_point(segments: NDArray[np.float64]) -> None:
    assume(np.abs(segments).max() > 1e-3)
    shares = np.linspace(0.0, 1.0, 1001)[:, None]
    sampled = np.concatenate([start + shares * (end - start) for start, end in segments])
    distance = np.hypot(sampled[:, 0], sampled[:, 1])
    assume(distance.min() > 0.1)  # nearer, a sample's bearing is undefined
    spacing = max(float(np.linalg.norm(end - start)) for start, end in segments) / 1000
    positions = np.arctan2(sampled[:, 1], sampled[:, 0]) / (math.tau / SECTORS)
    exact = nearest_in_sectors(segments)
    widened = 1.1 * spacing / distance / (math.tau / SECTORS) + 1e-6
    for sector in range(SECTORS):
        off = np.abs((positions - sector + SECTORS / 2) % SECTORS - SECTORS / 2)
        surely, perhaps = distance[off < 0.5 - 1e-9], distance[off <= 0.5 + widened]
        assert exact[sector] <= surely.min(initial=math.inf) + 1e-9
        assert exact[sector] >= perhaps.min(initial=math.inf) - 1.1 * spacing


@settings(max_examples=20, deadline=None)
@given(objects, points(6.0), st.floats(-math.pi, math.pi))
def test_scan_measures_only_at_its_height(
    scene_object: WorldObject, origin: NDArray[np.float64], yaw: float
) -> None:
    ranges = obstacles(scene_object).ranges_around(to_vector(origin), yaw, 12.0, 0.0)
    assert len(ranges) == SECTORS
    sampled = surface(scene_object) - origin
    level = np.linalg.norm(sampled[np.abs(sampled[:, 2]) < SPACING_M][:, :2], axis=1)
    if math.isfinite(min(ranges)):
        assert level.size
        assert min(ranges) >= level.min() - 2 * SPACING_M
    for sector in np.flatnonzero(np.isfinite(ranges)):  # a ray somewhere in the sector ends there
        rays = []
        for share in np.linspace(-0.499, 0.499, 9):
            angle = yaw + (sector + share) * math.tau / SECTORS
            rays.append(
                obstacles(scene_object).range_along(
                    to_vector(origin), (math.cos(angle), math.sin(angle), 0.0), 0.0
                )
            )
        assert min(rays) >= ranges[sector] - 1e-6


def test_moving_obstacle_follows_its_path() -> None:
    path = Path(((10.0, 0.0, 0.0), (0.0, 0.0, 0.0)), 2.0, "once", fixed_yaw_rad=0.0)
    found = obstacles(WorldObject(3, "box", (10.0, 0.0, 0.0)), paths={3: path})
    assert found.top_speed_mps == 2.0
    north = (1.0, 0.0, 0.0)
    for time_s, range_m in ((0.0, 9.5), (2.0, 5.5), (0.5, 8.5)):
        assert found.range_along((0.0, 0.0, -0.5), north, time_s) == pytest.approx(range_m)
    gap = found.nearest((0.0, 0.0, -0.5), 4.0)
    assert gap.obstacle is not None
    assert gap.obstacle.velocity_at(4.0) == pytest.approx((-2.0, 0.0, 0.0))
    assert gap.obstacle.velocity_at(9.0) == (0.0, 0.0, 0.0)


def test_flat_plate_is_no_obstacle_raised_one_is() -> None:
    marker = Print("4X4_50", 3, 0.5)
    lying = WorldObject(0, "plate", (0.0, 0.0, 0.0), printed=marker)
    raised = WorldObject(1, "plate", (0.0, 0.0, -1.0), printed=marker)
    standing = WorldObject(2, "plate", (0.0, 0.0, 0.0), printed=Print("4X4_50", 3, 0.5, standing=True))
    below = (0.0, 0.0, 1.0)
    assert obstacles(lying).range_along((0.1, 0.1, -3.0), below, 0.0) == math.inf
    assert obstacles(raised).range_along((0.1, 0.1, -3.0), below, 0.0) == pytest.approx(1.996)
    assert obstacles(standing).range_along((1.0, 0.0, -0.3), (-1.0, 0.0, 0.0), 0.0) == pytest.approx(0.998)


def test_no_obstacle_gives_infinite_gap() -> None:
    nothing = obstacles()
    assert nothing.nearest((0.0, 0.0, -1.0), 0.0).clear_m == math.inf
    assert nothing.range_along((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), 0.0) == math.inf
    assert nothing.ranges_around((0.0, 0.0, -1.0), 0.3, 12.0, 0.0) == [math.inf] * SECTORS


def test_leaning_obstacle_refused() -> None:
    with pytest.raises(ValueError, match="box-4 leans"):
        obstacles(WorldObject(4, "box", (3.0, 0.0, 0.0), roll_rad=0.5))
