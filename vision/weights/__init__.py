"""The model that comes with the package: trained on drawn scenes by this project's own code."""

from __future__ import annotations

from pathlib import Path

DEFAULT_WEIGHTS = Path(__file__).parent / "default.safetensors"
"""The checkpoint, for torch: to train further, and to export."""
DEFAULT_EXPORT = DEFAULT_WEIGHTS.with_suffix(".onnx")
"""The same network, for ONNX Runtime: `companion models export default --to onnx --output` this file."""
