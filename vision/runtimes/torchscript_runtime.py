"""A TorchScript file written by `export`, run by torch on the processor.

A TorchScript file is a program, though only of tensor operations. Load only files you trust.
"""

from __future__ import annotations

import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vision.runtimes.base import Precision, RuntimeName, RuntimeUnusableError
from vision.runtimes.exported import KEY, ExportedFacts, not_ours
from vision.runtimes.torch_runtime import torch_product
from vision.yolo.level_outputs import Head, LevelOutput, Product


class TorchScriptRuntime:
    """See `base.Runtime`. Computes in float32, the precision of the file."""

    product: Product = staticmethod(torch_product)
    name: RuntimeName = "torch"

    def __init__(
        self,
        path: Path,
        head: Head | None = None,
        *,
        precision: Precision = "auto",
        threads: int | None = None,
    ) -> None:
        if precision not in ("auto", "float32"):
            raise RuntimeUnusableError(f"{path}: a TorchScript file computes in float32, not in {precision}")
        if threads is not None:
            torch.set_num_threads(threads)
        if not path.is_file():
            raise RuntimeUnusableError(f"{path}: no such file")
        try:
            with warnings.catch_warnings():
                # torch deprecates this file format; existing files must still be readable.
                warnings.simplefilter("ignore", DeprecationWarning)
                load: Any = torch.jit.load
                self._module: Any = torch.jit.freeze(load(str(path), map_location="cpu").eval())
        except RuntimeError as error:
            reason = " ".join(str(error).split())[:300]
            raise RuntimeUnusableError(f"{path}: torch cannot load it: {reason}") from error
        self.head = head if head is not None else torchscript_facts(path).head()
        self.precision, self.precision_reason = "float32", "precision of the file"

    @property
    def threads(self) -> int:
        return torch.get_num_threads()

    def prepare(self, height: int, width: int) -> None:
        for _ in range(2):
            self.infer(np.zeros((height, width, 3), np.uint8))

    def infer(self, image_bgr: NDArray[np.uint8]) -> list[LevelOutput]:
        with torch.inference_mode():
            outputs = [level[0].numpy() for level in self._module(torch.from_numpy(image_bgr).unsqueeze(0))]
        return self.head.levels(outputs)


def torchscript_facts(path: Path) -> ExportedFacts:
    """Read the metadata of an exported TorchScript file; nothing in it is run."""
    try:
        with zipfile.ZipFile(path) as archive:
            name = next((name for name in archive.namelist() if name.endswith(f"/extra/{KEY}")), None)
            if name is None:
                raise not_ours(path)
            text = archive.read(name).decode(errors="replace")
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise RuntimeUnusableError(f"{path}: is not a TorchScript file ({error})") from error
    return ExportedFacts.from_json(text, path)
