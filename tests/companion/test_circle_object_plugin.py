"""The example plug-in that sees: installed, and flown in lockstep with the rendered camera."""

from __future__ import annotations

import ast
import math
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import companion
from benchmarks.rendered import camera_settings, rendered_scene
from companion.bench.lockstep_flight import Camera, FlightLog, LockstepFlight, Moment
from companion.bench.rendered_camera import RenderedCamera
from companion.bench.synthetic_camera import SyntheticCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose, SyntheticDetector
from companion.guidance.behaviour import Behaviour
from companion.guidance.command import COMMANDS, NO_CONTEXT
from companion.guidance.grammar import json_schema, parse, usage
from companion.guidance.objects.tracked_object import Subject
from companion.settings.plugins import load_plugins
from mavlink_sim.lockstep import LockstepVehicle
from tests.companion.test_circle_plugin import installed_package
from vision.camera_model import CameraModel, CameraMount

EXAMPLE = Path(__file__).parents[2] / "examples" / "circle_object"
CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1, pitch_rad=math.radians(-22.0), stabilized=True)
SIZES_M = {"car": (4.2, 1.8, 1.5), "person": (0.5, 0.6, 1.7)}
RADIUS_M, SPEED_MPS = 8.0, 2.0
# A lap takes 25 s.
SETTLING_S, FLIGHT_S = 12.0, 40.0
WITHIN_M, WITHIN_RAD, LEAST_SHARE = 2.0, math.radians(15.0), 0.9


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return installed_package(EXAMPLE, tmp_path_factory.mktemp("circle-object"))


@pytest.fixture(autouse=True)
def _plugin(site: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(site)
    before = dict(COMMANDS)
    load_plugins(["circle-object"])
    yield
    COMMANDS.clear()
    COMMANDS.update(before)
    sys.modules.pop("companion_circle_object", None)


def built(text: str) -> Behaviour:
    return parse(text).build(NO_CONTEXT)


def scene(seed: int) -> tuple[str, list[SceneObject]]:
    """A class, and an object of it before the vehicle, which stands or moves; and one of the other class."""
    rng = np.random.default_rng((seed, 47))
    names = ("car", "person") if seed % 2 else ("person", "car")
    north, east = float(rng.uniform(10.0, 16.0)), float(rng.uniform(-3.0, 3.0))
    heading = float(rng.uniform(-math.pi, math.pi))
    speed_mps = float(rng.uniform(1.1, 1.5)) if seed % 4 >= 2 else 0.0

    def pose(seconds: float) -> ScenePose:
        gone_m = speed_mps * max(0.0, seconds - 2.0)
        return ScenePose(north + gone_m * math.cos(heading), east + gone_m * math.sin(heading), heading)

    aside = ScenePose(north + 14.0, east - 9.0, 1.0)
    other = SceneObject(names[1], SIZES_M[names[1]], lambda _: aside)
    return names[0], [SceneObject(names[0], SIZES_M[names[0]], pose), other]


def flown(seed: int, *, rendered: bool, hidden_s: float = math.inf) -> tuple[FlightLog, list[bool], float]:
    """A flight; for each step whether it was on the circle, nose to the object; and the angle flown."""
    class_name, objects = scene(seed)
    goal = objects[0] = SceneObject(
        class_name, objects[0].size_m, objects[0].pose, lambda seconds: seconds > hidden_s
    )
    settings = camera_settings(CAMERA, MOUNT, {"detector.image_size": "320", "detector.threads": "1"})
    if rendered:
        drawn, (goal, *_) = rendered_scene(objects, CAMERA, MOUNT, seed)

    def camera(vehicle: LockstepVehicle) -> Camera:
        if rendered:
            return RenderedCamera(settings, drawn, vehicle, by_flight=True, depth=False)
        return SyntheticCamera(settings, detect=SyntheticDetector(objects, CAMERA, MOUNT, seed=seed))

    flight = LockstepFlight.airborne(seed=seed, height_m=4.0, wind_mps=1.0, camera=camera)
    flight.turn_to(0.0)
    on_circle: list[bool] = []
    angles: list[float] = []

    def judge(moment: Moment) -> None:
        north, east, _ = moment.truth.position_ned_m
        pose, yaw_rad = goal.pose(moment.seconds), moment.context.state.yaw_rad
        assert yaw_rad is not None
        to_it = math.atan2(pose.east_m - east, pose.north_m - north)
        angles.append(to_it)
        if moment.seconds > SETTLING_S:
            # On a circle about a point of the object, between its nearest surface and its middle.
            surface_m = goal.range_m(moment.truth.position_ned_m, moment.seconds)
            middle_m = math.hypot(pose.north_m - north, pose.east_m - east)
            off_rad = abs(math.remainder(to_it - yaw_rad, math.tau))
            good = surface_m <= RADIUS_M + WITHIN_M and middle_m >= RADIUS_M - WITHIN_M
            on_circle.append(good and off_rad <= WITHIN_RAD)

    log = flight.fly(
        built(f"circle-object {class_name} radius={RADIUS_M:g} speed={SPEED_MPS:g}"), FLIGHT_S, each=judge
    )
    return log, on_circle, float(np.ptp(np.unwrap(angles)))


def assert_flown(log: FlightLog, on_circle: list[bool], turned_rad: float) -> None:
    assert log.outcome is None, log.outcome
    assert not log.violations
    assert turned_rad > math.tau
    assert np.mean(on_circle) >= LEAST_SHARE


def test_example_uses_public_names_alone() -> None:
    text = (EXAMPLE / "companion_circle_object.py").read_text()
    assert len(text.splitlines()) <= 45
    nodes = list(ast.walk(ast.parse(text)))
    imports = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    assert imports == {"math", "companion"}
    assert [node.module for node in nodes if isinstance(node, ast.ImportFrom)] == ["typing"]
    attributes = [(node.value, node.attr) for node in nodes if isinstance(node, ast.Attribute)]
    names = {name for value, name in attributes if isinstance(value, ast.Name) and value.id == "c"}
    assert {"Subject", "Behaviour"} <= names <= set(companion.__all__)


@pytest.mark.parametrize(
    ("text", "subject"),
    [
        ("circle-object car", Subject("car")),
        ("circle-object track=17 radius=5", Subject(track_id=17)),
        ("circle-object marker=0", Subject(marker_id=0)),
    ],
)
def test_its_subject_is_one_field(text: str, subject: Subject) -> None:
    behaviour = built(text)
    assert behaviour.subject == subject
    needs = {"steering_marker"} if subject.marker_id is not None else {"perception", "depth_or_size"}
    assert behaviour.needs == {"position", "in_air"} | needs


def test_its_help_and_schema_are_those_of_the_others() -> None:
    assert usage(COMMANDS["circle-object"]).startswith("circle-object CLASS|track=…|marker=… [radius=8]")
    schema = json_schema()["$defs"]
    for key in ("class", "track", "marker"):
        own = schema["circle-object"]["properties"][key]
        assert own == schema["follow"]["properties"][key] == schema["orbit"]["properties"][key]
    assert schema["circle-object"]["oneOf"] == schema["follow"]["oneOf"]


@pytest.mark.parametrize("seed", [2, pytest.param(1, marks=pytest.mark.slow)])  # it moves; it stands
def test_circle_moves_along_with_its_object(seed: int) -> None:
    assert_flown(*flown(seed, rendered=False))


def test_lost_object_ends_it_with_the_reason() -> None:
    log, *_ = flown(1, rendered=False, hidden_s=15.0)
    assert log.outcome is not None
    assert not log.outcome.success
    assert "the car for 3." in log.outcome.reason
    assert log.moments[-1].seconds < 19.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 21))
def test_circle_is_flown_with_the_rendered_camera(seed: int) -> None:
    assert_flown(*flown(seed, rendered=True))
