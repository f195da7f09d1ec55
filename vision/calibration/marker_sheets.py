"""Printable sheets of markers: PDF pages in exact size (ISO 32000-1), several markers on a page.

Each marker is inside a thin grey line to cut along: above its white margin an arrow to its upper edge, below
it dictionary, id, the side of the black square, and whose print it is. At the foot of each page is a line of
100 mm, to check the printer's scale.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from vision.markers import MarkerKind, marker_modules

# ISO 216 and ANSI; millimetres.
PAPERS = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
}
# PDF allows 14,400 points.
SMALLEST_PAPER_MM, LARGEST_PAPER_MM = 60.0, 5000.0
_POINT_MM = 25.4 / 72.0
_MARGIN_MM, _GAP_MM, _FOOT_MM = 5.0, 4.0, 12.0  # 160 mm fit on A4
# Above a marker for its arrow, below for its text; width for the text.
_ARROW_MM, _TEXT_MM, _LEAST_WIDTH_MM = 9.0, 6.0, 45.0
_LARGEST_FONT_MM, _COURIER_WIDTH = 3.2, 0.6
_RULER_MM = 100.0
_HINT = "100 mm: measure this line. Print at 100 %, without fit to page."


@dataclass(frozen=True, slots=True)
class _Plate:
    """One marker with its margins and texts. `left_mm`, `top_mm`: on its page, from the upper left."""

    identifier: int
    size_mm: float
    quiet_mm: float
    left_mm: float = 0.0
    top_mm: float = 0.0

    @property
    def width_mm(self) -> float:
        return max(self.size_mm + 2.0 * self.quiet_mm, _LEAST_WIDTH_MM)

    @property
    def height_mm(self) -> float:
        return _ARROW_MM + self.size_mm + 2.0 * self.quiet_mm + _TEXT_MM


def paper_of(text: str) -> tuple[float, float]:
    """Width and height of `A4` or `WIDTHxHEIGHT` (millimetres). Raises ValueError."""
    known = {name.lower(): size for name, size in PAPERS.items()}.get(text.lower())
    if known is not None:
        return known
    found = re.fullmatch(r"(\d{1,4}(?:\.\d+)?)x(\d{1,4}(?:\.\d+)?)", text)
    sides = (float(found[1]), float(found[2])) if found else (0.0, 0.0)
    if not all(SMALLEST_PAPER_MM <= side <= LARGEST_PAPER_MM for side in sides):
        raise ValueError(
            f"the paper must be one of {', '.join(PAPERS)}, or WIDTHxHEIGHT in millimetres "
            f"({SMALLEST_PAPER_MM:g} to {LARGEST_PAPER_MM:g}), got {text!r}"
        )
    return sides


def marker_sheets(kind: MarkerKind, identifiers: Sequence[int], paper_mm: tuple[float, float]) -> bytes:
    """A PDF file with these markers, in their order.

    Args:
        kind: dictionary, sizes and print of the markers.
        paper_mm: width and height of a page, millimetres.

    Raises:
        ValueError: an id is not in the dictionary, or a marker does not fit on the paper.
    """
    pages = [_content(kind, page, paper_mm) for page in _pages(kind, identifiers, paper_mm)]
    return _document(pages, paper_mm)


def _pages(
    kind: MarkerKind, identifiers: Sequence[int], paper_mm: tuple[float, float]
) -> Iterator[list[_Plate]]:
    """Place the markers in rows from the upper left."""
    # A micrometre for rounding.
    right_mm = paper_mm[0] - _MARGIN_MM + 1e-3
    bottom_mm = paper_mm[1] - _MARGIN_MM - _FOOT_MM + 1e-3
    page: list[_Plate] = []
    left_mm = top_mm = next_mm = _MARGIN_MM
    for identifier in identifiers:
        size_mm = 1000.0 * kind.size_of(identifier)
        plate = _Plate(identifier, size_mm, size_mm / len(marker_modules(kind, identifier)))
        if _MARGIN_MM + plate.width_mm > right_mm or _MARGIN_MM + plate.height_mm > bottom_mm:
            needed = plate.width_mm + 2 * _MARGIN_MM, plate.height_mm + 2 * _MARGIN_MM + _FOOT_MM
            raise ValueError(
                f"marker {identifier} of {size_mm:g} mm needs a paper of "
                f"{math.ceil(needed[0])}x{math.ceil(needed[1])} mm, got {paper_mm[0]:g}x{paper_mm[1]:g}: "
                "choose a larger paper or a smaller size"
            )
        if left_mm + plate.width_mm > right_mm:
            left_mm, top_mm = _MARGIN_MM, next_mm
        if top_mm + plate.height_mm > bottom_mm:
            yield page
            page, left_mm, top_mm, next_mm = [], _MARGIN_MM, _MARGIN_MM, _MARGIN_MM
        page.append(_Plate(identifier, size_mm, plate.quiet_mm, left_mm, top_mm))
        left_mm += plate.width_mm + _GAP_MM
        next_mm = max(next_mm, top_mm + plate.height_mm + _GAP_MM)
    if page:
        yield page


def _content(kind: MarkerKind, plates: Sequence[_Plate], paper_mm: tuple[float, float]) -> str:
    """The operators of one page, in millimetres from its lower left."""
    height_mm = paper_mm[1]
    lines = [f"{1.0 / _POINT_MM:.6f} 0 0 {1.0 / _POINT_MM:.6f} 0 0 cm"]
    for plate in plates:
        top_mm = height_mm - plate.top_mm
        middle_mm = plate.left_mm + plate.width_mm / 2.0
        # To cut along.
        lines.append(
            f"0.7 G 0.1 w {plate.left_mm:.3f} {top_mm - plate.height_mm:.3f} "
            f"{plate.width_mm:.3f} {plate.height_mm:.3f} re S"
        )
        lines += _arrow(middle_mm, top_mm)
        left_mm = middle_mm - plate.size_mm / 2.0
        lines += _modules(kind, plate, left_mm, top_mm - _ARROW_MM - plate.quiet_mm)
        printed = "apriltag" if kind.turned(plate.identifier) else "opencv"
        label = f"{kind.dictionary} id {plate.identifier} {plate.size_mm:g} mm print {printed}"
        font_mm = min(_LARGEST_FONT_MM, (plate.width_mm - 2.0) / (_COURIER_WIDTH * len(label)))
        start_mm = middle_mm - font_mm * _COURIER_WIDTH * len(label) / 2.0
        lines.append(_text(start_mm, top_mm - plate.height_mm + 2.0, font_mm, label))
    if paper_mm[0] >= _RULER_MM + 2.0 * _MARGIN_MM:
        lines.append(f"0 G 0.2 w {_MARGIN_MM} {_MARGIN_MM} m {_MARGIN_MM + _RULER_MM} {_MARGIN_MM} l S")
        for tick in range(11):
            x_mm = _MARGIN_MM + 10.0 * tick
            lines.append(f"{x_mm:g} {_MARGIN_MM} m {x_mm:g} {_MARGIN_MM + 2.0} l S")
        lines.append(_text(_MARGIN_MM, _MARGIN_MM + 4.0, 2.5, _HINT))
    return "\n".join(lines)


def _arrow(middle_mm: float, top_mm: float) -> list[str]:
    """An arrow to the upper edge, with the word."""
    tip, foot = top_mm - 1.5, top_mm - 8.0
    return [
        f"0 g {middle_mm:.3f} {tip:.3f} m {middle_mm - 2.0:.3f} {tip - 3.0:.3f} l "
        f"{middle_mm + 2.0:.3f} {tip - 3.0:.3f} l f",
        f"{middle_mm - 0.5:.3f} {foot:.3f} 1 {tip - 3.0 - foot:.3f} re f",
        _text(middle_mm + 4.0, top_mm - 5.5, _LARGEST_FONT_MM, "UP"),
    ]


def _modules(kind: MarkerKind, plate: _Plate, left_mm: float, top_mm: float) -> list[str]:
    """The black modules as one path, so that no seam shows between two of them."""
    black = marker_modules(kind, plate.identifier)
    side_mm = plate.size_mm / len(black)
    lines = ["0 g"]
    for row, modules in enumerate(black):
        for column, is_black in enumerate(modules):
            if is_black:
                x, y = left_mm + column * side_mm, top_mm - (row + 1) * side_mm
                lines.append(f"{x:.4f} {y:.4f} {side_mm:.4f} {side_mm:.4f} re")
    return [*lines, "f"]


def _text(x_mm: float, y_mm: float, font_mm: float, text: str) -> str:
    return f"BT 0 g /F1 {font_mm:.3f} Tf {x_mm:.3f} {y_mm:.3f} Td ({text}) Tj ET"


def _document(pages: Sequence[str], paper_mm: tuple[float, float]) -> bytes:
    """A PDF file of these pages, whose texts are Courier."""
    width, height = (side / _POINT_MM for side in paper_mm)
    kids = " ".join(f"{4 + 2 * page} 0 R" for page in range(len(pages)))
    objects = [
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} /MediaBox [0 0 {width:.3f} {height:.3f}] >>",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Courier >>",
    ]
    for page, content in enumerate(pages):
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /Contents {5 + 2 * page} 0 R "
            "/Resources << /Font << /F1 3 0 R >> >> >>"
        )
        objects.append(f"<< /Length {len(content)} >>\nstream\n{content}\nendstream")
    body, offsets = "%PDF-1.4\n", []
    for number, text in enumerate(objects, start=1):
        offsets.append(len(body))
        body += f"{number} 0 obj\n{text}\nendobj\n"
    entries = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    body += (
        f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{entries}"
        f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(body)}\n%%EOF\n"
    )
    return body.encode("ascii")
