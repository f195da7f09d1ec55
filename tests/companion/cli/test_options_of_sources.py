"""Each viewing and recording option with each kind of source: right images, or one line and exit code 2."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import time
import zlib
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
import typer.main
from numpy.typing import NDArray

from companion.cli import app
from companion.perception.assembly import CameraTelemetry
from companion.perception.messages import (
    AnyPreview,
    Begin,
    CloudPreview,
    DepthPreview,
    Ended,
    Hud,
    Message,
    Preview,
    Report,
    Watched,
)
from companion.perception.worker import _work
from companion.recording.lossless import FrameEncoder
from companion.settings.reading import flags, load_settings
from tests.companion.command_line import companion_here
from tests.companion.source_kinds import (
    FRAMES,
    HEIGHT,
    KINDS,
    MARKER_DICTIONARY,
    MARKER_ID,
    OTHER_DEPTH_M,
    SQUARE_PX,
    WIDTH,
    Given,
    written_to_standard_input,
)
from vision.calibration_files.camera_info import write_camera_info
from vision.camera_model import CameraModel

pytestmark = pytest.mark.realtime

_MARKER = f"--markers {MARKER_DICTIONARY} --markers-size-m 0.1"
_LIMIT = 2


@dataclass(frozen=True)
class Done:
    """What a command left."""

    result: subprocess.CompletedProcess[str]
    given: Given
    folder: Path

    def frames(self, limit: int | None = None) -> set[int]:
        """How many frames it may have processed."""
        if self.given.frames is None:
            return set(range(1, _LIMIT + 1 if limit is None else limit + 1))
        return {self.given.frames if limit is None else limit}

    def lines(self) -> list[str]:
        return self.result.stdout.splitlines()


@dataclass(frozen=True)
class Row:
    """Options of one command. `check` is called where it succeeds.

    Attributes:
        options: after SOURCE; {} is the folder of the test.
        ends: the command ends by itself, also for a source without an end.
    """

    command: str
    options: str
    check: Callable[[Done], None]
    ends: bool = True
    needs_depth: bool = False
    refused: tuple[str, ...] = ()


def is_image(image: NDArray[Any] | None, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    """Check size, channels, contrast, and that the white square is where it was: at the lower right."""
    assert image is not None
    assert image.shape == (size[1], size[0], 3)
    side = SQUARE_PX * max(size) // WIDTH * 2 // 3
    assert image[-side:, -side:].mean() > 170
    assert image[-side:, :side].mean() < 110


def saved_images(folder: Path, count: set[int], size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    """Check the annotated images; the input is beside them."""
    assert len([path for path in folder.iterdir() if path.is_file()]) in count
    folder = folder / "detections"
    files = sorted(path for path in folder.iterdir() if path.is_file())
    assert len(files) in count
    for path in files:
        is_image(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), size)


def status_saves(size: tuple[int, int]) -> Callable[[Done], None]:
    def check(done: Done) -> None:
        assert len(done.lines()) in done.frames()
        saved_images(done.folder / "out", done.frames(), size)

    return check


def turned_status(done: Done) -> None:
    assert all("  front (" in line and f"{HEIGHT}x{WIDTH}" in line for line in done.lines())
    saved_images(done.folder / "out", done.frames(_LIMIT), (HEIGHT, WIDTH))


def repeated_status(done: Done) -> None:
    numbers = [int(cast(re.Match[str], re.search(r"frame (\d+),", line))[1]) for line in done.lines()]
    assert numbers == sorted(set(numbers))
    assert len(numbers) in ({FRAMES + 1} if done.given.frames else range(1, FRAMES + 2))


def depth_saves(done: Done) -> None:
    saved_images(done.folder / "out", done.frames(_LIMIT))


def depth_messages(done: Done) -> None:
    messages = [json.loads(line) for line in done.lines()]
    assert len(messages) in done.frames(_LIMIT)
    assert [message["depth"]["centre_m"] for message in messages] == [OTHER_DEPTH_M] * len(messages)
    assert all(message["depth"]["valid_share"] == 1.0 for message in messages)


def detected(done: Done) -> None:
    messages = [json.loads(line) for line in done.lines()]
    assert len(messages) in done.frames(_LIMIT)
    assert {(message["width"], message["height"]) for message in messages} == {(WIDTH, HEIGHT)}
    saved_images(done.folder / "out", {len(messages)})


def detected_every_second(done: Done) -> None:
    assert len(done.lines()) in ({FRAMES // 2} if done.given.frames else {1, 2})
    saved_images(done.folder / "out", {len(done.lines())})


def cloud_written(done: Done) -> None:
    assert (done.folder / "cloud.ply").read_bytes().startswith(b"ply\nformat binary")
    view = cv2.imread(str(done.folder / "view.png"))
    assert view is not None
    assert np.ptp(view) > 0


def cloud_as_text(done: Done) -> None:
    report = json.loads(done.result.stdout)["cloud"]
    assert report["frame"] == "ned"
    assert report["points"] > 100
    assert isinstance(report["clusters"], list)
    assert b"\nDATA ascii\n" in (done.folder / "cloud.pcd").read_bytes()


def markers_found(done: Done) -> None:
    messages = [json.loads(line) for line in done.lines()]
    assert len(messages) in done.frames(_LIMIT)
    for message in messages:
        assert [marker["id"] for marker in message["markers"]] == [MARKER_ID]
    saved_images(done.folder / "out", {len(messages)})


def mounted(done: Done) -> None:
    assert [line.partition(" = ")[0] for line in done.lines()[1:]] == [
        "mount_roll_deg",
        "mount_pitch_deg",
        "mount_yaw_deg",
    ]


_STATUS = "--model none --period 0"
_ALL = f"{_STATUS} --source-every-frame true"
_MODEL = "--model {model} --image-size 160"
ROWS = (
    Row("detect", f"{_ALL} --save {{}}/out", status_saves((WIDTH, HEIGHT)), ends=False),
    Row("detect", f"{_ALL} --save {{}}/out --grey", status_saves((WIDTH // 3, HEIGHT // 3)), ends=False),
    Row("detect", f"{_ALL} --save {{}}/out --level", status_saves((WIDTH, HEIGHT)), ends=False),
    Row(
        "detect",
        f"{_ALL} --save {{}}/out --grey --level",
        status_saves((WIDTH // 3, HEIGHT // 3)),
        ends=False,
    ),
    Row(
        "detect",
        f"{_ALL} --save {{}}/out --limit {_LIMIT} --source-rotate-deg 270 --source-mirror true "
        "--source-name front",
        turned_status,
    ),
    Row(
        "detect",
        f"{_STATUS} --source-loop true --source-rate-hz 50 --limit {FRAMES + 1}",
        repeated_status,
        refused=("depth",),
    ),
    Row("detect", f"--model none --depth --save {{}}/out --limit {_LIMIT}", depth_saves, needs_depth=True),
    Row(
        "detect",
        f"--depth --attitude 0 0 0 --json --limit {_LIMIT} {_MODEL}",
        depth_messages,
        needs_depth=True,
    ),
    Row(
        "detect",
        f"{_MODEL} --save {{}}/out --json --track --tiles --tile-size 200 --tile-overlap 0.1 "
        f"--limit {_LIMIT}",
        detected,
    ),
    Row("detect", f"{_MODEL} --save {{}}/out --every 2 --limit {FRAMES // 2}", detected_every_second),
    Row(
        "detect",
        "--model none --cloud {}/cloud.ply --cloud-view {}/view.png --cloud-frame camera",
        cloud_written,
        needs_depth=True,
    ),
    Row(
        "detect",
        "--model none --cloud {}/cloud.pcd --cloud-view {}/view.jpg --cloud-frame ned --clusters "
        "--cloud-text --json --max-range 10 --voxel 0.1 --average 4 --attitude 0 0 0",
        cloud_as_text,
        needs_depth=True,
    ),
    Row("detect", f"--model none --save {{}}/out --json --limit {_LIMIT} {_MARKER}", markers_found),
    Row(
        "calibrate mount",
        f"--marker {MARKER_ID} --size 0.1 --frames 1 --calibration {{}}/camera.yaml",
        mounted,
    ),
)

# Options of the same commands that neither show nor record, or that say what the source is.
OF_THE_DETECTOR = {"--retune", "--pull"}
OF_THE_SOURCE = {"--width", "--height"}
OF_THE_TASK = {
    "--dictionary", "--size", "--print", "--marker", "--heading", "--roll", "--pitch", "--live", "--board",
    "--square", "--name", "--output", "--calibration", "--depth-source", "--depth-calibration",
}  # fmt: skip
# Settings that are flags with short names.
OF_SETTINGS = {"--model", "--image-size", "--markers-size-m"}
# They need images of a board: tests/companion/camera_tools/test_calibrate_command.py.
WITH_A_BOARD = {
    "calibrate lens --report", "calibrate lens --every", "calibrate lens --rotate", "calibrate lens --mirror",
    "calibrate mount --rotate", "calibrate mount --mirror",
}  # fmt: skip
# Of the service's worker, below; and of its recorder, which gets messages, whatever the source is.
OF_THE_WORKER = {
    "recording.video": "video.webm", "recording.rate_hz": "20", "recording.level": "true",
    "recording.directory": "recordings", "recording.content": "png,depth",
    "preview.rate_hz": "60", "preview.width": "192",
    "preview.annotate": "true", "preview.cloud_rate_hz": "30", "preview.cloud_range_m": "10",
}  # fmt: skip
OF_THE_RECORDER = {
    "recording.max_file_mb", "recording.max_total_mb",
}  # fmt: skip
# What a source is, and how to wait for it. `source.depth` is the kind "depth".
SOURCE_ITSELF = {
    "source.uri", "source.width", "source.height", "source.pixel_format", "source.exposure_us", "source.gain",
    "source.depth", "source.depth_scale", "source.depth_calibration_file", "source.every_frame",
    "source.open_timeout_s", "source.read_timeout_s",
}  # fmt: skip


def _options(command: Any, name: str = "") -> Iterator[str]:
    """The options of the commands that read a source."""
    if hasattr(command, "commands"):
        for word, each in command.commands.items():
            yield from _options(each, f"{name} {word}".strip())
    elif not name.startswith("models") and "source" in {each.name for each in command.params}:
        for each in command.params:
            if each.param_type_name == "option" and each.name not in ("config_file", "help"):
                yield f"{name} {max(each.opts, key=len)}"


def _rows() -> set[str]:
    return {f"{row.command} {word}" for row in ROWS for word in row.options.split() if word.startswith("--")}


def test_every_option_of_a_source_has_a_row() -> None:
    elsewhere = OF_THE_DETECTOR | OF_THE_SOURCE | OF_THE_TASK | OF_SETTINGS
    found = {text for text in _options(typer.main.get_command(app)) if text.split()[-1] not in elsewhere}
    tried = {text for text in _rows() if "--source-" not in text and text.split()[-1] not in elsewhere}
    assert found == tried | WITH_A_BOARD


def test_every_setting_of_viewing_and_recording_has_a_row() -> None:
    found = {flag.key for flag in flags() if flag.key.partition(".")[0] in ("source", "recording", "preview")}
    of_preview = {f"--{key.replace('.', '-').replace('_', '-')}": key for key in found}
    tried = {key for flag, key in of_preview.items() if f"detect {flag}" in _rows()}
    assert found == tried | {"source.share"} | SOURCE_ITSELF | OF_THE_WORKER.keys() | OF_THE_RECORDER


def test_only_the_service_takes_the_option_to_share(tmp_path: Path) -> None:
    done = companion_here("detect", "a.png", "--source-share", "front", cwd=tmp_path)
    assert done.returncode == 2
    assert "--source-share" in done.stderr


class Level:
    """A vehicle that is level all the time."""

    def at(self, _stamp_ns: int) -> NDArray[np.float64]:
        return np.eye(3)


def level_vehicle() -> CameraTelemetry:
    telemetry = CameraTelemetry()
    telemetry.attitudes = cast(Any, Level())
    return telemetry


@pytest.fixture
def given(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Given]:
    with KINDS[request.param](tmp_path) as source:
        yield source


@pytest.mark.parametrize("given", KINDS, indirect=True)
@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.command} {row.options.replace('{}/', '')}")
def test_an_option_works_with_a_kind_of_source(
    row: Row,
    given: Given,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    exported_model: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kind = request.node.callspec.params["given"]
    monkeypatch.setattr(
        "companion.camera_tools.attitudes.attitudes_of",
        lambda _settings: contextlib.nullcontext(level_vehicle()),
    )
    lens = CameraModel(WIDTH, HEIGHT, 300.0, 300.0, WIDTH / 2, HEIGHT / 2)
    write_camera_info(tmp_path / "camera.yaml", lens, "camera")
    options = row.options.replace("{model}", str(exported_model)).replace("{}", str(tmp_path)).split()
    if given.frames is None and not row.ends:
        options += ["--limit", str(_LIMIT)]
    if row.command == "detect":
        options += given.flags
    with written_to_standard_input(given.standard_input):
        result = companion_here(*row.command.split(), given.uri, *options, cwd=tmp_path)
    if kind in row.refused or (row.needs_depth and not given.depth):
        assert result.returncode == 2
        (line,) = [line for line in result.stderr.splitlines() if "rendered scenes" not in line]
        assert line.startswith("companion: ")
        assert result.stdout == ""
        return
    assert result.returncode == 0, result.stderr
    row.check(Done(result, given, tmp_path))


class Messages:
    """The sender of a worker, and its control channel, which ends a source without an end."""

    def __init__(self, frames: int) -> None:
        self.stopping = self.asked = False
        self.hud = Hud(("a line",), None)
        self.watched = Watched(True, depth=True, clouds=True)
        self.selections: deque[Any] = deque()
        self.detecting = None
        self.path_request = None
        self.telemetry = level_vehicle()
        self.previews: list[AnyPreview] = []
        self.reports: list[Report] = []
        self._frames = frames

    def put(self, _message: Message) -> None:
        """Ready, and lines."""

    def put_newest(self, message: Message) -> None:
        if isinstance(message, Report):
            self.reports.append(message)
            self.stopping = self.asked = len(self.reports) == self._frames

    def put_preview(self, preview: AnyPreview) -> None:
        self.previews.append(preview)


@dataclass
class Recorder:
    """Keeps what the lossless recorder gets."""

    late: bool = False
    dropped_images: int = 0
    added: list[tuple[str, bytes]] = field(default_factory=list)

    def add(self, path: str, payload: bytes, _attachment: bytes | None) -> None:
        self.added.append((path, payload))


@pytest.mark.parametrize("turned", [False, True], ids=["upright", "turned"])
@pytest.mark.parametrize("given", KINDS, indirect=True)
def test_the_service_shows_and_records_a_kind_of_source(
    given: Given, turned: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.recording.lossless._REOPEN_S", 0.0)
    shared = f"companion-test-{os.getpid()}-{time.monotonic_ns()}"
    settings = OF_THE_WORKER | {"source.uri": given.uri, "source.share": shared, "source.rate_hz": "20"}
    settings |= {"detector.enabled": "false", "recording.video": str(tmp_path / "video.webm")}
    settings |= {key.removeprefix("--").replace("-", ".", 1): text for key, text in _pairs(given.flags)}
    size = (WIDTH, HEIGHT)
    if turned:
        settings |= {"source.rotate_deg": "270", "source.mirror": "true"}
        size = (HEIGHT, WIDTH)
    messages, recorder = Messages(FRAMES), Recorder()
    encoder = FrameEncoder({"processed": f"{shared}-recorded", "shared": shared}, recorder)
    with written_to_standard_input(given.standard_input):
        begin = Begin(load_settings(os.devnull, settings, {}), record_as=f"{shared}-recorded")
        ended = _work(begin, cast(Any, messages), cast(Any, messages))
    encoder.close()
    assert isinstance(ended, Ended)
    assert ended.finished, ended.text
    assert 1 <= ended.frames <= FRAMES  # the newest frame wins
    _check_video(tmp_path / "video.webm", size)
    width = int(OF_THE_WORKER["preview.width"])
    smaller = (width, round(size[1] * width / size[0]))
    for preview in messages.previews:
        if isinstance(preview, Preview):
            is_image(cv2.imdecode(np.frombuffer(preview.jpeg, np.uint8), cv2.IMREAD_UNCHANGED), smaller)
        elif isinstance(preview, DepthPreview):
            assert (preview.width, preview.height) == size
            assert len(zlib.decompress(preview.data)) == 2 * WIDTH * HEIGHT
        else:
            assert preview.points > 100
    of_depth = {DepthPreview, CloudPreview} if given.depth else set()
    if given.frames or messages.previews:  # others may be over before one is due
        assert {type(preview) for preview in messages.previews} == {Preview} | of_depth
    for path, png in recorder.added:
        if not path.endswith("depth_image"):
            is_image(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED), size)
    if given.frames:  # others may be over before they are read
        counts = Counter(path for path, _ in recorder.added)
        assert {"processed", "shared"} <= counts.keys()


def _pairs(options: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    return zip(options[::2], options[1::2], strict=True)


def _check_video(path: Path, size: tuple[int, int]) -> None:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    images = []
    while (read := capture.read())[0]:
        images.append(read[1])
    capture.release()
    assert images
    for image in images:
        is_image(image, size)
