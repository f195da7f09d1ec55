"""The optional parts of the package: which extra of pyproject.toml brings which module.

Imports nothing, for it is read where much is missing.
"""

from __future__ import annotations

EXTRA_OF = {
    "aioconsole": "console",
    "av": "video",
    "cuda": "tensorrt",
    "depthai": "oak",
    "foxglove": "foxglove",
    "gymnasium": "rl",
    "httpx": "llm",
    "mavsdk": "mavsdk",
    "mcap": "recording",
    "mcp": "mcp",
    "mcp_types": "mcp",
    "onnx": "torch",
    "OpenEXR": "exr",
    "openvino": "openvino",
    "prometheus_client": "metrics",
    "pyrealsense2": "realsense",
    "pyulog": "recording",
    "ray": "cluster",
    "small_gicp": "cloud",
    "stable_baselines3": "rl",
    "tensorboard": "rl",
    "tensorrt": "tensorrt",
    "torch": "torch",
}
"""Module → extra."""


def install_command(module: str) -> str:
    """What installs a module, such as `pip install 'mavlink-companion[torch]'`."""
    extra = EXTRA_OF.get(module.partition(".")[0])
    return f"pip install {module}" if extra is None else f"pip install 'mavlink-companion[{extra}]'"


def missing_module(error: ImportError) -> str | None:
    """One line for a failed import: `torch is not installed: pip install …`; None if no extra brings it."""
    module = error.name or ""
    if not isinstance(error, ModuleNotFoundError) or module.partition(".")[0] not in EXTRA_OF:
        return None
    return f"{module} is not installed: {install_command(module)}"
