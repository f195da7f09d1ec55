"""The model that comes with the package: trained on drawn scenes by this project's own code."""

from __future__ import annotations

from pathlib import Path

DEFAULT_WEIGHTS = Path(__file__).parent / "default.safetensors"
