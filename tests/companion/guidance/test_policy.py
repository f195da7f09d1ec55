"""Trained policies: their files, and how the behaviour flies them."""

from __future__ import annotations

import itertools
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.flights_policy_depth import run
from companion.bench.lockstep_flight import plain_settings
from companion.guidance.behaviour import Behaviour
from companion.guidance.behaviours.policy import ACTIONS, OBSERVATIONS
from companion.guidance.command import NO_CONTEXT, BuildContext, GrammarError
from companion.guidance.grammar import parse
from companion.guidance.interface import EventKind
from companion.guidance.limits.envelope import Limits
from companion.guidance.policy_file import (
    KEY,
    Layer,
    PolicyDescription,
    PolicyError,
    Quantity,
    find_policy,
    load_policy,
    write_policy,
)
from companion.guidance.policy_network import read_network
from companion.perception.cameras import PerceptionCamera
from companion.service.inputs import InputAssembler
from companion.vehicle.setpoint import Setpoint
from tests.companion.guidance.guidance_harness import (
    Flight,
    GuidanceHarness,
    assert_failed,
    assert_succeeded,
    engaged,
    flying,
)
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject

onnx = pytest.importorskip("onnx", reason="onnx is an optional extra")

RANGES = {
    "target_forward_m": (0.0, 30.0),
    "target_right_m": (-10.0, 10.0),
    "target_up_m": (-20.0, 20.0),
    "velocity_forward_m_s": (-4.0, 4.0),
    "velocity_right_m_s": (-4.0, 4.0),
    "velocity_up_m_s": (-4.0, 4.0),
    "target_age_s": (0.0, 1.0),
    "distance_wanted_m": (2.0, 10.0),
}
LIMITS = {"forward_m_s": 2.0, "right_m_s": 2.0, "up_m_s": 1.0, "turn_rad_s": 0.5}
DESCRIPTION = PolicyDescription(
    environment="companion/Approach-v0",
    rate_hz=20.0,
    observation=tuple(
        Quantity(name=name, unit=OBSERVATIONS[name], low=low, high=high)
        for name, (low, high) in RANGES.items()
    ),
    action=tuple(
        Quantity(name=name, unit=ACTIONS[name], low=-high, high=high) for name, high in LIMITS.items()
    ),
)


def linear(**gains: dict[str, float]) -> list[Layer]:
    """One layer: action → observation → gain, and `bias`."""
    weight, bias = np.zeros((len(LIMITS), len(RANGES))), np.zeros(len(LIMITS))
    for row, action in enumerate(LIMITS):
        for name, gain in gains.get(action, {}).items():
            if name == "bias":
                bias[row] = gain
            else:
                weight[row, list(RANGES).index(name)] = gain
    return [Layer(weight, bias)]


# Proportional to the distance left, with the nose turned to the target.
APPROACH = linear(
    forward_m_s={"target_forward_m": 0.5, "distance_wanted_m": -0.5},
    turn_rad_s={"target_right_m": 0.2},
)
Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def written(
        layers: list[Layer] = APPROACH, description: dict[str, Any] | None = None, key: str = KEY
    ) -> Path:
        path = tmp_path / "tried.onnx"
        write_policy(path, DESCRIPTION, layers)
        if description is not None or key != KEY:
            model = onnx.load(str(path))
            plain = description or json.loads(model.metadata_props[0].value)
            onnx.helper.set_model_props(model, {key: json.dumps(plain)})
            onnx.save(model, str(path))
        return path

    return written


def built(path: Path, more: str = "") -> Behaviour:
    return parse(f'policy "{path}" class=car {more}').build(NO_CONTEXT)


def test_linear_policy_flies_to_the_distance(write: Write) -> None:
    vehicle, car = KinematicVehicle(), SeenObject("car", 18.0, 4.0)
    flight = Flight(built(write(), "distance=6"), vehicle, [car])
    assert_succeeded(flight.run(60.0))
    assert math.dist(vehicle.position[:2], (18.0, 4.0)) == pytest.approx(6.0, abs=0.35)
    bearing = math.atan2(4.0 - vehicle.position[1], 18.0 - vehicle.position[0])
    assert vehicle.yaw_rad == pytest.approx(bearing, abs=0.02)


def test_observation_and_action_axes_are_of_the_level_frame(write: Write) -> None:
    layers = linear(
        forward_m_s={"target_forward_m": 0.1},
        right_m_s={"target_right_m": 0.1},
        up_m_s={"target_up_m": 0.1},
        turn_rad_s={"bias": 0.25},
    )
    vehicle = KinematicVehicle(yaw_rad=math.pi / 2)
    flight = Flight(built(write(layers)), vehicle, [SeenObject("car", -2.0, 8.0)])
    flight.run(0.5)
    setpoint = next(step for step in flight.steps if isinstance(step, Setpoint) and step.yaw_rate_radps)
    # Nose to the east: the car is 8 m ahead and 2 m to the right (south); it stands 5 m below.
    assert setpoint.velocity_ned_mps == pytest.approx((-0.2, 0.8, 0.5), abs=0.02)
    assert setpoint.yaw_rate_radps == pytest.approx(0.25, abs=1e-6)


def test_action_is_clipped_and_the_envelope_limits_it_further(write: Write) -> None:
    vehicle = KinematicVehicle()
    layers = linear(forward_m_s={"bias": 50.0})
    flight = Flight(built(write(layers)), vehicle, [SeenObject("car", 29.0, 0.0)])
    fastest = []
    flight.limits = Limits(max_horizontal_speed_mps=1.0)
    flight.run(6.0, lambda seconds, v: fastest.append(math.hypot(*v.velocity[:2])))
    setpoints = [step for step in flight.steps if isinstance(step, Setpoint) and step.yaw_rate_radps == 0.0]
    assert setpoints[-1].velocity_ned_mps == pytest.approx((2.0, 0.0, 0.0))
    assert max(fastest) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("car", "more", "name"),
    [
        (SeenObject("car", 40.0, 0.0), "", "target_forward_m"),
        (SeenObject("car", 20.0, 12.0), "", "target_right_m"),
    ],
)
def test_observation_outside_its_range_ends_the_policy(
    write: Write, car: SeenObject, more: str, name: str
) -> None:
    outcome = Flight(built(write(), more), KinematicVehicle(), [car]).run(10.0)
    assert_failed(outcome, "tried", name, "trained for")


@pytest.mark.parametrize("height_m", [12.0, 15.0, 19.0])
def test_bundled_policy_hands_back_at_untrained_heights(height_m: float) -> None:
    vehicle = KinematicVehicle(position=[0.0, 0.0, -height_m])
    flight = Flight(
        parse("policy approach class=car distance=6").build(NO_CONTEXT),
        vehicle,
        [SeenObject("car", 18.0, 0.0)],
    )
    assert_failed(flight.run(10.0), "approach ended: target_up_m is -", "trained for -4.4 to 2 m")
    assert math.hypot(*vehicle.position[:2]) < 0.5


def test_observation_within_the_margin_is_flown(write: Write) -> None:
    assert_succeeded(Flight(built(write()), KinematicVehicle(), [SeenObject("car", 31.4, 0.0)]).run(60.0))


def test_old_target_hands_back_to_hold_and_an_event_says_so(write: Write) -> None:
    car = SeenObject("car", 25.0, 0.0)
    vehicle = KinematicVehicle()

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        car.visible = seconds < 3.0

    outcome = Flight(built(write()), vehicle, [car]).run(20.0, each)
    assert_failed(outcome, "target_age_s is 1.0")
    assert vehicle.now_ns - KinematicVehicle().now_ns == pytest.approx(4.1e9, abs=0.2e9)


def test_bundled_policy_brakes_a_second_after_losing_its_object() -> None:
    car, vehicle = SeenObject("car", 25.0, 0.0), KinematicVehicle(position=[0.0, 0.0, -3.0])
    speeds: dict[float, float] = {}

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        car.visible = seconds < 2.9
        speeds[round(seconds, 1)] = math.hypot(*vehicle.velocity)

    flight = Flight(parse("policy approach class=car distance=6").build(NO_CONTEXT), vehicle, [car])
    assert_failed(flight.run(20.0, each), "target_age_s is 5.0")
    assert speeds[3.9] > 1.5
    assert max(speed for seconds, speed in speeds.items() if seconds > 5.5) < 0.1


def test_policy_goes_on_when_its_object_is_seen_again(write: Write) -> None:
    observation = tuple(
        each.model_copy(update={"high": 5.0}) if each.name == "target_age_s" else each
        for each in DESCRIPTION.observation
    )
    wide = DESCRIPTION.model_copy(update={"observation": observation}).model_dump(mode="json")
    car, vehicle, statuses = SeenObject("car", 18.0, 0.0), KinematicVehicle(), []
    flown = built(write(description=wide), "distance=6")

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        car.visible = not 2.0 < seconds < 5.0
        statuses.append(flown.status)

    assert_succeeded(Flight(flown, vehicle, [car]).run(40.0, each))
    assert vehicle.position[0] == pytest.approx(12.0, abs=0.35)
    assert any(text.startswith("policy tried, ") and text.endswith(" car, waiting") for text in statuses)


def test_policy_without_an_object_holds_then_ends_in_hold(write: Write) -> None:
    harness = GuidanceHarness(flying())
    outcome = harness.outcome(engaged(harness, built(write())), 15.0)
    assert_failed(outcome, "did not find the car in 10.0 s")
    assert harness.events[-1].kind is EventKind.ENDED
    assert harness.events[-1].outcome == outcome
    harness.run(1.0)
    assert harness.guidance.behaviour is not None
    assert harness.guidance.behaviour.name == "hold"
    assert math.hypot(*harness.vehicle.velocity) < 0.05


def test_action_that_is_no_number_ends_the_policy(write: Write) -> None:
    # In float32 finite in the middle of the ranges, where the file is checked, and infinite beyond 17 m.
    path = write(linear(forward_m_s={"target_forward_m": 2e37}))
    outcome = Flight(built(path), KinematicVehicle(), [SeenObject("car", 25.0, 0.0)]).run(5.0)
    assert_failed(outcome, "tried ended", "action forward_m_s is inf")


def test_policy_gives_up_after_its_limit(write: Write) -> None:
    still = linear(turn_rad_s={"target_right_m": 0.2})
    outcome = Flight(built(write(still), "limit=4"), KinematicVehicle(), [SeenObject("car", 25.0, 0.0)]).run(
        9.0
    )
    assert_failed(outcome, "not there after 4 s", "25.0 m away")


def described(**changes: Any) -> dict[str, Any]:
    """The description with other entries; `observation` and `action`: changes of their first quantity."""
    plain = DESCRIPTION.model_dump(mode="json")
    for key, change in changes.items():
        if isinstance(plain.get(key), list) and isinstance(change, dict):
            plain[key][0] |= change
        else:
            plain[key] = change
    return {key: value for key, value in plain.items() if value is not None}


@pytest.mark.parametrize(
    ("description", "words"),
    [
        (described(observation={"name": "colour"}), ["observation 'colour'", "target_forward_m"]),
        (described(action={"name": "roll_rad"}), ["action 'roll_rad'", "turn_rad_s"]),
        (described(observation={"unit": "cm"}), ["target_forward_m", " m, got 'cm'"]),
        (described(action={"unit": "km/h"}), ["forward_m_s", " m/s, got 'km/h'"]),
        (described(observation={"name": "target_right_m"}), ["a name occurs twice"]),
        (described(observation={"low": 99.0}), ["observation.0", "low", "high"]),
        (described(observation=DESCRIPTION.model_dump()["observation"][:7]), ["input", "[1, 7]", "[1, 8]"]),
        (described(action=DESCRIPTION.model_dump()["action"][:3]), ["output", "[1, 3]", "[1, 4]"]),
        (described(format="mavlink-companion.policy.v2"), ["format", "policy.v1"]),
        (described(rate_hz=None), ["rate_hz", "required"]),
        (described(rate_hz=0.0), ["rate_hz", " 1"]),
        (described(extra=1), ["extra"]),
    ],
)
def test_unusable_description_is_refused_in_one_line(
    write: Write, description: dict[str, Any], words: list[str]
) -> None:
    with pytest.raises(GrammarError) as caught:
        built(write(description=description))
    text = str(caught.value)
    assert "\n" not in text
    assert "tried" in text
    assert [word for word in words if word not in text] == [], text


def test_policy_faster_than_the_loop_is_refused(write: Write, tmp_path: Path) -> None:
    command = parse(f'policy "{write()}" class=car')
    command.build(BuildContext(loop_rate_hz=20.0))
    with pytest.raises(GrammarError, match=r"tried .* 20 .* 10 .*rate_hz"):
        command.build(BuildContext(loop_rate_hz=10.0))
    settings = plain_settings({"guidance.rate_hz": "10", "detector.enabled": "false"})
    inputs = InputAssembler(settings, [PerceptionCamera(settings.of_camera(None))], lambda *event: None)
    with pytest.raises(GrammarError, match=r" 20 .* 10 Hz: .*rate_hz"):
        inputs.read_command(1, str(command), flying().state, lambda behaviour: None)
    mission = parse("mission one.toml")
    text = f"[[step]]\ndo = '{command}'"
    with pytest.raises(GrammarError, match=r" 20 .* 10 Hz: .*rate_hz"):
        mission.build(BuildContext(attachment=text, loop_rate_hz=10.0))


def test_policy_must_observe_what_it_flies_to(tmp_path: Path) -> None:
    quantities = tuple(each for each in DESCRIPTION.observation if each.name != "target_age_s")
    path = tmp_path / "old.onnx"
    layer = Layer(np.zeros((len(LIMITS), len(quantities))), np.zeros(len(LIMITS)))
    write_policy(path, DESCRIPTION.model_copy(update={"observation": quantities}), [layer])
    with pytest.raises(GrammarError, match=r"old: .*target_age_s"):
        built(path)


def test_file_that_is_no_policy_is_refused_in_one_line(write: Write, tmp_path: Path) -> None:
    with pytest.raises(GrammarError, match=r"onnx: .*learn train"):
        built(write(key="other"))
    path = write()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(GrammarError, match=r"tried.onnx: .*ONNX .*: [^\n]+$"):
        built(path)
    path.write_bytes(b"")
    with pytest.raises(GrammarError, match=r"tried.onnx: .*empty"):
        built(path)
    path.write_bytes(bytes(4_000_001))
    with pytest.raises(GrammarError, match=r"4000000 bytes, .* 4000001"):
        built(path)
    with pytest.raises(GrammarError, match=r"policy 'none.onnx' .*: "):
        parse("policy none.onnx class=car").build(NO_CONTEXT)
    with pytest.raises(GrammarError, match=r"tried.onnx: .*\(.*nan.*\)"):
        built(write(linear(up_m_s={"bias": math.nan})))
    with pytest.raises(GrammarError, match=r"distance .*2 to 10 m.* 40 m"):
        built(write(), "distance=40")


def test_policy_needs_a_class_or_a_track() -> None:
    with pytest.raises(GrammarError, match=r"class .*track .*missing"):
        parse("policy a.onnx")
    assert parse("policy a.onnx track=7").build is not None


def test_bundled_policy_flies_an_approach_without_onnx(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("onnx", "onnxruntime"):
        monkeypatch.setitem(sys.modules, module, None)
    flown = run(1)
    assert flown.success, flown.reason
    assert flown.values["range_error_m"] < 0.5
    assert flown.values["envelope_violations"] == 0.0


def test_bundled_policy_is_computed_as_by_onnx_runtime() -> None:
    onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is an optional extra")
    policy = load_policy(find_policy("approach"))
    session = onnxruntime.InferenceSession(str(find_policy("approach")))
    described, rng = policy.description.observation, np.random.default_rng(1)
    for part in rng.uniform(0.0, 1.0, (50, len(described))):
        values = [each.low + at * (each.high - each.low) for at, each in zip(part, described, strict=True)]
        (expected,) = session.run(None, {"observation": np.array([values], np.float32)})
        assert policy.act(values) == pytest.approx(expected[0].tolist(), abs=1e-5)


def test_every_operator_is_computed_as_by_onnx_runtime() -> None:
    onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is an optional extra")
    make, floats = onnx.helper, onnx.TensorProto.FLOAT
    rng = np.random.default_rng(2)
    weights = {name: rng.normal(size=shape) for name, shape in (("square", (3, 3)), ("row", (3,)))}
    # Operators in their order, with their inputs beside the value before.
    steps = [("Gemm", ["square", "row"]), ("Tanh", []), ("MatMul", ["square"]), ("Add", ["row"])]
    steps += [("Relu", []), ("Mul", ["row"]), ("Sub", ["row"]), ("Sigmoid", []), ("Div", ["row"])]
    steps += [("Gemm", ["square"])]
    nodes = []
    for index, (kind, more) in enumerate(steps):
        given = {"alpha": 0.5} if kind == "Gemm" else {}
        nodes.append(make.make_node(kind, [f"v{index}", *more], [f"v{index + 1}"], **given))
    ports = [make.make_tensor_value_info(name, floats, [1, 3]) for name in ("v0", f"v{len(steps)}")]
    tensors = [
        make.make_tensor(name, floats, array.shape, array.astype(np.float32).flatten())
        for name, array in weights.items()
    ]
    graph = make.make_graph(nodes, "all", ports[:1], ports[1:], tensors)
    content = make.make_model(
        graph, opset_imports=[make.make_opsetid("", 17)], ir_version=8
    ).SerializeToString()
    value = rng.normal(size=(1, 3)).astype(np.float32)
    (expected,) = onnxruntime.InferenceSession(content).run(None, {"v0": value})
    assert read_network(content).compute(value) == pytest.approx(expected, rel=1e-5)


def test_unknown_operator_is_named(write: Write) -> None:
    model = onnx.load(str(path := write()))
    model.graph.node[0].op_type = "LSTM"
    onnx.save(model, str(path))
    with pytest.raises(GrammarError, match=r"LSTM .* transB .*Gemm"):
        built(path)


@pytest.mark.parametrize(
    ("weight", "nodes", "words"),
    [
        # 1.6 MB of weights whose sum would take 149 GiB.
        (
            (200_000, 1),
            [("Add", "w", "row")],
            "[200000, 200000]",
        ),
        ((10_000, 1), [("Add", "observation", "w")], "[10000, 8]"),
        ((8, 1025), [("MatMul", "observation", "w")], "[1, 1025]"),
        ((900, 900), [("MatMul", "w", "w")], "[900, 900]"),
        ((8, 4), [("MatMul", "w", "observation")], "a product of [8, 4] and [1, 8]"),
        ((7, 4), [("MatMul", "observation", "w")], "a product of [1, 8] and [7, 4]"),
        ((1, 8), [("Relu", "nothing")], "nothing computes 'nothing'"),
        ((1, 8), [("Add", "observation", "w")], "[1, 8], its output is [1, 4]"),
        ((1, 8), [("Relu", "observation")] * 101, "101 operators"),
        ((1, 2, 2), [("Relu", "w")], "at most 2 dimensions"),
        ((600, 600), [("MatMul", "wide", "w")] * 3, "1080000 multiplications"),
    ],
)
def test_network_too_large_for_a_step_is_refused(
    write: Write, weight: tuple[int, ...], nodes: list[tuple[str, ...]], words: str
) -> None:
    model = onnx.load(str(path := write()))
    del model.graph.node[:], model.graph.initializer[:]
    shapes = {"w": weight, "wide": (1, 600), "row": (1, 200_000)}
    for name in {name for _, *names in nodes for name in names} & shapes.keys():
        model.graph.initializer.append(onnx.numpy_helper.from_array(np.ones(shapes[name], np.float32), name))
    for kind, *names in nodes:
        model.graph.node.append(onnx.helper.make_node(kind, names, ["action"]))
    onnx.save(model, str(path))
    with pytest.raises(GrammarError) as caught:
        built(path)
    assert "tried.onnx: " in str(caught.value)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_file_of_countless_parts_is_refused(write: Write) -> None:
    model = onnx.load(str(path := write()))
    onnx.helper.set_model_props(model, {str(index): "x" * 1000 for index in range(200)})
    onnx.save(model, str(path))
    with pytest.raises(GrammarError, match=r"tried.onnx: .* 200000"):
        built(path)
    path.write_bytes(bytes([8, 1]) * 100_000)
    with pytest.raises(GrammarError, match=r"tried.onnx: .*1000 "):
        built(path)


def test_damaged_files_are_refused_or_computed(write: Write) -> None:
    path = write()
    whole, rng, refused = path.read_bytes(), np.random.default_rng(3), []
    for index in range(400):
        damaged = bytearray(whole)
        damaged[int(rng.integers(len(whole)))] = int(rng.integers(256))
        path.write_bytes(damaged[: int(rng.integers(len(whole)))] if index % 4 == 0 else damaged)
        try:
            load_policy(path)
        except PolicyError as error:
            refused.append(str(error))
    assert len(refused) > 100
    assert [text for text in refused if "\n" in text] == []


def test_step_of_a_large_policy_takes_less_than_a_millisecond(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    sizes = (len(RANGES), 256, 256, len(LIMITS))
    layers = [
        Layer(rng.normal(0.0, 0.05, (after, before)), np.zeros(after), "Relu" if after == 256 else "")
        for before, after in itertools.pairwise(sizes)
    ]
    write_policy(tmp_path / "large.onnx", DESCRIPTION, layers)
    policy = load_policy(find_policy(str(tmp_path / "large.onnx")))
    durations = []
    for _ in range(200):
        before_s = time.thread_time()
        action = policy.act([1.0] * len(RANGES))
        durations.append(time.thread_time() - before_s)
    assert np.median(durations) < 1e-3
    assert len(action) == len(LIMITS)
    value = np.ones(len(RANGES))
    for layer in layers:
        value = layer.weight @ value + layer.bias
        value = np.maximum(value, 0.0) if layer.activation else value
    assert action == pytest.approx(value.tolist(), abs=1e-5)
