"""The companion-computer service for PX4 and ArduPilot vehicles, as a library.

A behaviour of one's own needs these names; `docs/how-to/plug-ins.md` shows how. Other types of arguments and
`GrammarError` are in `companion.guidance.command`.

    from companion import Behaviour, Command, Number, Setpoint, behaviour

A program that flies vehicles needs `connect` alone (`docs/how-to/client.md`).

They are imported when they are first used: `import companion` itself costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from companion.client import connect
    from companion.guidance.behaviour import (
        Behaviour,
        BehaviourContext,
        ModeRequest,
        Outcome,
        Requirement,
    )
    from companion.guidance.command import (
        BuildContext,
        ClassName,
        Command,
        EnumArgument,
        Number,
        behaviour,
    )
    from companion.guidance.objects.table import ObjectTable
    from companion.guidance.objects.tracked_object import Subject, TrackedObject
    from companion.service import Service
    from companion.settings import Settings
    from companion.vehicle.setpoint import Setpoint

_MODULES = {
    "companion.guidance.behaviour": (
        "Behaviour",
        "ModeRequest",
        "Outcome",
        "Requirement",
        "BehaviourContext",
    ),
    "companion.guidance.command": (
        "BuildContext",
        "ClassName",
        "Command",
        "EnumArgument",
        "Number",
        "behaviour",
    ),
    "companion.guidance.objects.table": ("ObjectTable",),
    "companion.guidance.objects.tracked_object": ("Subject", "TrackedObject"),
    "companion.client": ("connect",),
    "companion.service": ("Service",),
    "companion.settings": ("Settings",),
    "companion.vehicle.setpoint": ("Setpoint",),
}
_WHERE = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "Behaviour",
    "BehaviourContext",
    "BuildContext",
    "ClassName",
    "Command",
    "EnumArgument",
    "ModeRequest",
    "Number",
    "ObjectTable",
    "Outcome",
    "Requirement",
    "Service",
    "Setpoint",
    "Settings",
    "Subject",
    "TrackedObject",
    "__version__",
    "behaviour",
    "connect",
]


def __getattr__(name: str) -> Any:
    """PEP 562: the public names, and `__version__`."""
    if name == "__version__":
        from importlib.metadata import version

        return version("mavlink-companion")
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_WHERE[name]), name)
