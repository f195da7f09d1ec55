"""The optional parts of the package: which extra of pyproject.toml brings which module.

Imports nothing, for it is read where much is missing.
"""

from __future__ import annotations

EXTRA_OF = {
    "aioconsole": "service",
    "aiomqtt": "mqtt",
    "av": "cameras",
    "cuda": "nvidia",
    "depthai": "cameras",
    "foxglove": "recording",
    "gymnasium": "learn",
    "httpx": "language",
    "mavsdk": "service",
    "mcap": "recording",
    "mcp": "language",
    "mcp_types": "language",
    "onnx": "models",
    "OpenEXR": "cameras",
    "openvino": "models",
    "prometheus_client": "service",
    "pyrealsense2": "cameras",
    "ray": "learn",
    "small_gicp": "cameras",
    "stable_baselines3": "learn",
    "tensorboard": "learn",
    "tensorrt": "nvidia",
    "torch": "models",
}
"""Module → extra."""


def install_command(module: str) -> str:
    """What installs a module, such as `pip install 'mavlink-companion[models]'`."""
    extra = EXTRA_OF.get(module.partition(".")[0])
    return f"pip install {module}" if extra is None else f"pip install 'mavlink-companion[{extra}]'"


def missing_module(error: ImportError) -> str | None:
    """One line for a failed import: `torch is not installed: pip install …`; None if no extra brings it."""
    module = error.name or ""
    if not isinstance(error, ModuleNotFoundError) or module.partition(".")[0] not in EXTRA_OF:
        return None
    return f"{module} is not installed: {install_command(module)}"
