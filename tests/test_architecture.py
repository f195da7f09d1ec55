"""Imports run downwards only. `docs/architecture.md` has the same layers."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# Each package of `companion` with its layer; it may import from lower layers alone.
COMPANION_LAYERS = {
    "geometry": 0,
    "host": 0,
    "settings": 1,
    "vehicle": 2,
    "guidance": 3,
    "operator": 4,
    "perception": 4,
    "bus": 5,
    "client": 6,
    "recording": 6,
    "ground_station": 7,
    "language": 7,
    "mqtt": 7,
    "ros2": 7,
    "service": 7,
    "dashboard": 8,
    "camera_tools": 9,
    "doctor": 9,
    "logs": 9,
    "models": 9,
    "simulation": 9,
    "bench": 10,
    "learning": 10,
    "setup": 10,
    "cli": 11,
}
# What people and other programs reach a flight by; and the parts of these inside the service, or that
# `import companion` offers.
INTERFACES = (
    "companion.client",
    "companion.dashboard",
    "companion.doctor",
    "companion.ground_station",
    "companion.language",
    "companion.mqtt",
    "companion.operator",
    "companion.recording",
    "companion.ros2",
    "companion.setup",
)
INTERFACES_INSIDE = {
    "companion.client",
    "companion.operator.console",
    "companion.operator.metrics",
    "companion.recording",
    "companion.recording.guidance_record",
    "companion.recording.tap",
}
# What never runs beside a flight's own processes: it makes, measures, inspects, or simulates.
WORKSHOP = (
    "companion.bench",
    "companion.camera_tools",
    "companion.learning",
    "companion.logs",
    "companion.models",
    "companion.simulation",
    "mavlink_sim",
    "vision.calibration",
    "vision.evaluation",
    "vision.exports",
    "vision.training",
)
# The programs of a flight; of `companion.cli` only this command is one.
PROGRAMS = (
    "companion.cli.run",
    "companion.dashboard.__main__",
    "companion.ground_station.__main__",
    "companion.mqtt.__main__",
    "companion.perception.worker",
    "companion.recording.__main__",
    "companion.ros2.__main__",
)
# What an operator runs beside a flight.
OPERATORS_PROGRAMS = (
    "companion.cli.ask",
    "companion.cli.client",
    "companion.cli.console",
    "companion.cli.doctor",
    "companion.cli.init",
    "companion.cli.install",
    "companion.cli.mcp",
    "companion.cli.signing",
    "companion.cli.ros2",
    "companion.client.drone",
    "companion.ros2.bag",  # of `companion log convert`
)
# The same inside `companion.guidance`: its folders, and its own files.
GUIDANCE_LAYERS = {
    "motion": 0,
    "search_pattern": 0,
    "objects": 1,
    "path": 1,
    "policy_network": 0,
    "policy_file": 1,
    "formation": 2,
    "behaviour": 3,
    "command": 4,
    "interface": 4,
    "gimbal": 5,
    "behaviours": 6,
    "grammar": 6,
    "limits": 7,
    "missions": 7,
    "authority": 8,
    "avoidance": 8,
    "command_queue": 8,
    "requirements": 8,
    "setpoint_output": 9,
    "mode_control": 10,
    "behaviour_runner": 11,
    "core": 12,
}
# The same for `mavlink_sim`: its packages and its own files. Imports inside functions and under
# TYPE_CHECKING count as well.
SIMULATOR_LAYERS = {
    "px4": 0,
    "releases": 0,
    "world": 0,
    "physics": 1,
    "wire": 1,
    "camera": 2,
    "flight": 2,
    "testing": 2,
    "datasets": 3,
    "missions": 3,
    "pytest_plugin": 3,
    "autopilot": 4,
    "faults": 5,
    "services": 5,
    "vehicles": 6,
    "lockstep": 7,
    "realtime": 7,
    "__init__": 8,
    "cli": 8,
    "environments": 8,
    "__main__": 9,
}
MAX_SIMULATOR_LAYERS = 10
# Besides these, only behaviours made of others call a behaviour; and unit tests of single updates.
STEPS_BEHAVIOURS = ("companion/guidance/behaviour_runner.py",)
COMPOSED_BEHAVIOURS = ("companion/guidance/behaviours/", "companion/guidance/missions/sequence.py")
SINGLE_STEP_TESTS = {
    "tests/companion/guidance/test_hold_orbit.py",
    "tests/companion/guidance/test_paths.py",
    "tests/companion/guidance/test_seek_needs_a_gimbal.py",
    "tests/companion/guidance/test_takeoff_land_stop.py",
}
# Elsewhere `companion.host.tasks.spawn`, which logs an error that ends a task: here the task is awaited where
# it is started, so the error is raised there.
AWAITED_TASKS = {
    "companion/bench/setpoints.py",
    "companion/cli/ask.py",
    "companion/cli/console.py",
    "companion/cli/run.py",
    "companion/dashboard/chat.py",
    "companion/ground_station/__main__.py",
    "companion/simulation/demo.py",
    "companion/language/serve.py",
    "companion/mqtt/publisher.py",
    "companion/mqtt/broker.py",
    "companion/perception/supervisor.py",
    "companion/simulation/play.py",
    "companion/service/ending.py",
    "companion/service/service.py",
    "companion/simulation/session.py",
    "companion/host/tasks.py",
}
# File → places that copy a payload. The simulator does not import the companion: it checks by itself; a
# payload of MAVLink has at most 255 bytes.
COPIES_OF_PAYLOADS = {
    "companion/host/peer_data.py": 1,
    "mavlink_sim/faults/injector.py": 1,
    "mavlink_sim/services/file_transfer.py": 1,
}
# Depth keeps its 16 bits or floats.
DECODE_IMAGE_FILES = {"vision/image_file.py", "vision/sources/depth_images.py"}
SERVICE, MAX_SERVICE_LINES = ROOT / "companion" / "service", 250
SIMULATOR_MAY_IMPORT = {
    "vision.attitude",
    "vision.calibration.boards",
    "vision.calibration_files.camera_info",
    "vision.camera_model",
    "vision.class_names",
    "vision.depth_registration",
    "vision.extras",
    "vision.file_kinds",
    "vision.frame",
    "vision.geolocation",
    "vision.gc_pause",
    "vision.marker_dictionaries",
    "vision.rotation",
    "vision.shared_frame",
    "vision.text_file",
}
MAY_IMPORT_SIMULATOR = {"simulation", "learning", "bench", "models"}


@cache
def modules() -> dict[str, Path]:
    """Dotted name → file, of everything that is installed."""
    found = {}
    for package in ("companion", "vision", "mavlink_sim"):
        for path in (ROOT / package).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def imports_of(name: str, path: Path) -> frozenset[str]:
    """Our own modules that a module imports, inside functions and under TYPE_CHECKING too."""
    known = modules()
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{name} imports relatively; write the whole name"
            for alias in node.names:
                submodule = f"{node.module}.{alias.name}"
                found.add(submodule if submodule in known else node.module)
    return frozenset(module for module in found if module in known and module != name)


def trees_with(words: str, *packages: str) -> Iterator[tuple[str, ast.AST]]:
    """Name and syntax tree of the files that have one of these words: to parse all takes seconds."""
    for package in packages:
        for path in (ROOT / package).rglob("*.py"):
            if re.search(words, text := path.read_text()):
                yield path.relative_to(ROOT).as_posix(), ast.parse(text)


def circles(package: str) -> set[frozenset[str]]:
    """The sets of modules of a package that import each other (Tarjan's strongly connected components)."""
    graph = {name: imports_of(name, path) for name, path in modules().items() if name.startswith(package)}
    order: dict[str, int] = {}
    lowest: dict[str, int] = {}
    stack: list[str] = []
    found: set[frozenset[str]] = set()

    def visit(name: str) -> None:
        order[name] = lowest[name] = len(order)
        stack.append(name)
        for other in graph[name] & graph.keys():
            if other not in order:
                visit(other)
            if other in stack:
                lowest[name] = min(lowest[name], lowest[other])
        if lowest[name] == order[name]:
            component = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(component) > 1:
                found.add(frozenset(component))

    for name in graph:
        if name not in order:
            visit(name)
    return found


def part(module: str) -> str:
    """`companion.guidance.core` → guidance."""
    return module.split(".")[1]


def test_vision_imports_nothing_of_the_others() -> None:
    for name, path in modules().items():
        if name.startswith("vision"):
            others = {m for m in imports_of(name, path) if not m.startswith("vision")}
            assert not others, f"{name} imports {others}"


def test_simulator_imports_only_geometry_and_frames_of_vision() -> None:
    for name, path in modules().items():
        if name.startswith("mavlink_sim"):
            others = {m for m in imports_of(name, path) if not m.startswith("mavlink_sim")}
            assert others <= SIMULATOR_MAY_IMPORT | {"vision"}, f"{name} imports {others}"


def test_only_listed_modules_import_the_simulator() -> None:
    for name, path in modules().items():
        if name.startswith("companion.") and any(m.startswith("mavlink_sim") for m in imports_of(name, path)):
            assert part(name) in MAY_IMPORT_SIMULATOR, f"{name} imports the simulator"


def test_parts_of_the_companion_import_downwards_only() -> None:
    for name, path in modules().items():
        if not name.startswith("companion."):
            continue
        here = part(name)
        assert here in COMPANION_LAYERS, (
            f"{name}: a new part; give it a layer here and in docs/architecture.md"
        )
        for other in imports_of(name, path):
            if not other.startswith("companion.") or part(other) == here:
                continue
            assert COMPANION_LAYERS[part(other)] < COMPANION_LAYERS[here], f"{name} imports upwards: {other}"


def in_workshop(module: str) -> bool:
    return f"{module}.".startswith(tuple(f"{package}." for package in WORKSHOP))


def in_doors(module: str) -> bool:
    return f"{module}.".startswith(tuple(f"{package}." for package in INTERFACES))


def test_what_flies_imports_only_the_parts_of_doors_inside_the_service() -> None:
    found: set[str] = set()
    for name, path in modules().items():
        if not (in_workshop(name) or in_doors(name) or name.startswith("companion.cli")):
            found |= set(filter(in_doors, imports_of(name, path)))
    assert found == INTERFACES_INSIDE


def test_nothing_that_flies_imports_the_workshop() -> None:
    for package in WORKSHOP:
        assert package in modules(), package
    for name, path in modules().items():
        if not in_workshop(name) and not name.startswith("companion.cli."):
            found = sorted(filter(in_workshop, imports_of(name, path)))
            assert not found, f"{name} flies and imports {found}"


def reached_from(program: str) -> set[str]:
    """The modules that a program can import, at any time."""
    reached, waiting = {program}, [program]
    while waiting:
        name = waiting.pop()
        new = set(imports_of(name, modules()[name]))
        # A package's own file runs when a module of it is imported.
        new |= {name.rpartition(".")[0]} & modules().keys() - {"companion.cli"}
        waiting += new - reached
        reached |= new
    return reached


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_program_of_a_flight_has_no_workshop_in_it(program: str) -> None:
    assert not sorted(filter(in_workshop, reached_from(program)))


def test_what_no_program_of_a_flight_reaches_is_in_the_workshop() -> None:
    reached = set().union(*map(reached_from, (*PROGRAMS, *OPERATORS_PROGRAMS)))
    here = {name for name in modules() if not in_workshop(name) and not name.startswith("companion.cli")}
    assert here - reached <= {"companion", "vision"}


def test_what_flies_is_at_most_twenty_packages() -> None:
    packages = {".".join(name.split(".")[:2]) for name in modules() if name.count(".") > 1}
    flying = {name for name in packages if not (in_workshop(name) or in_doors(name))} - {"companion.cli"}
    assert {"companion.guidance", "vision.sources"} < flying
    assert len(flying) <= 20, sorted(flying)


def test_the_root_of_the_companion_holds_packages_alone() -> None:
    files = {path.name for path in (ROOT / "companion").glob("*.py")}
    assert files <= {"__init__.py", "__main__.py"}


def test_parts_of_guidance_import_downwards_only() -> None:
    for name, path in modules().items():
        if not name.startswith("companion.guidance."):
            continue
        here = name.split(".")[2]
        assert here in GUIDANCE_LAYERS, f"{name}: a new part of guidance; give it a layer here"
        for other in imports_of(name, path):
            there = other.removeprefix("companion.guidance").split(".")[1:2]
            if other.startswith("companion.guidance.") and there != [here]:
                assert GUIDANCE_LAYERS[there[0]] < GUIDANCE_LAYERS[here], f"{name} imports upwards: {other}"


def test_every_part_with_a_layer_exists() -> None:
    tables = {
        "companion": COMPANION_LAYERS,
        "companion/guidance": GUIDANCE_LAYERS,
        "mavlink_sim": SIMULATOR_LAYERS,
    }
    for folder, table in tables.items():
        parts = {path.stem for path in (ROOT / folder).iterdir() if path.suffix == ".py" or path.is_dir()}
        assert not table.keys() - parts, folder
    assert not (SIMULATOR_MAY_IMPORT | {"vision"}) - modules().keys()
    assert MAY_IMPORT_SIMULATOR <= COMPANION_LAYERS.keys()


def test_guidance_has_no_clock_and_no_input_or_output() -> None:
    """What it knows and when it is comes in as values; see `companion.guidance.interface`."""
    forbidden = {"asyncio", "time", "threading", "socket", "subprocess", "zenoh", "mavsdk", "pymavlink"}
    for name, path in modules().items():
        if not name.startswith("companion.guidance."):
            continue
        nodes = list(ast.walk(ast.parse(path.read_text())))
        imported = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
        imported |= {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
        assert not {module.split(".")[0] for module in imported} & forbidden, name
        calls = {
            node.func.id for node in nodes if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        assert "open" not in calls, name


def _behaviour_calls(tree: ast.AST) -> list[tuple[bool, str]]:
    """(inside a loop, text) of each call of a behaviour's `on_activate` or `update`.

    Many classes have an `update`. It is a behaviour's if its second argument names a context, or if the file
    calls `on_activate`. Calls within a method of the same name, by a behaviour that is made of others, are
    not listed.
    """
    loops = (ast.For, ast.AsyncFor, ast.While, ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
    activates = any(isinstance(node, ast.Attribute) and node.attr == "on_activate" for node in ast.walk(tree))
    found = []

    def visit(node: ast.AST, method: str, looping: bool) -> None:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            method, looping = node.name, False
        looping = looping or isinstance(node, loops)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr != method:
            arguments = [*node.args, *(word.value for word in node.keywords)]
            steps = (
                node.func.attr == "update"
                and len(arguments) == 2
                and (activates or "context" in ast.unparse(arguments[1]).lower())
            )
            if steps or node.func.attr == "on_activate":
                found.append((looping, ast.unparse(node)))
        for child in ast.iter_child_nodes(node):
            visit(child, method, looping)

    visit(tree, "", False)
    return found


def test_only_guidance_steps_a_behaviour() -> None:
    """Whoever flies one goes through `Guidance.step`; unit tests of single updates do not loop."""
    callers = {}
    folders = ("companion", "benchmarks", "examples", "tests", "tools")
    for name, tree in trees_with(r"\.(update|on_activate)\(", *folders):
        if calls := _behaviour_calls(tree):
            callers[name] = calls
    for name in STEPS_BEHAVIOURS:
        assert callers.pop(name), name
    callers = {name: calls for name, calls in callers.items() if not name.startswith(COMPOSED_BEHAVIOURS)}
    assert callers.keys() == SINGLE_STEP_TESTS
    assert not {name: calls for name, calls in callers.items() if any(looping for looping, _ in calls)}


@pytest.mark.parametrize(
    "text",
    [
        "hold.on_activate(now)\nwhile True:\n    hold.update(dt_s=0.1, context=now)",
        "hold.on_activate(now)\nfor _ in range(9):\n    hold.update(0.1, now)",
        "steps = [hold.update(0.1, context) for _ in range(9)]",
    ],
)
def test_a_loop_that_steps_a_behaviour_is_found(text: str) -> None:
    assert any(looping for looping, _ in _behaviour_calls(ast.parse(text)))


def test_no_file_of_the_service_is_long() -> None:
    """The service moves values between guidance, driver, perception and bus; its files stay small."""
    lines = {path.name: len(path.read_text().splitlines()) for path in SERVICE.glob("*.py")}
    assert len(lines) > 5
    assert not {name: count for name, count in lines.items() if count > MAX_SERVICE_LINES}


def test_simulator_imports_only_lower_layers() -> None:
    def entry(module: str) -> str:
        return module.split(".")[1] if "." in module else "__init__"

    assert len(set(SIMULATOR_LAYERS.values())) <= MAX_SIMULATOR_LAYERS
    for name, path in modules().items():
        if not name.startswith("mavlink_sim"):
            continue
        here = entry(name)
        assert here in SIMULATOR_LAYERS, f"{name}: give it a layer here and in docs/architecture.md"
        for other in imports_of(name, path):
            if other.startswith("mavlink_sim") and entry(other) != here:
                assert SIMULATOR_LAYERS[entry(other)] < SIMULATOR_LAYERS[here], f"{name} imports {other}"


@pytest.mark.parametrize("package", ["companion", "mavlink_sim", "vision"])
def test_no_circular_imports(package: str) -> None:
    assert circles(package) == set()


@pytest.mark.parametrize("package", ["companion", "vision", "mavlink_sim"])
def test_every_part_is_in_the_document(package: str) -> None:
    named = re.findall(r"`([^`\n]+)`", (ROOT / "docs" / "architecture.md").read_text().replace("```", ""))
    names = {
        path.name if path.suffix == ".py" else f"{path.name}/"
        for path in (ROOT / package).iterdir()
        if (path.suffix == ".py" and not path.name.startswith("__")) or (path / "__init__.py").is_file()
    }
    assert names
    assert not sorted(name for name in names if not {name, f"{package}/{name}"} & set(named))


def test_an_assert_only_narrows_a_type() -> None:
    """`python -O` removes it, so it must not check what may come: only what the code itself has made sure."""
    for name, tree in trees_with(r"\bassert\b", "companion", "vision", "mavlink_sim"):
        for node in ast.walk(tree):
            if isinstance(node, ast.Assert):
                assert _narrows(node.test), f"{name}:{node.lineno}"


def _narrows(test: ast.expr) -> bool:
    if isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not):
        return _narrows(test.operand)
    if isinstance(test, ast.Call) and isinstance(test.func, ast.Name):
        return test.func.id in ("isinstance", "issubclass")
    is_none = isinstance(test, ast.Compare) and isinstance(test.comparators[0], ast.Constant)
    return is_none and isinstance(test, ast.Compare) and isinstance(test.ops[0], ast.Is | ast.IsNot)


def test_no_background_task_ends_unseen() -> None:
    starts = {"create_task", "ensure_future"}
    found = set()
    for name, tree in trees_with("|".join(starts), "companion"):
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and node.attr in starts:
                found.add(name)
    assert found == AWAITED_TASKS


def _unbounded_copies(tree: ast.AST) -> list[int]:
    """Lines that copy the bytes of a zenoh payload: `to_bytes` and `to_string` without arguments, or `bytes`.

    `int.to_bytes` has arguments.
    """
    called = {
        id(node.func)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and (node.args or node.keywords)
    }
    lines = [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and node.attr in ("to_bytes", "to_string")
        and id(node) not in called
    ]
    lines += [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in ("bytes", "bytearray", "str", "memoryview")
        and any(isinstance(one, ast.Attribute) and one.attr in ("payload", "attachment") for one in node.args)
    ]
    return lines


def test_only_one_function_copies_what_a_peer_sent() -> None:
    """`companion.host.peer_data.copy_payload` checks the size first; `vision` does not know zenoh."""
    found = {}
    for name, tree in trees_with("to_bytes|to_string|payload|attachment", "companion", "mavlink_sim"):
        if lines := _unbounded_copies(tree):
            found[name] = len(lines)
    assert found == COPIES_OF_PAYLOADS


@pytest.mark.parametrize(
    "text",
    ["sample.payload.to_bytes()", "queue.offer(payload.to_bytes)", "str(sample.payload)", "a.ok.to_string()"],
)
def test_an_unbounded_copy_is_found(text: str) -> None:
    assert _unbounded_copies(ast.parse(text)) == [1]


def test_image_files_are_decoded_in_one_place() -> None:
    found = {
        path.relative_to(ROOT).as_posix()
        for path in modules().values()
        if re.search(r"\bcv2\.(imdecode|imread)", path.read_text())
    }
    assert found == DECODE_IMAGE_FILES


def test_equal_keys_are_sorted_in_one_order_on_every_processor() -> None:
    """numpy's default sort orders them by the processor's vector instructions: a replay would differ."""
    for name, tree in trees_with("argsort", "companion", "vision", "mavlink_sim"):
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("argsort"):
                assert "kind='stable'" in map(ast.unparse, node.keywords), f"{name}:{node.lineno}"
