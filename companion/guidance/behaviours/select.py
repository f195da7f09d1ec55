"""Select an object in an image of a camera, for commands with `track=`. It does not fly anything."""

from __future__ import annotations

from typing import Annotated

from companion.guidance.behaviour import Behaviour
from companion.guidance.command import BuildContext, Command, GrammarError, Number, Word, behaviour
from vision.tracking import SelectRequest

FIRST_CAMERA = "first"
"""The name of the first camera in this command; it has none elsewhere."""


@behaviour("select", "select an object in an image as a track; without a rectangle: end the selection")
class Select(Command):
    x: Annotated[float | None, Number("x", "", 0.0, 1.0, "left edge, fraction of the image's width")] = None
    y: Annotated[float | None, Number("y", "", 0.0, 1.0, "upper edge, fraction of its height")] = None
    width: Annotated[float | None, Number("width", "", 0.0, 1.0, "fraction of the image's width")] = None
    height: Annotated[float | None, Number("height", "", 0.0, 1.0, "fraction of its height")] = None
    camera: Annotated[
        str | None, Word("camera", "a table of cameras, or first; without: the steering camera")
    ] = None
    stamp_ns: Annotated[
        float | None, Number("stamp_ns", "", 0.0, 2.0**63, "captured_ns of the image; without: the newest")
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        rectangle = {"x": self.x, "y": self.y, "width": self.width, "height": self.height}
        missing = [key for key, value in rectangle.items() if value is None]
        if 0 < len(missing) < len(rectangle):
            raise GrammarError(
                f"select: {', '.join(missing)} is missing; a rectangle has x, y, width, height"
            )
        if self.x is None or self.y is None or self.width is None or self.height is None:
            return
        if min(self.width, self.height) <= 0.0:
            raise GrammarError(
                f"select: width and height must be above 0, got {self.width:g}, {self.height:g}"
            )
        if self.x + self.width > 1.0 + 1e-6 or self.y + self.height > 1.0 + 1e-6:
            raise GrammarError(
                f"select: the rectangle ends at {self.x + self.width:g}, {self.y + self.height:g}, "
                "expected at most 1, 1: x, y, width and height are fractions of the image"
            )

    @property
    def request(self) -> SelectRequest:
        """The same for the tracker."""
        if self.x is None or self.y is None or self.width is None or self.height is None:
            return SelectRequest(None)
        stamp_ns = None if self.stamp_ns is None else round(self.stamp_ns)
        return SelectRequest((self.x, self.y, self.width, self.height), stamp_ns)

    def build(self, context: BuildContext) -> Behaviour:
        raise GrammarError("select: no step of a mission; send it by itself, then a command with track=")
