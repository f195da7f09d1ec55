"""The settings: one frozen value with a section for each part of the service.

Every key is declared once, with its default, range and one line of help; the file's comments, the flags, the
checks and their messages (`reading.py`) are derived from that declaration. Each file is named after the
package its sections are for.
"""

from companion.settings.bus import ZenohSection
from companion.settings.perception import CameraSection, DetectorSection, PreviewSection, SourceSection
from companion.settings.section import Section
from companion.settings.settings import Settings

__all__ = [
    "CameraSection",
    "DetectorSection",
    "PreviewSection",
    "Section",
    "Settings",
    "SourceSection",
    "ZenohSection",
]
