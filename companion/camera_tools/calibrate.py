"""`companion calibrate`: collect views of a board from a source, and report on a calibration."""

from __future__ import annotations

import html
import json
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.bus.topics import VEHICLE
from vision.attitude import euler_from_quaternion
from vision.calibration.boards import Board, BoardView
from vision.calibration.calibrate import CalibrationError, CalibrationResult
from vision.calibration.extrinsics import Extrinsics
from vision.calibration.seen_boards import FAMILIES, SeenBoard, contradiction, described, seen_board
from vision.calibration.views import EDGES, ViewCollector
from vision.camera_model import CameraModel, pixels_without_rays, scaled_to_frames
from vision.frame import Frame
from vision.image_file import decode
from vision.markers import Marker, MarkerDetector, MarkerKind
from vision.sources import EndOfStream, Source
from vision.sources.files import images_in
from vision.sources.paired import TOLERANCE_S

Image = NDArray[np.uint8]
Tilt = tuple[float, float]
"""Roll and pitch of the vehicle, radians."""

# Images whose board is compared with the given one; of a live source without it, at each so many frames.
_LOOKED_AT, _LIVE_LOOK = 5, 30
# Images of the report are at most so wide.
_WIDTH = 640
# A live source without the marker gives a line each so many seconds.
_MISSING_S = 3.0
# Residuals are drawn longer by this factor.
_ENLARGED = 100
_GREEN, _RED, _GREY = (60, 160, 40), (40, 40, 220), (200, 200, 200)


@dataclass(slots=True)
class Collected:
    """Views of a source.

    Attributes:
        collector: with the views that differ.
        frames, found: numbers of processed frames, and of those with the board.
        images: name → the view's image, small, as JPEG.
        others: name → the second camera's view at the same time.
        legacy: number of frames whose ChArUco board is as OpenCV drew them before 4.6.
        without: the last images without the board. boards: the ChArUco boards that were seen.
    """

    collector: ViewCollector
    frames: int = 0
    found: int = 0
    images: dict[str, bytes] = field(default_factory=dict)
    others: dict[str, BoardView] = field(default_factory=dict)
    legacy: int = 0
    without: deque[Image] = field(default_factory=lambda: deque(maxlen=_LOOKED_AT))
    boards: list[SeenBoard] = field(default_factory=list)

    @property
    def pairs(self) -> list[tuple[BoardView, BoardView]]:
        """The chosen views of both cameras."""
        return [(view, self.others[view.name]) for view in self.collector.chosen()]


def collect_views(
    source: Source,
    board: Board,
    write: Callable[[str], None],
    every: int = 1,
    second: Source | None = None,
) -> Collected:
    """Collect views from every `every`-th frame; a live source until nothing is missing, or Ctrl-C.

    Args:
        write: called with a line on what is missing, for each new view of a live source.
        second: another camera: both must see the board at the same time.

    Raises:
        CalibrationError: no frame shows the board, or it is another one than the given one.
        ValueError: the images differ in size, or one source is live and the other is not.
    """
    collected = Collected(ViewCollector(board, whole_image=second is None))
    folder = Path(source.uri)
    names = [path.name for path in images_in(folder)] if folder.is_dir() else []
    if source.live:
        write(f"show {described(board)} to the camera; Ctrl-C ends")
    try:
        for frame, other in ((each, None) for each in source) if second is None else _pairs(source, second):
            if frame.sequence % every and not source.live:
                continue
            name = names[frame.sequence] if frame.sequence < len(names) else f"frame {frame.sequence}"
            new = _process(frame, other, name, board, collected)
            if source.live and not collected.found and collected.frames % _LIVE_LOOK == 0:
                _check_board(collected, board)
            if new and source.live:
                missing = collected.collector.missing()
                views = len(collected.collector.views)
                write(f"{views} views; missing: {'; '.join(missing) or 'nothing'}")
                if not missing:
                    break
    except KeyboardInterrupt:
        if not source.live:
            raise
    _check_board(collected, board)
    if not collected.collector.views:
        images = "images" if second is None else f"pairs of images with {second.uri}"
        raise CalibrationError(
            f"{source.uri}: no board in any of {collected.frames} {images}; looked for {described(board)}"
        )
    return collected


def markers_of(
    source: Source,
    kind: MarkerKind,
    identifier: int,
    model: CameraModel | None,
    limit: int,
    write: Callable[[str], None],
    tilt: Callable[[], Tilt | None] = lambda: (0.0, 0.0),
) -> tuple[list[Marker], list[Tilt]]:
    """The marker in the frames of a source, at most `limit` times, and the vehicle's tilt at each.

    Ctrl-C ends a live source.

    Args:
        model: the lens; None: the source's own.
        tilt: of the vehicle at present; None: unknown, the frame is not used.
        write: called with a line at the start of a live source, and while the marker is not seen.

    Raises:
        CalibrationError: the lens is not known.
        ValueError: the lens is of another aspect than the frames.
    """
    if model is None:
        if source.calibration is None:
            raise CalibrationError(f"{source.uri} has no calibration of its own: give --calibration FILE")
        model = source.calibration.model
    detector = MarkerDetector(kind)
    found: list[Marker] = []
    tilts: list[Tilt] = []
    if source.live:
        write(f"show marker {identifier} to the camera; Ctrl-C ends")
    others: set[int] = set()
    due_s = time.monotonic() + _MISSING_S
    try:
        for frame in source:
            lens = scaled_to_frames(model, frame.width, frame.height)
            seen = detector.detect(frame.image, lens)
            own = [each for each in seen if each.identifier == identifier]
            others |= {each.identifier for each in seen}
            present = tilt()
            if own and present is not None:
                found += own
                tilts += [present] * len(own)
                due_s, others = time.monotonic() + _MISSING_S, set()
            elif source.live and time.monotonic() >= due_s:
                names = ", ".join(map(str, sorted(others))) or "no marker"
                write(
                    f"marker {identifier} not seen; seen: {names}"
                    if present is not None
                    else "no attitude received from the vehicle"
                )
                due_s, others = time.monotonic() + _MISSING_S, set()
            if len(found) >= limit:
                break
    except KeyboardInterrupt:
        if not source.live:
            raise
    return found, tilts


class LiveTilt:
    """The vehicle's tilt from its service's `vehicle` messages."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._newest: tuple[float, Tilt] | None = None

    def on_message(self, _key: str, text: str) -> None:
        """Process a message of topic `vehicle`, on any thread."""
        attitude = json.loads(text)["attitude_wxyz"]
        if attitude is not None:
            roll, pitch, _ = euler_from_quaternion(tuple(attitude))
            self._newest = self._clock_s(), (roll, pitch)

    def __call__(self) -> Tilt | None:
        """Roll and pitch, radians; None if none was received within the topic's maximum age."""
        newest, limit_s = self._newest, VEHICLE.max_age_s
        assert limit_s is not None
        return None if newest is None or self._clock_s() - newest[0] > limit_s else newest[1]


def _pairs(first: Source, second: Source) -> Iterator[tuple[Frame, Frame]]:
    """The frames of two sources at the same times."""
    if first.live != second.live:
        live, recorded = (first, second) if first.live else (second, first)
        raise ValueError(f"{live.uri} is live and {recorded.uri} is not: they have no common time")
    one: Frame | None = None
    two: Frame | None = None
    while True:
        try:
            one = one or first.read()
            two = two or second.read()
        except EndOfStream:
            return
        if one is None or two is None:
            continue
        gap_s = (one.captured_ns - two.captured_ns) / 1e9
        if not first.live:
            gap_s = (one.media_s or 0.0) - (two.media_s or 0.0)
        if abs(gap_s) <= TOLERANCE_S:
            yield one, two
            one = two = None
        elif gap_s < 0.0:
            one = None
        else:
            two = None


def _process(frame: Frame, other: Frame | None, name: str, board: Board, collected: Collected) -> bool:
    """Add the board of a frame, if it has one (and the other one); returns whether its view is new."""
    collected.frames += 1
    view = board.detect(frame.image, name)
    second = None if view is None or other is None else board.detect(other.image, name)
    if view is None or (other is not None and second is None):
        grey = frame.image if frame.image.ndim == 2 else cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        collected.without.append(np.array(grey))
        return False
    collected.found += 1
    collected.legacy += view.legacy
    if board.dictionary is not None and len(collected.boards) < _LOOKED_AT:
        seen = seen_board(frame.image, (board.dictionary,))
        collected.boards += [] if seen is None else [seen]
    if not collected.collector.add(view):
        return False
    if second is not None:
        collected.others[name] = second
    small, _ = _small(frame.image)
    collected.images[name] = cv2.imencode(".jpg", small, (cv2.IMWRITE_JPEG_QUALITY, 90))[1].tobytes()
    return True


def _check_board(collected: Collected, board: Board) -> None:
    """Compare the board of the images with the given one. Raises CalibrationError: it is another one."""
    if not collected.found:
        dictionaries = dict.fromkeys((board.dictionary or FAMILIES[0], *FAMILIES))
        found = (seen_board(image, dictionaries) for image in collected.without)
        collected.boards += [each for each in found if each is not None]
        if board.kind == "chessboard" and not collected.boards and min(board.columns, board.rows) > 3:
            # Squares are often counted in place of the inner corners.
            inner = Board(board.kind, board.columns - 1, board.rows - 1, board.square_m)
            if any(inner.detect(image) is not None for image in collected.without):
                raise CalibrationError(f"the images show {described(inner)}; looked for {described(board)}")
        collected.without.clear()
    if (why := contradiction(board, collected.boards)) is not None:
        raise CalibrationError(why)


def result_lines(result: CalibrationResult) -> list[str]:
    """The calibration in words: the lens, its errors, and why this distortion model."""
    model, sigmas = result.model, result.fit.sigmas
    held_out = ", ".join(f"{kind} {error:.3f}" for kind, error in result.held_out_px.items())
    return [
        f"{len(result.views)} views, {model.width}x{model.height}, {model.distortion_model}",
        f"fx {model.fx:.2f} +- {sigmas[0]:.2f}, fy {model.fy:.2f} +- {sigmas[1]:.2f}, "
        f"cx {model.cx:.2f} +- {sigmas[2]:.2f}, cy {model.cy:.2f} +- {sigmas[3]:.2f} px (one sigma)",
        f"distortion {', '.join(f'{value:.5f}' for value in model.coefficients)}",
        f"reprojection {result.rms_px:.3f} px RMS; on held-out views: {held_out}",
        *filter(None, (pixels_without_rays(model),)),
    ]


def extrinsics_lines(result: Extrinsics) -> list[str]:
    """The depth camera's place in words, and its errors."""
    calibration = result.calibration
    turn = np.degrees(np.linalg.norm(cv2.Rodrigues(calibration.rotation)[0]))
    right, down, ahead = (calibration.position_m * 1000).tolist()
    return [
        f"{result.views} views that both cameras see, reprojection {result.rms_px:.3f} px RMS",
        f"depth camera at {right:.1f} mm right, {down:.1f} down, {ahead:.1f} ahead of the colour camera, "
        f"+- {result.position_sigma_m * 1000:.2f} (one sigma)",
        f"turned by {turn:.3f} degrees, +- {math.degrees(result.rotation_sigma_rad):.4f}",
    ]


def write_report(folder: Path, result: CalibrationResult, collected: Collected) -> Path:
    """Write `index.html` with its images; returns its path.

    Raises:
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _save(folder / "corners.png", _corners_image(result))
    largest = max(result.views, key=lambda view: float(np.ptp(view.corners_px, axis=0).prod()))
    original = decode(collected.images[largest.name]).pixels
    _save(folder / "undistorted.jpg", np.hstack([original, undistorted(original, result.model)]))
    rows = []
    views = [
        *((view, error, False) for view, error in zip(result.views, result.fit.view_rms_px, strict=True)),
        *((view, error, True) for view, error in result.rejected),
    ]
    for number, (view, error, rejected) in enumerate(sorted(views, key=lambda item: -item[1])):
        file = f"view{number:02d}.jpg"
        _save(folder / file, _view_image(decode(collected.images[view.name]).pixels, view, rejected))
        name = html.escape(view.name) + (" (rejected)" if rejected else "")
        rows.append(
            f'<tr><td><img src="{file}" width="240"></td><td>{name}</td>'
            f"<td>{len(view.points_m)}</td><td>{error:.3f}</td></tr>"
        )
    missing = collected.collector.missing()
    page = _PAGE.format(
        lines="".join(f"<li>{html.escape(line)}</li>" for line in result_lines(result)),
        missing=html.escape("; ".join(missing) or "nothing"),
        enlarged=_ENLARGED,
        rows="\n".join(rows),
    )
    (path := folder / "index.html").write_text(page, "utf-8")
    return path


_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Camera calibration</title>
<style>
body {{ font: 15px sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em }}
img {{ max-width: 100%; display: block }}
td, th {{ text-align: left; padding: 0.2em 1em 0.2em 0 }}
</style>
<h1>Camera calibration</h1>
<ul>{lines}</ul>
<p>Missing for a complete set of views: {missing}.</p>
<h2>Corners in the image</h2>
<p>Each dot is a corner, each line its reprojection error, {enlarged} times as long.</p>
<img src="corners.png" alt="All corners, and their errors">
<h2>As photographed, and undistorted</h2>
<img src="undistorted.jpg" alt="The largest view, before and after">
<h2>Views, the worst first</h2>
<table><tr><th></th><th>view</th><th>corners</th><th>error, px RMS</th></tr>
{rows}
</table></html>
"""


def undistorted(image: Image, model: CameraModel) -> Image:
    """The image as an ideal pinhole camera of the same size and focal length shows it."""
    height, width = image.shape[:2]
    lens = model.scaled(width, height)
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    ideal = CameraModel(width, height, lens.fx, lens.fy, lens.cx, lens.cy)
    pixels = lens.project(ideal.rays(np.column_stack([columns.ravel(), rows.ravel()])))
    map_x, map_y = np.moveaxis(pixels.astype(np.float32).reshape(height, width, 2), -1, 0)
    return np.asarray(cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR), np.uint8)


def _corners_image(result: CalibrationResult) -> Image:
    model = result.model
    scale = max(1.0, _WIDTH * 1.5 / model.width)
    width, height = round(model.width * scale), round(model.height * scale)
    image = np.full((height, width, 3), 255, np.uint8)
    for edge in EDGES:
        column, row = round(width * edge), round(height * edge)
        cv2.line(image, (column, 0), (column, height), _GREY)
        cv2.line(image, (0, row), (width, row), _GREY)
    for view, residuals in zip(result.views, result.fit.residuals_px, strict=True):
        for corner, residual in zip(view.corners_px * scale, residuals * _ENLARGED, strict=True):
            cv2.line(image, _pixel(corner), _pixel(corner + residual), _GREEN, 1, cv2.LINE_AA)
            cv2.circle(image, _pixel(corner), 2, _RED, -1, cv2.LINE_AA)
    return image


def _view_image(image: Image, view: BoardView, rejected: bool) -> Image:
    scale = image.shape[1] / view.size[0]
    for corner in view.corners_px * scale:
        cv2.circle(image, _pixel(corner), 4, _RED if rejected else _GREEN, 1, cv2.LINE_AA)
    return image


def _pixel(point: NDArray[np.float64]) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))


def _small(image: Image) -> tuple[Image, float]:
    """An image of at most the report's width, and the scale."""
    scale = min(1.0, _WIDTH / image.shape[1])
    if scale == 1.0:
        return image, scale
    return np.asarray(
        cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
    ), scale


def _save(path: Path, image: Image) -> None:
    if not cv2.imwrite(str(path), image, (cv2.IMWRITE_JPEG_QUALITY, 85)):
        raise OSError(f"cannot write {path}: check free disk space and write permission")
