"""The image of docs/how-to/markers.md: markers of a map as the camera sees them, with outlines and axes.

python -m tools.marker_figure docs/images/markers.jpg
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import cv2

from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.annotate import annotate_markers
from vision.camera_model import CameraModel, CameraMount
from vision.markers import MarkerDetector, MarkerKind
from vision.rotation import matrix_from_euler

DICTIONARY, SIZE_M = "APRILTAG_36h11", 0.5
# North, east, down, yaw in degrees, and whether it stands.
MARKERS = (
    (2.6, -1.3, 0.0, 0.0, False),
    (2.8, 0.5, 0.0, 25.0, False),
    (4.4, -0.4, 0.0, -50.0, False),
    (4.3, 1.9, 0.0, 90.0, False),
    (6.2, -1.6, -0.7, 180.0, True),
)


def draw() -> cv2.typing.MatLike:
    """The annotated image, BGR."""
    plates = tuple(
        WorldObject(
            number,
            "plate",
            (north, east, down),
            math.radians(yaw_deg),
            printed=Print(DICTIONARY, number, SIZE_M, standing),
        )
        for number, (north, east, down, yaw_deg, standing) in enumerate(MARKERS)
    )
    camera = CameraModel.from_horizontal_fov(800, 500, math.radians(75.0))
    renderer = Renderer(World(plates, Ground(("concrete",), 4, 1024, 0.03)), camera, CameraMount())
    attitude = matrix_from_euler(math.radians(3.0), math.radians(-32.0), 0.0)
    image = renderer.render((0.0, 0.0, -2.6), attitude).image
    markers = MarkerDetector(MarkerKind(DICTIONARY, SIZE_M)).detect(image, camera)
    return annotate_markers(image, markers, camera)


def main() -> None:
    """Write the image to the file that is named."""
    path = Path(sys.argv[1])
    if not cv2.imwrite(str(path), draw(), (cv2.IMWRITE_JPEG_QUALITY, 85)):
        raise SystemExit(f"cannot write {path}")


if __name__ == "__main__":
    main()
