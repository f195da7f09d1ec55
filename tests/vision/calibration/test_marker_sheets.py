"""Whose print a marker is, and printable sheets: the test draws each PDF page, and detects its markers."""

from __future__ import annotations

import math
import re

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vision.calibration.marker_sheets import marker_sheets, paper_of
from vision.camera_model import CameraModel
from vision.marker_dictionaries import DICTIONARIES
from vision.markers import Marker, MarkerDetector, MarkerKind, is_apriltag, marker_modules

# Id 0 inside its black border, upright: as AprilRobotics publishes it; 36h10 by the code in its library.
PUBLISHED = {
    "APRILTAG_16h5": ("##.#", "##..", "###.", ".#.."),
    "APRILTAG_25h9": (".#.#.", "#.#..", ".##.#", ".....", ".###."),
    "APRILTAG_36h10": ("###...", "##.#.#", ".##.##", ".#.#.#", "#..#.#", "###..."),
    "APRILTAG_36h11": ("..#.#.", "#...#.", "#..###", ".#.###", "#.#..#", "###.##"),
}
A4 = (210.0, 297.0)
PX_PER_MM = 4.0


def published(dictionary: str) -> NDArray[np.uint8]:
    """The published image of id 0, 20 pixels a module, with a white margin."""
    inner = np.array([[cell == "#" for cell in row] for row in PUBLISHED[dictionary]])
    black = np.pad(np.pad(inner, 1, constant_values=True), 2, constant_values=False)
    return np.kron(np.where(black, 0, 255), np.ones((20, 20))).astype(np.uint8)


def detected(image: NDArray[np.uint8], kind: MarkerKind) -> tuple[Marker, ...]:
    height, width = image.shape
    return MarkerDetector(kind).detect(image, CameraModel.from_horizontal_fov(width, height, 1.0))


def corner_at(marker: Marker) -> tuple[bool, bool]:
    """Whether its upper left corner is right of its centre in the image, and below it."""
    right, below = marker.corners_px[0] > marker.corners_px.mean(axis=0)
    return bool(right), bool(below)


def drawn(sheets: bytes) -> list[NDArray[np.uint8]]:
    """The filled rectangles of each page, `PX_PER_MM`."""
    text = sheets.decode("ascii")
    box = re.search(r"/MediaBox \[0 0 (\S+) (\S+)\]", text)
    assert box is not None
    width, height = (round(float(side) * 25.4 / 72.0 * PX_PER_MM) for side in box.groups())
    pages = []
    for content in re.findall(r"stream\n(.*?)\nendstream", text, re.DOTALL):
        page = np.full((height, width), 255, np.uint8)
        path: list[list[float]] = []
        for line in content.split("\n"):
            if match := re.fullmatch(r"(\S+) (\S+) (\S+) (\S+) re(?: f)?", line):
                path.append([float(value) * PX_PER_MM for value in match.groups()])
            if line.endswith("f"):
                for x, y, across, up in path:
                    page[round(height - y - up) : round(height - y), round(x) : round(x + across)] = 0
                path = []
        pages.append(page)
    return pages


@pytest.mark.parametrize("dictionary", PUBLISHED)
def test_a_published_apriltag_is_opencv_turned_by_180(dictionary: str) -> None:
    image = published(dictionary)
    for printed, corner in (("apriltag", (False, False)), ("opencv", (True, True))):
        (marker,) = detected(image, MarkerKind(dictionary, 0.5, print=printed))
        assert (marker.identifier, corner_at(marker)) == (0, corner)
    upright = marker_modules(MarkerKind(dictionary, 0.5, print="apriltag"), 0)
    assert np.array_equal(
        upright[1:-1, 1:-1], [[cell == "#" for cell in row] for row in PUBLISHED[dictionary]]
    )


def test_every_dictionary_of_apriltag_is_compared() -> None:
    families = [name for name in DICTIONARIES if is_apriltag(name)]
    assert families == sorted(PUBLISHED)
    with pytest.raises(ValueError, match=r"'apriltag' .*4X4_50"):
        MarkerKind("4X4_50", 0.5, print="apriltag")
    with pytest.raises(ValueError, match=r"opencv, apriltag,.* 'other'"):
        MarkerKind("APRILTAG_36h11", 0.5, prints={3: "other"})
    with pytest.raises(ValueError, match="marker id 587"):
        MarkerKind("APRILTAG_36h11", 0.5, prints={587: "apriltag"})


def test_a_turned_print_changes_the_rotation_alone() -> None:
    image = published("APRILTAG_36h11")
    image = np.asarray(
        cv2.warpAffine(image, np.array([[1, 0.1, 30.0], [-0.1, 1, 60]]), (400, 400), borderValue=(255,)),
        np.uint8,
    )
    (own,), (other,) = (
        detected(image, MarkerKind("APRILTAG_36h11", 0.5, prints=prints)) for prints in ({}, {0: "apriltag"})
    )
    assert own.position_camera_m == pytest.approx(other.position_camera_m, abs=1e-6)
    half_turn = own.rotation.T @ other.rotation
    assert half_turn == pytest.approx(np.diag([-1.0, -1.0, 1.0]), abs=1e-6)


@pytest.mark.parametrize("printed", ["opencv", "apriltag"])
@pytest.mark.parametrize("dictionary", ["APRILTAG_36h11", "APRILTAG_16h5"])
def test_sheets_show_each_marker_upright_in_its_size(dictionary: str, printed: str) -> None:
    kind = MarkerKind(dictionary, 0.04, {3: 0.08}, print=printed)
    pages = drawn(marker_sheets(kind, range(12), A4))
    seen = {}
    for page in pages:
        for marker in detected(page, kind):
            assert corner_at(marker) == (False, False)
            assert marker.side_px == pytest.approx(
                1000.0 * kind.size_of(marker.identifier) * PX_PER_MM, abs=1.5
            )
            seen[marker.identifier] = marker
    assert sorted(seen) == list(range(12))
    assert len(pages) == 2


def test_sheets_fill_pages_in_order_without_overlap() -> None:
    kind = MarkerKind("4X4_50", 0.03, {7: 0.1, 20: 0.015})
    pages = drawn(marker_sheets(kind, range(30), A4))
    found = [[marker.identifier for marker in detected(page, kind)] for page in pages]
    assert [identifier for page in found for identifier in page] == list(range(30))


def test_texts_name_dictionary_id_size_print_and_up() -> None:
    text = marker_sheets(MarkerKind("APRILTAG_36h11", 0.16, print="apriltag"), [5], A4).decode("ascii")
    assert "(APRILTAG_36h11 id 5 160 mm print apriltag) Tj" in text
    assert "(UP) Tj" in text
    assert "(100 mm: " in text


def test_the_file_is_a_pdf_whose_table_has_every_object() -> None:
    sheets = marker_sheets(MarkerKind("4X4_50", 0.1), range(5), A4)
    start = int(sheets.rsplit(b"startxref\n", 1)[1].split()[0])
    count = int(sheets[start:].split(b"\n")[1].split()[1])
    offsets = [int(line.split()[0]) for line in sheets[start:].split(b"\n")[3 : 2 + count]]
    assert [sheets[offset:].split()[0] for offset in offsets] == [
        b"%d" % number for number in range(1, count)
    ]
    box = re.search(rb"/MediaBox \[0 0 (\S+) (\S+)\]", sheets)
    assert box is not None
    assert [float(side) * 25.4 / 72.0 for side in box.groups()] == pytest.approx(A4, abs=0.01)


def test_papers_are_named_or_bounded_millimetres() -> None:
    assert paper_of("a4") == A4
    assert paper_of("700x1000.5") == (700.0, 1000.5)
    for text in ("A9", "10x100", "9999x100", "nanxnan", "1e3x100", ""):
        with pytest.raises(ValueError, match="WIDTHxHEIGHT"):
            paper_of(text)
    assert math.isclose(paper_of("letter")[0] / 25.4, 8.5)
