"""The house's one rule: imports run downwards only. `docs/architecture.md` draws the same picture."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# Each room of `companion` and its floor; a room may import from lower floors alone.
FLOORS = {
    "geometry": 0,
    "plugins": 0,
    "settings": 1,
    "vehicle": 2,
    "bus": 3,
    "relay": 3,
    "guidance": 3,
    "operator": 4,
    "perception": 4,
    "service": 5,
    "sim_session": 6,
    "demo": 7,
    "play": 7,
    "detect": 7,
    "evaluate": 7,
    "models": 7,
    "train": 7,
    "bench": 7,
    "cli": 8,
}
# The same inside `companion.guidance`: its folders, and its own files.
GUIDANCE_FLOORS = {
    "gimbal_status": 0,
    "motion": 0,
    "search_pattern": 0,
    "targets": 0,
    "path": 1,
    "formation": 2,
    "behaviour": 3,
    "command": 4,
    "interface": 4,
    "gimbal": 5,
    "behaviours": 6,
    "grammar": 6,
    "limits": 7,
    "missions": 7,
    "pose_sharing": 7,
    "authority": 8,
    "command_queue": 8,
    "mode_sequence": 8,
    "requirements": 8,
    "core": 9,
}
# The same for `mavlink_sim`; its modules at the top, and the ArduPilot made of them, stand above every room.
SIMULATOR_FLOORS = {
    "px4": 0,
    "wire": 0,
    "world": 0,
    "physics": 1,
    "camera": 1,
    "flight": 2,
    "datasets": 2,
    "missions": 3,
    "autopilot": 4,
    "services": 5,
    "faults": 6,
}
SIMULATOR_TOP = 7
SIMULATOR_MAY_IMPORT = {
    "vision.attitude",
    "vision.camera_model",
    "vision.frame",
    "vision.geolocation",
    "vision.gc_pause",
    "vision.rotation",
    "vision.shared_frame",
}
MAY_IMPORT_SIMULATOR = {"sim_session", "demo", "play", "train", "bench", "models"}


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
def imports_of(name: str, path: Path, *, only_top: bool = False) -> frozenset[str]:
    """Our own modules that a module imports (inside functions too, unless `only_top`)."""
    tree = ast.parse(path.read_text())
    known = modules()
    found: set[str] = set()
    nodes = _top_level(tree) if only_top else list(ast.walk(tree))
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{name} imports relatively; write the whole name"
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return frozenset(module for module in found if module in known and module != name)


def _top_level(tree: ast.Module) -> list[ast.stmt]:
    """Statements that run at import; `if TYPE_CHECKING:` does not."""
    return [node for node in tree.body if not isinstance(node, ast.If)]


def room(module: str) -> str:
    """`companion.guidance.pilot` → guidance."""
    return module.split(".")[1]


def test_vision_imports_nothing_of_the_others() -> None:
    for name, path in modules().items():
        if name.startswith("vision"):
            others = {m for m in imports_of(name, path) if not m.startswith("vision")}
            assert not others, f"{name} imports {others}"


def test_the_simulator_imports_only_geometry_and_frames_of_vision() -> None:
    for name, path in modules().items():
        if name.startswith("mavlink_sim"):
            others = {m for m in imports_of(name, path) if not m.startswith("mavlink_sim")}
            assert others <= SIMULATOR_MAY_IMPORT | {"vision"}, f"{name} imports {others}"


def test_only_sim_session_demonstration_training_and_benchmarks_know_the_simulator() -> None:
    for name, path in modules().items():
        if name.startswith("companion.") and any(m.startswith("mavlink_sim") for m in imports_of(name, path)):
            assert room(name) in MAY_IMPORT_SIMULATOR, f"{name} imports the simulator"


def test_rooms_of_the_companion_import_downwards_only() -> None:
    for name, path in modules().items():
        if not name.startswith("companion."):
            continue
        here = room(name)
        assert here in FLOORS, f"{name}: a new room; give it a floor here and in docs/architecture.md"
        for other in imports_of(name, path):
            if not other.startswith("companion.") or room(other) == here:
                continue
            assert FLOORS[room(other)] < FLOORS[here], f"{name} imports upwards: {other}"


def test_parts_of_guidance_import_downwards_only() -> None:
    for name, path in modules().items():
        if not name.startswith("companion.guidance."):
            continue
        here = name.split(".")[2]
        assert here in GUIDANCE_FLOORS, f"{name}: a new part of guidance; give it a floor here"
        for other in imports_of(name, path):
            there = other.removeprefix("companion.guidance").split(".")[1:2]
            if other.startswith("companion.guidance.") and there != [here]:
                assert GUIDANCE_FLOORS[there[0]] < GUIDANCE_FLOORS[here], f"{name} imports upwards: {other}"


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


def test_one_file_calls_the_update_of_a_behaviour_besides_behaviours() -> None:
    """Whoever flies one goes through `Guidance.step`; only behaviours made of others call `update` too."""
    callers = set()
    for name, path in modules().items():
        if name.startswith("companion.") and not name.startswith("companion.guidance."):
            for node in ast.walk(ast.parse(path.read_text())):
                called = node.func if isinstance(node, ast.Call) else None
                if isinstance(called, ast.Attribute) and called.attr in ("update", "on_activate"):
                    callers.add((name, ast.unparse(called)))
    assert not [caller for caller in callers if "behaviour" in caller[1]], callers


def test_rooms_of_the_simulator_import_downwards_only() -> None:
    def floor(module: str) -> int:
        return SIMULATOR_FLOORS.get(module.split(".")[1], SIMULATOR_TOP)

    for name, path in modules().items():
        if not name.startswith("mavlink_sim."):
            continue
        for other in imports_of(name, path, only_top=True):
            if not other.startswith("mavlink_sim.") or other.split(".")[1] == name.split(".")[1]:
                continue
            if floor(name) < SIMULATOR_TOP:
                assert floor(other) < floor(name), f"{name} imports upwards: {other}"


def test_no_module_imports_itself_in_a_circle() -> None:
    graph = {name: imports_of(name, path, only_top=True) for name, path in modules().items()}
    finished: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        if name in trail:
            pytest.fail(" → ".join([*trail[trail.index(name) :], name]))
        if name in finished:
            return
        for other in graph[name]:
            # A package's own __init__ may gather its modules.
            if not name.startswith(f"{other}."):
                visit(other, (*trail, name))
        finished.add(name)

    for name in graph:
        visit(name, ())


@pytest.mark.parametrize("package", ["companion", "vision", "mavlink_sim"])
def test_every_room_stands_in_the_document(package: str) -> None:
    document = (ROOT / "docs" / "architecture.md").read_text()
    names = {
        f"`{path.name}`" if path.suffix == ".py" else f"`{path.name}/`"
        for path in (ROOT / package).iterdir()
        if (path.suffix == ".py" and not path.name.startswith("__")) or (path / "__init__.py").is_file()
    }
    assert names
    assert not sorted(name for name in names if name not in document)
