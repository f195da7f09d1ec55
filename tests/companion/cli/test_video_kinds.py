"""Videos of every kind, written by FFmpeg: each frame in order, or one line that says why there are none."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import imageio_ffmpeg  # type: ignore[import-untyped]
import numpy as np
import pytest

from tests.companion.command_line import companion_here
from vision.sources import open_source

_IMAGES = ("-f", "lavfi", "-i", "testsrc=size=64x48:rate=25:duration=0.4")
_SOUND = ("-f", "lavfi", "-i", "sine=duration=0.4")
_VARIABLE = "setpts='if(lt(N,5),N/25,0.2+(N-5)/5)/TB'"


def written(path: Path, *arguments: str) -> Path:
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", *arguments, str(path)]
    subprocess.run(command, check=True)
    return path


# Name of the file → FFmpeg's arguments; number of frames, height and width, media time of the last one.
READ: dict[str, tuple[tuple[str, ...], tuple[int, int, int, float]]] = {
    "plain.mp4": ((*_IMAGES, "-pix_fmt", "yuv420p"), (10, 48, 64, 0.36)),
    "fragments.mp4": ((*_IMAGES, "-movflags", "frag_keyframe+empty_moov"), (10, 48, 64, 0.36)),
    "sound_first.mp4": ((*_SOUND, *_IMAGES, "-map", "0", "-map", "1"), (10, 48, 64, 0.36)),
    "one_frame.mp4": ((*_IMAGES, "-frames:v", "1"), (1, 48, 64, 0.0)),
    "odd_size.avi": (
        ("-f", "lavfi", "-i", "testsrc=size=65x49:rate=25:duration=0.4", "-c:v", "mjpeg"),
        (10, 49, 65, 0.36),
    ),
    "ten_bits.mkv": ((*_IMAGES, "-c:v", "ffv1", "-pix_fmt", "yuv420p10le"), (10, 48, 64, 0.36)),
    "alpha.webm": ((*_IMAGES, "-c:v", "libvpx-vp9", "-pix_fmt", "yuva420p"), (10, 48, 64, 0.36)),
    "variable.mp4": ((*_IMAGES, "-vf", _VARIABLE, "-fps_mode", "vfr"), (10, 48, 64, 1.0)),
    "animated.gif": (_IMAGES, (10, 48, 64, 0.36)),
}


@pytest.mark.parametrize("name", READ)
def test_every_frame_of_a_video_is_read(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    arguments, (count, height, width, end_s) = READ[name]
    with open_source(str(written(tmp_path / name, *arguments))) as source:
        frames = list(source)
    assert [frame.image.shape for frame in frames] == [(height, width, 3)] * count
    assert all(np.ptp(frame.image) > 200 for frame in frames)
    assert frames[-1].media_s == pytest.approx(end_s, abs=0.045)
    assert caplog.text == ""


def test_rotation_that_a_video_states_is_applied(tmp_path: Path) -> None:
    plain = written(tmp_path / "plain.mp4", *READ["plain.mp4"][0])
    turned = written(tmp_path / "turned.mp4", "-display_rotation", "90", "-i", str(plain), "-c", "copy")
    with open_source(str(turned)) as source:
        assert {frame.image.shape for frame in source} == {(64, 48, 3)}


def _without(data: bytes, part: bytes) -> bytes:
    return data[: data.rfind(part) - 4]


# Name of the file → FFmpeg's arguments, what is done to the file, a word of the line.
REFUSED: dict[str, tuple[tuple[str, ...], Callable[[bytes], bytes], str]] = {
    "no_index.mp4": (READ["plain.mp4"][0], lambda data: _without(data, b"moov"), "moov"),
    "sound.mp4": (_SOUND, bytes, "sound"),
    "sound.mkv": (_SOUND, bytes, "sound"),
    "sound.wav": (_SOUND, bytes, "WAV"),
    "no_frames.mp4": ((*_IMAGES, "-frames:v", "0"), bytes, "without frames"),
    "only_index.mp4": (
        (*_IMAGES, "-movflags", "+faststart"),
        lambda data: data[: data.find(b"mdat") + 4],
        "truncated",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_video_without_frames_is_one_line(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments, changed, word = REFUSED[name]
    path = written(tmp_path / name, *arguments)
    path.write_bytes(changed(path.read_bytes()))
    for model in ("default", "none"):
        done = companion_here("detect", name, "--model", model, cwd=tmp_path)
        assert done.returncode == 2
        (line,) = done.stderr.splitlines()
        assert name in line
        assert word in line
    assert capfd.readouterr().err == ""


def test_video_cut_in_the_middle_says_how_many_frames_came(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = written(tmp_path / "cut.avi", *_IMAGES, "-c:v", "mjpeg")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    with open_source(str(path)) as source:
        count = len(list(source))
    assert 0 < count < 10
    assert f" {count} frames" in caplog.text
    assert " 10" in caplog.text
