"""The settings: one frozen value with a section for each part of the service.

Every key is declared once, with its default, range and one line of help; the file's comments, the flags, the
checks and their messages (`reading.py`) are derived from that declaration. Each file is named after the
package its sections are for.

The sections are imported when they are first used: those of perception load OpenCV, which a client of the bus
does not need.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from companion.settings.bus import ZenohSection
    from companion.settings.language import LanguageSection
    from companion.settings.perception import CameraSection, DetectorSection, PreviewSection, SourceSection
    from companion.settings.section import Section
    from companion.settings.settings import Settings

_MODULES = {
    "CameraSection": "perception",
    "DetectorSection": "perception",
    "LanguageSection": "language",
    "PreviewSection": "perception",
    "Section": "section",
    "Settings": "settings",
    "SourceSection": "perception",
    "ZenohSection": "bus",
}

__all__ = [
    "CameraSection",
    "DetectorSection",
    "LanguageSection",
    "PreviewSection",
    "Section",
    "Settings",
    "SourceSection",
    "ZenohSection",
]


def __getattr__(name: str) -> Any:
    """PEP 562: the sections."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"companion.settings.{_MODULES[name]}"), name)
