"""Checks of the detector's model and of torch: file, licence, what it was trained on, CUDA."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from companion.doctor.camera_device import sources
from companion.doctor.check import Check, fault, ok, unknown, warning
from companion.doctor.facts import CheckKind, Facts
from companion.settings.perception import DEFAULT_MODEL
from vision.catalog import AGPL, LICENCE_NOTES, known_by_digest
from vision.detector import model_path
from vision.object_detector import YOLO
from vision.runtimes.source import read_source
from vision.yolo.checkpoint_pair import weights_sha256

_RENDERED = "shm://"  # frames of the simulated camera, and of our other cameras
# Reading a checkpoint imports torch, which takes seconds on a board.
_QUICK = (".onnx",)


def _models(facts: Facts) -> Iterator[Check]:
    for name, source in sources(facts):
        detector = facts.settings.of_camera(name).detector
        if not detector.enabled or detector.kind != YOLO:
            continue
        label = "model" if name is None else f"model {name}"
        try:
            path = model_path(detector.model, detector.runtime, detector.precision, detector.device)
            licence = _licence(path)
        except (ValueError, OSError) as error:
            yield fault(label, str(error).splitlines()[0], "companion models show")
            continue
        if detector.model == DEFAULT_MODEL and not source.uri.startswith(_RENDERED):
            yield warning(
                label,
                "the bundled model is trained on rendered scenes, not on camera images",
                "companion models pull yolox_s, and detector.model = yolox_s",
            )
        elif licence is None:
            yield unknown(label, f"{path}: states no licence", "ask who trained it before you ship it")
        elif "AGPL" in licence.upper():
            yield ok(label, f"{path}: {licence}: {LICENCE_NOTES[AGPL]}")
        else:
            yield ok(label, f"{path}: {licence}")


def _licence(path: Path) -> str | None:
    """Return the licence that a model states, or that of the official file with its digest."""
    official = known_by_digest(weights_sha256(path))
    if official is not None:
        return official.licence
    if path.suffix not in _QUICK:
        return None
    metadata = read_source(path).metadata
    stated = metadata.get("licence") or metadata.get("license")
    return None if stated is None else str(stated)


def torch_cuda() -> str | None:
    """Return the CUDA version that the installed torch was built for. None: without, or no torch.

    It is read from torch's own text: its import takes seconds.
    """
    spec = find_spec("torch")
    if spec is None or spec.origin is None:
        return None
    try:
        text = (Path(spec.origin).parent / "version.py").read_text()
    except OSError:
        return None
    found = re.search(r"^cuda\b[^=]*=\s*['\"]([\d.]+)['\"]", text, re.MULTILINE)
    return None if found is None else found[1]


def has_cuda(facts: Facts) -> bool:
    """Whether there is an NVIDIA GPU, of a desktop or of a Jetson."""
    dev = facts.machine.dev
    return any((dev / name).exists() for name in ("nvidiactl", "nvhost-gpu", "nvgpu", "nvmap"))


def _torch(facts: Facts) -> Iterator[Check]:
    cuda, gpu = torch_cuda(), has_cuda(facts)
    wanted = [name for name, _ in sources(facts) if facts.settings.of_camera(name).detector.device == "cuda"]
    if wanted and not gpu:
        yield fault("torch", "detector.device is cuda, and there is no NVIDIA GPU", 'detector.device = "cpu"')
    elif wanted and cuda is None:
        advice = "install NVIDIA's torch for this JetPack, or export the model: companion models export"
        yield fault("torch", "detector.device is cuda, and torch is built without CUDA", advice)
    elif cuda is not None and not gpu:
        yield warning(
            "torch",
            f"torch is built for CUDA {cuda}, gigabytes that nothing here can use",
            "pip install --force-reinstall torch --index-url https://download.pytorch.org/whl/cpu",
        )
    elif find_spec("torch") is not None:
        yield ok("torch", f"torch is built {'without CUDA' if cuda is None else f'for CUDA {cuda}'}")


CHECKS = (
    CheckKind("model", "a missing file, a licence, the bundled model on camera images", _models),
    CheckKind("torch", "torch with CUDA and no GPU, or `detector.device` cuda without", _torch),
)
