"""Reads a `.pt` within limits, with errors that name the file and what to do.

torch's reader has no limits of memory and time, so a new file is first read in a process that has
(`load_trial`).
"""

from __future__ import annotations

import pickle
import re
from pathlib import Path
from typing import Any

import torch

from vision.file_kinds import explained, open_file
from vision.model_files import missing_model_advice
from vision.runtimes.base import RuntimeUnusableError
from vision.runtimes.load_trial import check_load
from vision.yolo.checkpoint_error import CheckpointError, UnsafeCheckpointError, one_line
from vision.yolo.torch_archive import load_archive

# Genuine names of networks that are not supported, by their class of model.
_UNSUPPORTED_MODELS = {
    "ClassificationModel": "a classification model has no boxes",
    "WorldModel": "YOLO-World is not supported",
    "YOLOEModel": "YOLOE is not supported",
    "YOLOESegModel": "YOLOE is not supported",
    "RTDETRDetectionModel": "RT-DETR checkpoints are not supported; export it to ONNX, which is",
    "SemanticSegmentationModel": "semantic segmentation has no boxes",
    "YOLOSemanticModel": "semantic segmentation has no boxes",
}
_GENUINE = ("ultralytics.nn.", "ultralytics.utils.loss.", "ultralytics.utils.tal.", "torch.nn.modules.")
# Of repositories whose checkpoints name their own package's classes.
_OTHER_PACKAGES = {
    "models.": "checkpoints of the repositories YOLOv5 (not YOLOv5u) and YOLOv7 are not supported; "
    "the ONNX export of YOLOv5 is",
    "yolov6.": "YOLOv6 is not supported",
    "super_gradients.": "YOLO-NAS is not supported",
}


def _unsupported(name: str) -> str | None:
    """Why a genuine checkpoint that names this class is not supported; None for any other name."""
    kind = name.rpartition(".")[2]
    if name == f"ultralytics.nn.tasks.{kind}" and kind in _UNSUPPORTED_MODELS:
        return _UNSUPPORTED_MODELS[kind]
    for package, reason in _OTHER_PACKAGES.items():
        if name.startswith(package) and kind[:1].isupper():
            return reason
    # A class, not a function: those are refused as calls.
    if name.startswith(_GENUINE) and (kind[:1].isupper() or kind.startswith("v8")):
        return f"it has the part {name!r:.100}, which is not supported; its ONNX export may be"
    return None


# Earlier ones have an error by which a file can run code: CVE-2026-24747.
_SAFE_TORCH = "2.10"


def read_archive(path: str | Path) -> Any:
    """Read the value saved at `path`: containers, scalars, CPU tensors, `Stub` records for the rest.

    Raises:
        UnsafeCheckpointError: the file names something that is not allowed.
        CheckpointError: missing, empty, truncated, not an archive of `torch.save`, takes too much memory or
            time, or this torch is too old. One line naming the file.
    """
    path = Path(path)
    try:
        return _read(path)
    except CheckpointError as error:
        # A checkpoint is a zip archive: of these the error says more.
        line = explained(path, f"{path}: {error}", "is a checkpoint of torch", "is a zip archive")
        raise type(error)(one_line(line)) from None
    except RuntimeUnusableError as error:
        raise CheckpointError(one_line(str(error))) from None
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file; {missing_model_advice(path)}") from None
    except IsADirectoryError:
        raise CheckpointError(f"{path}: is a folder; give the path of a .pt checkpoint") from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from None


def _read(path: Path) -> Any:
    with open_file(path) as file:
        signature = file.read(2)
    if not signature:
        raise CheckpointError("the file is empty; copy or download it again")
    if signature != b"PK":
        raise CheckpointError(
            "not a checkpoint: expected the zip archive that torch.save writes (torch 1.6 or newer)"
        )
    if torch.__version__ < _SAFE_TORCH:
        raise CheckpointError(
            f"reading it safely needs torch 2.10 or newer, this is {torch.__version__}; give a .safetensors "
            "with its .yaml, or an export"
        )
    check_load(path, "torch")
    try:
        return load_archive(path)
    except (CheckpointError, OSError):
        raise
    except pickle.UnpicklingError as error:
        raise _refused(str(error)) from None
    except Exception as error:  # of any kind: what torch meets in a damaged file
        if "TorchScript archive" in str(error):
            raise CheckpointError(
                "the file is a TorchScript program, not a checkpoint; rename it to end in .torchscript, "
                "or give the .pt of training"
            ) from None
        raise CheckpointError(
            "not an archive of torch.save, or truncated or damaged; copy or download it again"
        ) from None


# `<class 'list'>`, `<vision.yolo.torch_archive.Stub object at 0x7f...>`
_PYTHON_VALUE = re.compile(r"<(?:class ')?(?:[\w.]*\.)?(\w+)(?:'| object at 0x\w+)>")


def _refused(reason: str) -> CheckpointError:
    """The error for a pickle that torch's reader refuses."""
    named = re.search(r"GLOBAL (.*?) (?:was not an allowed|whose module)", reason, re.DOTALL)
    if named is None:
        # torch adds a paragraph before its reason, and one after it.
        reason = _PYTHON_VALUE.sub(r"a \1", reason.split("\n\n")[-2:][0])
        return CheckpointError(
            f"its pickle is damaged, or asks for more than values ({reason:.200}); nothing was run. Copy or "
            "download it again"
        )
    if (why := _unsupported(named[1])) is not None:
        return CheckpointError(f"{why}; nothing was run")
    return UnsafeCheckpointError(
        f"its pickle asks for {named[1]!r:.200}, which is not part of a detection checkpoint; nothing was "
        "run. Do not use this file, or save the model again from a source you trust"
    )
