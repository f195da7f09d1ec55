"""A small model and a small source: the service's tests need no external data."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.vehicle.commander import ForeignSetpoint
from companion.vehicle.setpoint_echo import SetpointEcho
from companion.vehicle.state import VehicleState

# torch is imported by the fixtures that need it: it takes longer than the collection of all tests.


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """The file of that name, which the first of the parallel workers makes for all."""
    base = factory.getbasetemp()
    path = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            make(path)
    return path


@pytest.fixture(autouse=True)
def foreign_setpoints(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[list[ForeignSetpoint]]:
    """Setpoints of another program that were noticed. There must be none, unless the test has another one."""
    found: list[ForeignSetpoint] = []
    confirm = SetpointEcho.confirm

    def confirm_and_note(echo: SetpointEcho, state: VehicleState, now_ns: int) -> VehicleState:
        after = confirm(echo, state, now_ns)
        if after is not state and after.foreign_setpoint is not None:
            found.append(after.foreign_setpoint)
        return after

    monkeypatch.setattr(SetpointEcho, "confirm", confirm_and_note)
    yield found
    if request.node.get_closest_marker("other_commander") is None:
        assert found == []


@pytest.fixture(scope="session")
def small_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network with random weights. Its metadata says that it knows rendered scenes only."""

    def make(path: Path) -> None:
        import torch

        from tests.vision.small_network import small_description
        from vision.detector import RENDERED_SCENES
        from vision.yolo.architecture import build
        from vision.yolo.checkpoint import save_checkpoint

        torch.manual_seed(1)
        model = build(small_description(("person", "car", "boat"))).eval()
        trained_on = f"{RENDERED_SCENES}nobody"
        save_checkpoint(path, model, metadata={"licence": "Apache-2.0", "trained_on": trained_on})

    return made_once(tmp_path_factory, "small.pt", make)


@pytest.fixture(scope="session")
def exported_model(small_model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same for ONNX Runtime: loading torch takes half of a worker's start."""
    for package in ("onnx", "onnxruntime"):
        pytest.importorskip(package, reason=f"{package} is an optional extra")

    def make(path: Path) -> None:
        from vision.exports.export import export

        export(small_model, "onnx", path, 160, model_family="YOLOv8")

    return made_once(tmp_path_factory, "small.onnx", make)


@pytest.fixture(scope="session")
def image_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of twenty small images."""
    folder = tmp_path_factory.mktemp("images")
    rng = np.random.default_rng(0)
    for index in range(20):
        image = cv2.resize(rng.integers(0, 255, (12, 16, 3), dtype=np.uint8), (160, 120))
        assert cv2.imwrite(str(folder / f"{index:03d}.png"), image)
    return folder


@pytest.fixture(scope="session")
def filming(image_folder: Path) -> list[str]:
    """Flags for a service that reads the images, ten a second, without detection."""
    return [
        *("--source", str(image_folder), "--source-loop", "true", "--source-rate-hz", "10"),
        *("--detector-enabled", "false", "--guidance-perception-max-age-s", "3"),
    ]


@pytest.fixture
def seeing(exported_model: Path, image_folder: Path) -> list[str]:
    """Flags for a service that detects in the images, ten a second."""
    return [
        *("--source", str(image_folder), "--source-loop", "true", "--source-rate-hz", "10"),
        *("--model", str(exported_model), "--detector-image-size", "160"),
        *("--guidance-perception-max-age-s", "3"),
    ]
