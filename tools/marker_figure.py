"""The images of docs/how-to/markers.md: markers of a map as the camera sees them; and whose print one has.

python -m tools.marker_figure docs/images/markers.jpg docs/images/marker-prints.png
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import cv2
import numpy as np

from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.annotate import annotate_markers
from vision.camera_model import CameraModel, CameraMount
from vision.markers import PRINTS, MarkerDetector, MarkerKind, marker_modules
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


def draw_prints() -> cv2.typing.MatLike:
    """Ids 0 and 1 of each print, upright, with an arrow up."""
    module_px, margin_px = 14, 40
    plates = []
    for printed in PRINTS:
        for identifier in (0, 1):
            black = marker_modules(MarkerKind(DICTIONARY, SIZE_M, print=printed), identifier)
            cells = np.where(black, 0, 255).astype(np.uint8)
            plate = np.pad(
                np.kron(cells, np.ones((module_px, module_px), np.uint8)), margin_px, constant_values=255
            )
            middle = plate.shape[1] // 2
            cv2.arrowedLine(plate, (middle, margin_px - 6), (middle, 6), (0,), 2, cv2.LINE_AA, tipLength=0.4)
            text = f"{printed}  id {identifier}"
            (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
            where = (middle - width // 2, plate.shape[0] - 14)
            cv2.putText(plate, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0,), 1, cv2.LINE_AA)
            plates.append(plate)
    return np.hstack(plates)


def main() -> None:
    """Write the images to the files that are named."""
    markers, prints = map(Path, sys.argv[1:3])
    jpeg = (cv2.IMWRITE_JPEG_QUALITY, 85)
    for path, image, options in ((markers, draw(), jpeg), (prints, draw_prints(), ())):
        if not cv2.imwrite(str(path), image, options):
            raise SystemExit(f"cannot write {path}")


if __name__ == "__main__":
    main()
