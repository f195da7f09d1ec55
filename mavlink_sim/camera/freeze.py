"""What of a simulated camera is frozen: it repeats its last image with new stamps (docs/faults.md)."""

from __future__ import annotations

from enum import IntFlag


class CameraFreeze(IntFlag):
    """The frozen parts of a camera. `CLOCK`: a clock in the image goes on, so images differ."""

    NOTHING = 0
    IMAGE = 1
    DEPTH = 2
    CLOCK = 4
