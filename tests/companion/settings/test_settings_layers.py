"""The layers of settings: defaults, system, user, `--config`, environment, flags."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.cli.origins import differing, origins_toml
from companion.settings.fields import fields_of_sections, toml_value
from companion.settings.layers import (
    SYSTEM_VARIABLE,
    LayeredSettings,
    SettingsFiles,
    settings_files,
    system_file,
    user_file,
)
from companion.settings.reading import ConfigurationError, load_layers, load_settings
from companion.settings.toml_text import key_lines, parse_toml

LAYERS = ("system", "user", "config", "environment", "flag")
# Keys of several types, and texts of values for each.
VALUES: dict[str, list[Any]] = {
    "detector.confidence": [0.1, 0.25, 0.9],
    "detector.threads": [1, 2, 8],
    "detector.classes": [(), ("car",), ("person", "boat")],
    "vehicle.name": ["vehicle1", "kestrel", "hawk"],
    "source.mirror": [True, False],
}


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """The paths of the files of system, user and `--config`; the last one and the folders are there."""
    monkeypatch.setenv(SYSTEM_VARIABLE, str(tmp_path / "etc" / "companion.toml"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home of anna"))
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    found = {"system": system_file(), "user": user_file(), "config": tmp_path / "config.toml"}
    for path in found.values():
        path.parent.mkdir(parents=True, exist_ok=True)
    found["config"].touch()
    return found


def layered(places: dict[str, Path], **texts: str) -> LayeredSettings:
    for layer, text in texts.items():
        places[layer].write_text(text)
    return load_layers(settings_files(places["config"]), environment={})


def test_user_file_is_in_the_configuration_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert user_file() == tmp_path / "companion" / "companion.toml"


@pytest.mark.parametrize("home", [None, "", "relative"])
def test_user_file_is_below_the_home_by_default(
    home: str | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    if home is None:
        monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    else:
        monkeypatch.setenv("XDG_CONFIG_HOME", home)
    assert user_file() == tmp_path / ".config" / "companion" / "companion.toml"


def test_files_that_are_there_are_in_force(places: dict[str, Path]) -> None:
    assert settings_files().files == ()
    places["user"].touch()
    assert settings_files().files == (places["user"],)
    places["system"].touch()
    assert settings_files(places["config"]).files == tuple(places.values())
    assert settings_files(places["config"], only_config=True).files == (places["config"],)
    assert settings_files(Path(os.devnull)).files == ()


def test_file_given_twice_is_one_layer(places: dict[str, Path], tmp_path: Path) -> None:
    places["system"].write_text("[detector]\nconfidence = 0.3\n")
    places["user"].write_text("[detector]\nconfidence = 0.5\n")
    assert settings_files(places["system"]).files == (places["user"], places["system"])
    link = tmp_path / "link.toml"
    link.symlink_to(places["system"])
    files = settings_files(link)
    assert files.files == (places["user"], link)
    assert load_layers(files, environment={}).settings.detector.confidence == 0.3


def test_missing_file_that_was_asked_for_is_an_error(places: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"none\.toml"):
        load_layers(settings_files(tmp_path / "none.toml"), environment={})


def test_dangling_link_is_an_error(places: dict[str, Path], tmp_path: Path) -> None:
    places["system"].symlink_to(tmp_path / "none.toml")
    with pytest.raises(ConfigurationError, match=str(places["system"])):
        load_layers(settings_files(), environment={})


def refuse(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Nothing below the folder may be looked at, for root too."""
    lstat = Path.lstat

    def refused(path: Path) -> os.stat_result:
        if path.is_relative_to(folder):
            raise PermissionError(13, "Permission denied", str(path))
        return lstat(path)

    monkeypatch.setattr(Path, "lstat", refused)


def test_hidden_home_has_no_file(places: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    refuse(monkeypatch, places["user"].parents[1])
    assert settings_files().files == ()


def test_hidden_folder_of_the_system_is_no_missing_file(
    places: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse(monkeypatch, places["system"].parent)
    assert settings_files().files == (places["system"],)


def test_file_without_permission_is_named_with_what_to_do(
    places: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(path: Path) -> str:
        raise PermissionError(13, "Permission denied", str(path))

    places["system"].touch()
    monkeypatch.setattr("companion.settings.reading.read_text", refused)
    with pytest.raises(ConfigurationError) as failure:
        load_layers(settings_files(), environment={})
    (line,) = failure.value.problems
    assert str(places["system"]) in line
    assert "--config /dev/null" in line
    assert load_layers(settings_files(Path("/dev/null")), environment={}).files.files == ()


def test_unreadable_file_is_an_error_with_its_name(places: dict[str, Path]) -> None:
    for layer in ("system", "user"):
        places[layer].mkdir()
        with pytest.raises(ConfigurationError) as failure:
            load_layers(settings_files(), environment={})
        assert str(places[layer]) in failure.value.problems[-1]


@pytest.mark.parametrize(
    ("user", "owner", "read"), [(0, 54321, False), (1000, 54321, False), (1000, 0, True), (1000, 1000, True)]
)
def test_file_of_another_user_is_not_read(
    user: int, owner: int, read: bool, places: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    places["user"].touch()
    stat = Path.stat

    def of_owner(path: Path, **how: Any) -> os.stat_result:
        found = stat(path, **how)
        return os.stat_result((*found[:4], owner, *found[5:]))

    monkeypatch.setattr(os, "geteuid", lambda: user)
    monkeypatch.setattr(Path, "stat", of_owner)
    files = settings_files()
    assert (files.files == (places["user"],)) is read
    if not read:
        (not_read,) = files.not_read
        assert str(places["user"]) in not_read.found
        assert str(owner) in not_read.found
        assert shlex.split(not_read.advice)[:2] == ["--config", str(places["user"])]
    assert settings_files(places["user"]) == SettingsFiles((places["user"],))


def test_file_of_the_working_folder_is_named_and_not_read(places: dict[str, Path]) -> None:
    former = Path("companion.toml")
    former.write_text("[detector]\nconfidence = 0.9\n")
    files = settings_files()
    assert files.files == ()
    (not_read,) = files.not_read
    assert str(former.resolve()) in not_read.found
    assert f"--config {former}" in not_read.advice
    assert str(places["user"]) in not_read.advice
    assert settings_files(former) == SettingsFiles((former,))
    assert not settings_files(places["config"]).not_read


def test_working_folder_may_be_that_of_the_system(
    places: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    places["system"].touch()
    monkeypatch.chdir(places["system"].parent)
    assert settings_files() == SettingsFiles((places["system"],))


def test_tables_merge_by_key_and_lists_are_replaced(places: dict[str, Path]) -> None:
    detector = layered(
        places,
        system="[detector]\nclasses = ['car', 'boat']\nthreads = 2\n",
        user="[detector]\nclasses = ['person']\n",
    ).settings.detector
    assert (detector.classes, detector.threads) == (("person",), 2)


def test_cameras_merge_by_name(places: dict[str, Path]) -> None:
    cameras = layered(
        places,
        system="[cameras.down.source]\nuri = 'down.mp4'\n[cameras.down.detector]\nenabled = false\n",
        user="[cameras.down.source]\nuri = 'other.mp4'\n",
        config="[cameras.up.source]\nuri = 'up.mp4'\n",
    ).settings.cameras
    assert {name: own.source.uri for name, own in cameras.items()} == {"down": "other.mp4", "up": "up.mp4"}
    assert not cameras["down"].detector.enabled


def test_error_names_the_file_of_each_wrong_key(places: dict[str, Path]) -> None:
    with pytest.raises(ConfigurationError) as failure:
        layered(
            places,
            system="[detector]\niou = 3.0\n[tracker]\nlost_s = 1.0\n",
            user="[detector]\nconfidence = 2.0\n",
            config="[detektor]\n",
        )
    expected = {"detector.iou": "system", "tracker.lost_s": "system", "detector.confidence": "user"}
    for key, layer in (expected | {"[detektor]": "config"}).items():
        (line,) = [line for line in failure.value.problems if key in line.partition(" (")[0]]
        assert f"in {places[layer]}" in line


def test_all_files_that_are_no_toml_are_named(places: dict[str, Path]) -> None:
    with pytest.raises(ConfigurationError) as failure:
        layered(places, system="[", user="x", config="[detector]\niou = 3.0\n")
    assert len(failure.value.problems) == 3
    assert all(str(path) in str(failure.value) for path in places.values())


def test_rule_of_two_keys_names_both_files(places: dict[str, Path]) -> None:
    with pytest.raises(ConfigurationError) as failure:
        layered(
            places,
            system="[vehicle]\nurl = 'udpin://0.0.0.0:14540'\n",
            user="[ground_station]\nurl = 'udpin://0.0.0.0:14540'\n",
        )
    (line,) = failure.value.problems
    assert f"in {places['system']}, line 2" in line
    assert f"in {places['user']}, line 2" in line


assignments = st.fixed_dictionaries(
    {
        layer: st.fixed_dictionaries({}, optional={key: st.sampled_from(VALUES[key]) for key in VALUES})
        for layer in LAYERS
    }
)


@given(assignments)
def test_highest_layer_decides_and_is_named(
    tmp_path_factory: pytest.TempPathFactory, given_by: dict[str, dict[str, Any]]
) -> None:
    folder = tmp_path_factory.mktemp("layers")
    files = []
    for layer in LAYERS[:3]:
        path = folder / f"{layer}.toml"
        tables: dict[str, list[str]] = {}
        for key, value in given_by[layer].items():
            table, _, name = key.partition(".")
            tables.setdefault(table, []).append(f"{name} = {toml_value(value)}")
        path.write_text("\n".join(f"[{table}]\n" + "\n".join(lines) for table, lines in tables.items()))
        files.append(path)
    environment = {
        f"COMPANION_{key.replace('.', '_').upper()}": text(value)
        for key, value in given_by["environment"].items()
    }
    flags = {key: text(value) for key, value in given_by["flag"].items()}
    found = load_layers(SettingsFiles(tuple(files)), flags, environment)
    rows = {row.key: row for row in differing(found)}
    for key in VALUES:
        section, _, name = key.partition(".")
        default = fields_of_sections()[section][name].default
        layers = [layer for layer in LAYERS if key in given_by[layer]]
        expected = given_by[layers[-1]][key] if layers else default
        assert getattr(getattr(found.settings, section), name) == expected
        assert (key in rows) is any(given_by[layer][key] != default for layer in layers)
        if key in rows:
            assert [value for value, _ in rows[key].given] == [given_by[layer][key] for layer in layers]
            for layer, (_, origin) in zip(layers, rows[key].given, strict=True):
                assert origin.kind == {"environment": "variable", "flag": "flag"}.get(layer, "file")
                if origin.kind == "file":
                    assert Path(origin.name).stem == layer
    # It is a settings file with the same values.
    printed = folder / "printed.toml"
    printed.write_text(origins_toml(found))
    assert load_settings(printed, environment={}) == found.settings


def text(value: Any) -> str:
    return ",".join(value) if isinstance(value, tuple) else str(value).lower()


def test_lines_of_keys_are_those_of_the_file() -> None:
    lines = [
        "# [vehicle]",
        "top = 1",
        "[detector]  # key = 1",
        'model = """',
        "[source]",
        'uri = 3"""',
        "classes = [",
        '  "a", # name = 1',
        "  [1],",
        "]",
        "  threads=2",
        '["quoted"]',
        "iou = 0.5",
        "[cameras.down.source]",
        "uri = 'x'",
        "a.b = 1",
    ]
    found = key_lines("\n".join(lines))
    parse_toml("\n".join(lines))
    expected = {"top": 2, "detector.model": 4, "detector.classes": 7, "detector.threads": 11}
    assert {key: found[key] for key in expected} == expected
    assert (found["cameras.down.source.uri"], found["cameras.down.source.a.b"]) == (15, 16)
    assert not found.keys() & {"source.uri", "detector.name", "detector.iou"}
