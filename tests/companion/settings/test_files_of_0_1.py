"""Files of version 0.1, most as it came with it, without their comments, and as its documents had them.

The errors name each key that is not read as before, with its line and what it is now.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from companion.settings.former import CHANGED, LENS, REMOVED, RENAMED
from companion.settings.layers import SettingsFiles
from companion.settings.reading import ConfigurationError, Settings, load_layers, load_settings
from companion.settings.toml_text import key_lines

FOLDER = Path(__file__).parent / "files_of_0_1"
# File → keys that are not read as before. Of two_models.toml and board.toml those below [views] too.
FIRST = ("camera.distortion", "detector.every", "guidance.max_descent_mps", "source.realtime")
TRACKER = (
    *("camera.distortion", "detector.every", "source.realtime"),
    *("tracker.camera_motion", "tracker.end_s", "tracker.high_confidence", "tracker.lost_s"),
    *("tracker.low_confidence", "tracker.true_frames", "tracker.true_score"),
)
PREVIEW = ("detector.tile_overlap", "detector.tile_size", "preview.quality")
REFUSED: dict[str, tuple[str, ...]] = {
    "first": FIRST,
    "tracker": TRACKER,
    "stabilized_camera": (*TRACKER, *PREVIEW, "camera.mount_levelled"),
    "last": (
        *TRACKER,
        *PREVIEW,
        *("camera.gimbal", "camera.mount_levelled", "detector.known_heights", "vehicle.driver"),
    ),
    "two_models": ("cameras.people.detector.every",),
    "board": (
        *(f"camera.{name}" for name in LENS if not name.startswith("distortion")),
        *("camera.gimbal", "detector.known_heights", "tracker.lost_s", "tracker.end_s"),
        *("guidance.unknown_speed_mps", "guidance.view", "cameras.down.camera.gimbal"),
        *("cameras.down.tracker.true_frames", "guidance.perception_max_age_s", "source.every_frame"),
        "vehicle.driver",
    ),
    "fence": (),
    "markers": (),
}


def own_key(key: str) -> str:
    """The key in its section: `cameras.down.detector.every` is `detector.every`."""
    return ".".join(key.split(".")[-2:])


def keys_of(tables: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tables.items():
        name = "cameras" if not before and name == "views" else name
        if isinstance(value, dict):
            yield from keys_of(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value


def value_in(settings: Settings, key: str) -> Any:
    value: Any = settings
    for word in key.split("."):
        value = value[word] if isinstance(value, dict) else getattr(value, word)
    return list(value) if isinstance(value, tuple) else value


def problems(path: Path) -> list[str]:
    try:
        load_settings(path, environment={})
    except ConfigurationError as error:
        return list(error.problems)
    return []


def test_every_file_is_in_the_table() -> None:
    assert {path.stem for path in FOLDER.iterdir()} == REFUSED.keys()


@pytest.mark.parametrize("name", REFUSED)
def test_errors_name_each_key_and_what_it_is_now(name: str) -> None:
    path = FOLDER / f"{name}.toml"
    text = path.read_text()
    lines = {key.replace("views.", "cameras."): line for key, line in key_lines(text).items()}
    found = problems(path)
    named = set()
    for key in REFUSED[name]:
        own = own_key(key)
        is_lens = own.partition(".")[2] in LENS
        (line,) = [each for each in found if key in each.partition(" (")[0].replace(",", "").split()]
        assert str(path) in line
        assert is_lens or f"line {lines[key]}" in line
        if own in RENAMED:
            table = key.rpartition(".")[0]
            assert f"{table}.{RENAMED[own].partition('.')[2]}" in line
        elif is_lens:
            assert "camera.calibration_file" in line
        elif own in REMOVED:
            assert REMOVED[own].instead in line
        elif own in CHANGED:
            assert CHANGED[own].now in line
        else:
            assert "guidance.max_descend_mps" in line
        named.add(line)
    views = [line for line in found if line.startswith("[views]")]
    assert bool(views) == ("[views." in text)
    assert set(found) == named | set(views)


@pytest.mark.parametrize("name", REFUSED)
def test_other_values_are_read_as_before(name: str, tmp_path: Path) -> None:
    text = (FOLDER / f"{name}.toml").read_text().replace("[views.", "[cameras.")
    refused = {key for key in REFUSED[name] if own_key(key) not in CHANGED}
    dropped = {line for key, line in key_lines(text).items() if key in refused}
    kept = [line for number, line in enumerate(text.split("\n"), 1) if number not in dropped]
    path = tmp_path / "kept.toml"
    path.write_text("\n".join(kept))
    settings = load_settings(path, environment={})
    values = dict(keys_of(tomllib.loads("\n".join(kept))))
    assert values
    assert {key: value_in(settings, key) for key in values} == values


def test_changed_value_is_not_named_in_a_file_of_now(tmp_path: Path) -> None:
    path = tmp_path / "now.toml"
    path.write_text("[guidance]\nperception_max_age_s = 2.0\n[vehicle]\ndriver = 'auto'\n")
    assert problems(path) == []


def test_former_key_in_one_file_leaves_the_others_alone(tmp_path: Path) -> None:
    former, now = tmp_path / "former.toml", tmp_path / "now.toml"
    former.write_text("[tracker]\nlost_s = 1.0\n")
    now.write_text("[vehicle]\ndriver = 'auto'\n")
    with pytest.raises(ConfigurationError) as failure:
        load_layers(SettingsFiles((now, former)), environment={})
    assert len(failure.value.problems) == 1
