"""TOML texts of others: valid ones, and those that take long or break the parser."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance.missions.mission_file import MissionError, plan_from
from companion.settings.marker_files import BoardError, read_boards, read_map
from companion.settings.reading import ConfigurationError, load_settings
from companion.settings.toml_text import MAX_KEY_PARTS, parse_toml
from mavlink_sim.camera.scene_file import SceneError, parse_scene

SIZE = 100_000
HOSTILE = {
    "deep array": "a=" + "[" * SIZE,
    "deep table": "a=" + "{a=" * (SIZE // 3),
    "dotted key": "a" + ".a" * (SIZE // 2) + "=1",
    "dotted key with spaces": "a" + " . a" * (SIZE // 4) + "=1",
    "quoted dotted key": '"".' * (SIZE // 3) + "a=1",
    "dotted header": "[" + ".".join(["a"] * (SIZE // 2)) + "]",
    "digits": "a=" + "9" * SIZE,
    "date": "a=2020-99-99",
    "string without an end": 'a="' + '\\"' * (SIZE // 2),
    "quotes": '"""' * (SIZE // 3),
    "null byte": "a=\0",
}


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE)
def test_hostile_toml_is_one_error_at_once(text: str) -> None:
    with pytest.raises(tomllib.TOMLDecodeError) as caught:
        parse_toml(text)  # a dotted key of this size took 200 s
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200


@given(st.text(alphabet="ab.\"'\n#=[]{}, \\1", max_size=60))
def test_every_text_is_read_as_by_tomllib(text: str) -> None:
    try:
        expected = tomllib.loads(text)
    except ValueError:
        with pytest.raises(tomllib.TOMLDecodeError):
            parse_toml(text)
        return
    assert parse_toml(text) == expected


def test_dots_in_strings_numbers_and_comments_are_no_key() -> None:
    words = ".".join(["a"] * 100)
    text = f'x = "{words}"\ny = \'{words}\'\nz = """{words}"""\n# {words}\nf = [{"1.5, " * 100}]\n'
    assert parse_toml(text)["x"] == words
    assert parse_toml(".".join(["a"] * MAX_KEY_PARTS) + "=1")


@pytest.mark.parametrize("text", [HOSTILE["deep array"], HOSTILE["digits"]], ids=["deep", "digits"])
def test_every_reader_of_toml_names_the_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "deep.toml"
    path.write_text(text)
    readers: list[tuple[Callable[[], object], type[Exception]]] = [
        (lambda: plan_from(text, str(path)), MissionError),
        (lambda: read_boards(path), BoardError),
        (lambda: read_map(path), BoardError),
        (lambda: load_settings(path), ConfigurationError),
        (lambda: parse_scene(text, str(path)), SceneError),
    ]
    for read, error in readers:
        with pytest.raises(error) as caught:
            read()
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
