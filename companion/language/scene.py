"""What the operator's sentences refer to: objects in view, and the vehicle's own pose."""

from __future__ import annotations

from dataclasses import dataclass

from companion.guidance.command import Command


@dataclass(frozen=True, slots=True)
class SceneObject:
    """One object in the newest frame.

    Attributes:
        colour: of `vision.colour.COLOURS`; None: not known.
        range_m: horizontal distance. bearing_deg: from the nose, positive to the right.
    """

    class_name: str
    track_id: int | None = None
    colour: str | None = None
    range_m: float | None = None
    bearing_deg: float | None = None

    def __str__(self) -> str:
        words = [] if self.colour is None else [self.colour]
        words.append(self.class_name)
        if self.track_id is not None:
            words.append(f"(track {self.track_id})")
        if self.range_m is not None:
            words.append(f"{self.range_m:.0f} m away")
        if self.bearing_deg is not None:
            side = "right" if self.bearing_deg > 0 else "left"
            ahead = abs(self.bearing_deg) < 5
            words.append("ahead" if ahead else f"{abs(self.bearing_deg):.0f} deg to the {side}")
        return " ".join(words)


@dataclass(frozen=True, slots=True)
class Scene:
    """The newest state of one vehicle and its steering camera.

    Attributes:
        class_names: the detector's.
        yaw_rad: heading, clockwise from north. altitude_m: above home. None: not known.
        fault: why no detections were received, so that no objects are known; None: they were.
        last: the newest command of the conversation; "it" and "twice as far" refer to it.
    """

    class_names: tuple[str, ...]
    objects: tuple[SceneObject, ...] = ()
    yaw_rad: float | None = None
    altitude_m: float | None = None
    fault: str | None = None
    last: Command | None = None
