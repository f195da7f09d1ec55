from __future__ import annotations

import errno
import math
import os
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.settings.former import LENS, REMOVED, RENAMED, VERSION, without_removed
from companion.settings.reading import (
    ConfigurationError,
    Settings,
    changed,
    flags,
    load_settings,
    to_toml,
    unknown_variables,
)
from vision.calibration_files.camera_info import read_camera_info, write_camera_info
from vision.camera_model import CameraModel
from vision.detector import DEFAULT_MODEL

REPOSITORY = Path(__file__).resolve().parents[3]


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def problems(
    path: Path | None = None, overrides: dict[str, str] | None = None, **environment: str
) -> list[str]:
    with pytest.raises(ConfigurationError) as caught:
        load_settings(path, overrides, environment)
    assert str(caught.value) == "\n".join(caught.value.problems)
    return list(caught.value.problems)


def test_without_a_file_the_defaults_are_in_effect() -> None:
    assert load_settings(environment={}) == Settings()


def test_variable_of_a_section_with_an_underscore_is_read() -> None:
    url = "udpout://10.0.0.2:14550"
    assert load_settings(environment={"COMPANION_GROUND_STATION_URL": url}).ground_station.url == url


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"ground_station.url": "10.0.0.2:14550"}, ["ground_station.url", "udpout://"]),
        (
            {"ground_station.url": "udpin://0.0.0.0:14540", "vehicle.url": "udpin://0.0.0.0:14540"},
            ["ground_station.url and vehicle.url", "opened once"],
        ),
        (
            {"ground_station.url": "udpout://10.0.0.2:14550"}
            | {f"cameras.c{number}.source.uri": f"file{number}.mp4" for number in range(6)},
            ["ground_station.url", "6 cameras, got 7"],
        ),
    ],
)
def test_ground_station_that_cannot_be_is_refused(values: dict[str, str], words: list[str]) -> None:
    (line,) = problems(overrides=values)
    assert all(word in line for word in words), line


def test_precedence_is_flags_environment_file(tmp_path: Path) -> None:
    path = written(
        tmp_path / "c.toml", "[detector]\nconfidence = 0.1\niou = 0.1\nthreads = 3\n[source]\nuri = 'a.mp4'\n"
    )
    settings = load_settings(
        path,
        {"detector.confidence": "0.3"},
        {
            "COMPANION_DETECTOR_CONFIDENCE": "0.2",
            "COMPANION_DETECTOR_IOU": "0.2",
            "COMPANION_TEST_DATA": "/x",
        },
    )
    assert (settings.detector.confidence, settings.detector.iou, settings.detector.threads) == (0.3, 0.2, 3)
    assert settings.source.uri == "a.mp4"


def test_every_flag_accepts_its_default_as_text() -> None:
    overrides = {}
    for flag in flags():
        value = flag.default
        if value is None:
            text = ""
        elif flag.type is tuple:
            text = ",".join(map(str, value))
        else:
            text = str(value).lower() if flag.type is bool else str(value)
        overrides[flag.key] = text
        assert isinstance(value, flag.type) or value is None
        assert flag.help, flag.key
        assert "\n" not in flag.help
    assert load_settings(REPOSITORY / "systemd/companion.toml", overrides, {}) == Settings()


def test_lists_booleans_and_unset_values_are_read_from_text() -> None:
    settings = load_settings(
        REPOSITORY / "systemd/companion.toml",
        {
            "detector.classes": "person, 2,car",
            "source.loop": "Yes",
            "detector.enabled": "off",
            "detector.threads": "none",
            "source.width": "640",
            "zenoh.connect": "tcp/10.0.0.1:7447,udp/[::1]:7447",
        },
        {},
    )
    assert settings.detector.classes == ("person", 2, "car")
    assert settings.source.loop is True
    assert settings.detector.enabled is False
    assert settings.detector.threads is None
    assert settings.source.width == 640
    assert settings.zenoh.connect == ("tcp/10.0.0.1:7447", "udp/[::1]:7447")


@pytest.mark.parametrize(
    ("key", "text", "words"),
    [
        ("detector.confidence", "1.7", ["0 to 1", "got 1.7"]),
        ("detector.confidence", "nan", ["0 to 1", "got nan"]),
        ("detector.confidence", "high", ["0 to 1", "got 'high'"]),
        ("detector.image_size", "330", ["whole number", "32 to 4096", "multiple of 32", "got 330"]),
        ("detector.image_size", "64.5", ["whole number", "32 to 4096", "got '64.5'"]),
        ("tracker.coast_timeout_s", "0", ["above 0", "at most 60", "got 0.0"]),
        ("detector.precision", "int8", ["auto, float32, bfloat16 or float16", 'got "int8"']),
        ("source.loop", "maybe", ["true or false", "got 'maybe'"]),
        ("source.uri", "", ["not empty", 'got ""']),
        ("source.width", "3", ["16 to 16384", "unset", "got 3"]),
        ("guidance.max_horizontal_speed_mps", "0", ["above 0", "at most 30", "got 0.0"]),
        ("camera.horizontal_fov_deg", "180", ["above 1", "below 179", "got 180.0"]),
        ("vehicle.name", "a/*", ["`_`, `-` and `.`", 'got "a/*"']),
        (
            "vehicle.url",
            "/dev/ttyS0",
            ["udpin://HOST:PORT, udpout://HOST:PORT", "serial://DEVICE:BAUD or none", 'got "/dev/ttyS0"'],
        ),
        (
            "detector.class_heights_m",
            "person=1.7",
            ["CLASS:METRES", "person:1.7", 'got ["person=1.7"]'],
        ),
        (
            "zenoh.listen",
            "localhost,7447",
            ["zenoh endpoint", "tcp/192.168.1.5:7447", 'got ["localhost", "7447"]'],
        ),
    ],
)
def test_bad_value_has_key_range_and_value(key: str, text: str, words: list[str]) -> None:
    (line,) = problems(overrides={key: text})
    assert line.startswith(f"{key}: ")
    assert line.endswith(f"{words[-1]} (given as a flag)")
    assert [word for word in words if word not in line] == []


def test_class_heights_are_metres_by_class() -> None:
    text = "person:1.7,dining table:0.75"
    assert load_settings(overrides={"detector.class_heights_m": text}, environment={}).detector.heights() == {
        "person": 1.7,
        "diningtable": 0.75,
    }
    (line,) = problems(overrides={"detector.class_heights_m": "person:0"})
    assert "class_heights_m: person " in line
    assert "above 0 and " in line
    assert " 100 m, got 0" in line


@pytest.mark.parametrize(
    ("toml", "key", "words"),
    [
        ("[detector]\nconfidence = '0.5'", "detector.confidence: ", 'a number, 0 to 1, got "0.5"'),
        ("[detector]\nconfidence = true", "detector.confidence: ", "0 to 1, got true"),
        ("[detector]\nenabled = 1", "detector.enabled: ", "true or false, got 1"),
        (
            "[detector]\nclasses = 'car'",
            "detector.classes: ",
            'list of texts, got "car"',
        ),
        ("[detector]\nclasses = [1.5]", "detector.classes: ", "list of texts, got [1.5]"),
        (
            "[vehicle]\nsystem_id = {a = 1}",
            "vehicle.system_id: ",
            "1 to 255, got {'a': 1}",
        ),
        ("detector = 3", "detector: ", "section [detector], got 3"),
        ("[detector]\nconfidense = 1", "unknown key ", "detector.confidense"),
        ("[detecter]\nconfidence = 1", "unknown section ", "[detecter]"),
    ],
)
def test_error_in_a_file_names_key_and_file(tmp_path: Path, toml: str, key: str, words: str) -> None:
    path = written(tmp_path / "c.toml", toml)
    (line,) = problems(path)
    assert line.startswith(key)
    assert words in line
    place = ", line 2" if key.strip() not in ("detector:", "unknown section") else ""
    assert f"(in {path}{place})" in line


@pytest.mark.parametrize(
    ("key", "nearest"),
    [
        ("detector.confidense", "did you mean detector.confidence?"),
        ("source.confidence", "did you mean detector.confidence?"),
        ("detector.qqqqqqqqqqqqqqqq", "known: detector.enabled, detector.kind, detector.model,"),
        ("zzz", "known: vehicle, source, camera,"),
    ],
)
def test_unknown_key_suggests_the_nearest(key: str, nearest: str) -> None:
    (line,) = problems(overrides={key: "1"})
    assert line.startswith(f"unknown key {key} (")
    assert f"; {nearest}" in line


def test_unknown_environment_variable_is_reported() -> None:
    (line,) = problems(COMPANION_DETECTOR_CONFIDENSE="1")
    key, variable = "detector.confidense", "COMPANION_DETECTOR_CONFIDENSE"
    assert line.startswith(f"unknown key {key} (")
    assert f" {variable})" in line
    assert line.endswith(" detector.confidence?")


@pytest.mark.parametrize(
    ("variable", "nearest"),
    [
        ("COMPANION_DETECTR__CONFIDENCE", "COMPANION_DETECTOR_CONFIDENCE?"),
        ("COMPANION_VEHICEL_URL", "COMPANION_VEHICLE_URL?"),
        ("COMPANION_HOME", "another program's"),
    ],
)
def test_variable_of_no_section_is_named_and_not_refused(variable: str, nearest: str) -> None:
    environment = {variable: "1"}
    assert load_settings("/dev/null", environment=environment) == Settings()
    (found,) = unknown_variables(environment).items()
    assert found[0] == variable
    assert found[1].endswith(nearest)


def test_settings_and_variables_of_tests_are_no_unknown_ones() -> None:
    known = ("COMPANION_DETECTOR_CONFIDENCE", "COMPANION_TEST_DATA", "COMPANION_SITL_URL", "PATH")
    assert unknown_variables(dict.fromkeys(known, "1")) == {}


def test_all_problems_are_reported_at_once(tmp_path: Path) -> None:
    path = written(tmp_path / "c.toml", "[detector]\niou = 2\n[zenoh]\nmod = 'peer'\n")
    assert len(problems(path, {"log.level": "loud", "source.loop": "maybe"})) == 4


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (
            {"guidance.min_altitude_m": "60"},
            ["guidance: min_altitude_m ", " max_altitude_m", "60 and 50"],
        ),
        ({"guidance.setpoint_lifetime_s": "0.04"}, ["guidance: setpoint_lifetime_s "]),
        ({"camera.on_gimbal": "yes", "camera.stabilized": "yes"}, ["camera: on_gimbal and stabilized"]),
        ({"source.pixel_format": "bgr"}, ["source: pixel_format"]),
        ({"recording.video": "a.mp4"}, ["recording: video ", ".webm", "got 'a.mp4'"]),
        ({"zenoh.mode": "client"}, ["zenoh: ", " connect"]),
    ],
)
def test_contradicting_keys_are_reported(overrides: dict[str, str], words: list[str]) -> None:
    (problem,) = problems(overrides=overrides)
    assert problem.startswith(words[0])
    assert [word for word in words if word not in problem] == []
    assert problem.endswith("(given as a flag)")


@pytest.mark.parametrize("content", [b"[detector]\nconfidence = \n", b"[detector\n", b"a = b\n"])
def test_syntax_error_names_file_and_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "c.toml"
    path.write_bytes(content)
    (line,) = problems(path)
    assert line.startswith(f"{path}, line ")


def test_truncated_file_is_reported(tmp_path: Path) -> None:
    path = written(tmp_path / "c.toml", "[detector]\nclasses = [")
    (line,) = problems(path)
    assert line.startswith(f"{path}, end of ")


def test_binary_file_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_bytes(b"[log]\nlevel = '\xff'\n")
    (line,) = problems(path)
    assert line.startswith(f"{path}: ")
    assert "UTF-8" in line
    assert "(line 2," in line


def test_byte_order_mark_is_no_part_of_the_settings(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text("[vehicle]\nname = 'v2'\n", "utf-8-sig")
    assert load_settings(path).vehicle.name == "v2"


def test_missing_file_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    for unreadable, reason in ((path, errno.ENOENT), (tmp_path, errno.EISDIR)):
        (line,) = problems(unreadable)
        assert line.startswith("cannot read ")
        assert line.endswith(f" {unreadable}: {os.strerror(reason)}")


def test_example_file_has_every_default() -> None:
    text = (REPOSITORY / "systemd/companion.toml").read_text(encoding="utf-8")
    assert text == to_toml(Settings())
    assert load_settings(REPOSITORY / "systemd/companion.toml", environment={}) == Settings()


names = st.text(st.characters(codec="utf-8"), min_size=1)


@given(
    names,
    st.lists(names | st.integers(0, 100)),
    st.floats(0, 1),
    st.booleans(),
    names,
    st.none() | st.integers(16, 16384),
)
def test_printed_settings_round_trip(
    tmp_path_factory: pytest.TempPathFactory,
    uri: str,
    classes: list[str | int],
    confidence: float,
    loop: bool,
    model: str,
    width: int | None,
) -> None:
    settings = Settings.model_validate(
        {
            "source": {"uri": uri, "loop": loop, "width": width},
            "detector": {"classes": tuple(classes), "confidence": confidence, "model": model},
            "camera": {"mount_forward_m": 1e-7, "mount_right_m": -2.5},
        }
    )
    text = to_toml(settings)
    tomllib.loads(text)
    path = tmp_path_factory.mktemp("config") / "c.toml"
    path.write_text(text, encoding="utf-8", newline="")
    assert load_settings(path, environment={}) == settings


def test_source_settings_of_the_source_section() -> None:
    opening = load_settings(None, {"source.width": "640", "source.every_frame": "yes"}, {}).source.opening()
    assert (opening.width, opening.realtime, opening.loop) == (640, False, False)


def test_default_model_name_matches_the_detector() -> None:
    assert Settings().detector.model == DEFAULT_MODEL


def test_settings_are_frozen() -> None:
    with pytest.raises(ValueError, match="frozen"):
        Settings().detector.confidence = 0.5


def test_field_of_view_spans_the_frame() -> None:
    model = Settings().camera.model(640, 480)
    assert math.degrees(2 * math.atan(320 / model.fx)) == pytest.approx(80.0)


def test_calibration_is_scaled_to_the_frame_size() -> None:
    lens = CameraModel(640, 480, 500.0, 510.0, 319.5, 239.5)
    camera = Settings.model_validate({"camera": {"lens": lens, "mount_pitch_deg": -30.0}}).camera
    assert (camera.model(640, 480).fx, camera.model(1280, 960).fx) == (500, 1000)
    assert camera.mount().pitch_rad == pytest.approx(-math.pi / 6)
    assert camera.field_rad == pytest.approx(2 * math.atan(320 / 500))
    assert Settings().camera.field_rad == pytest.approx(math.radians(80.0))


@pytest.mark.parametrize(("old", "new"), RENAMED.items())
def test_renamed_key_names_the_new_one(old: str, new: str, tmp_path: Path) -> None:
    section, _, name = old.partition(".")
    path = tmp_path / "companion.toml"
    path.write_text(f"[{section}]\n{name} = 1\n[cameras.down.{section}]\n{name} = 1\n")
    variable = f"COMPANION_{section}_{name}".upper()
    with pytest.raises(ConfigurationError) as failure:
        load_settings(path, {old: "1"}, {variable: "1"})
    renamed = [line for line in failure.value.problems if line.endswith(f" {new} in version {VERSION}")]
    assert [line.startswith(f"{old} (") for line in renamed] == [True] * 3
    assert any(variable in line for line in renamed)
    if section != "guidance":  # one camera steers; its section has no copy for each camera
        assert any(f"cameras.down.{new} in " in line for line in failure.value.problems)


@pytest.mark.parametrize("old", sorted(REMOVED.keys() - {f"camera.{name}" for name in LENS}))
def test_removed_key_says_what_to_do_instead(old: str, tmp_path: Path) -> None:
    section, _, name = old.partition(".")
    path = tmp_path / "companion.toml"
    path.write_text(f"[{section}]\n{name} = 1\n[cameras.down.{section}]\n{name} = 1\n")
    variable = f"COMPANION_{section}_{name}".upper()
    with pytest.raises(ConfigurationError) as failure:
        load_settings(path, {old: "1"}, {variable: "1"})
    removed = [line for line in failure.value.problems if line.startswith(f"{old} (")]
    assert len(removed) == 3
    assert all(line.endswith(f"in version {VERSION}: {REMOVED[old].instead}") for line in removed)
    assert old not in {flag.key for flag in flags()}
    assert REMOVED[old].instead


LENS_TEXTS = {
    "fx_px": "500.5",
    "fy_px": "510",
    "cx_px": "319.5",
    "cy_px": "239.5",
    "calibrated_width": "640",
    "calibrated_height": "480",
    "distortion": "0.1, -0.2, 0, 0",
    "distortion_model": "equidistant",
}
LENS_MODEL = CameraModel(640, 480, 500.5, 510.0, 319.5, 239.5, (0.1, -0.2, 0.0, 0.0), "equidistant")


def test_keys_of_a_lens_give_the_calibration_file(tmp_path: Path) -> None:
    toml = [
        f"{key} = '{text}'" if key == "distortion_model" else f"{key} = {text}"
        for key, text in LENS_TEXTS.items()
    ]
    toml = [line.replace(LENS_TEXTS["distortion"], f"[{LENS_TEXTS['distortion']}]") for line in toml]
    path = written(
        tmp_path / "c.toml",
        "\n".join(["[camera]", *toml, "[cameras.down.source]", "uri = 'a'", "[cameras.down.camera]", *toml]),
    )
    given = {f"COMPANION_CAMERA_{key}".upper(): text for key, text in LENS_TEXTS.items()}
    assert LENS_TEXTS.keys() == LENS.keys()
    in_file = problems(path)
    assert [line.partition(",")[0] for line in in_file] == ["camera.fx_px", "cameras.down.camera.fx_px"]
    for line in (
        *in_file,
        *problems(None, None, **given),
        *problems(overrides={f"camera.{k}": v for k, v in LENS_TEXTS.items()}),
    ):
        assert "calibration_file" in line
        content = line[line.index("{image_width") : line.rindex("}}") + 2]
        written(tmp_path / "camera.yaml", content + "\n")
        assert read_camera_info(tmp_path / "camera.yaml").model == LENS_MODEL
    (alone,) = problems(overrides={"camera.fx_px": "500"})
    assert "data: [500, 0, CX, 0, FY, CY, 0, 0, 1]" in alone


FORMER_DEFAULTS = {
    "detector": {"every": 1, "max_age_s": None, "tile_size": 640, "tile_overlap": 0.2},
    "preview": {"quality": 80, "cloud_voxel_m": 0.1},
    "recording": {"images": True, "image_format": "jpeg", "depth": False, "clouds": False}
    | {"max_file_minutes": 60},
    "source": {"realtime": True},
    "tracker": {"high_confidence": 0.35, "low_confidence": 0.1, "camera_motion": True},
    "vehicle": {"component_id": 191},
}


def test_recorded_settings_are_read_without_removed_keys() -> None:
    json_able = Settings.model_validate({"camera": {"mount_pitch_deg": -30.0}}).model_dump(mode="json")
    for old in REMOVED:
        section, _, name = old.partition(".")
        if section == "camera":
            json_able[section][name] = LENS[name]
        else:
            json_able[section] |= FORMER_DEFAULTS.get(section, {})
    changed_keys: list[str] = []
    read = Settings.from_json(without_removed(json_able, changed_keys))
    assert (read.camera.mount_pitch_deg, read.camera.lens, changed_keys) == (-30.0, None, [])
    old_lens: dict[str, object] = {
        "fx_px": 500.5,
        "fy_px": 510,
        "cx_px": 319.5,
        "cy_px": 239.5,
        "calibrated_width": 640,
    }
    old_lens |= {"calibrated_height": 480, "distortion_model": "equidistant", "distortion": [0.1, -0.2, 0, 0]}
    sections = {"camera": json_able["camera"] | old_lens}
    read = Settings.from_json(
        without_removed({**sections, "cameras": {"down": {**sections, "source": {"uri": "a"}}}}, changed_keys)
    )
    assert read.camera.lens == read.cameras["down"].camera.lens == LENS_MODEL
    assert changed_keys == []


@pytest.mark.parametrize(
    ("key", "value", "lines"),
    [
        ("tracker.high_confidence", 0.5, 1),
        ("tracker.camera_motion", False, 1),
        ("detector.tile_size", 320, 0),  # without `tiles`
        ("detector.every", 2, 1),
        ("preview.cloud_voxel_m", 0.2, 1),
    ],
)
def test_recorded_value_that_no_longer_holds_is_named(key: str, value: object, lines: int) -> None:
    section, _, name = key.partition(".")
    json_able = Settings().model_dump(mode="json", include={section})
    json_able[section][name] = value
    changed_keys: list[str] = []
    Settings.from_json(without_removed(json_able, changed_keys))
    assert [key in line for line in changed_keys] == [True] * lines


def test_recorded_lens_is_read_without_its_file(tmp_path: Path) -> None:
    file = written(tmp_path / "camera.yaml", "")
    write_camera_info(file, LENS_MODEL, "camera")
    settings = load_settings(os.devnull, {"camera.calibration_file": str(file)}, {})
    file.unlink()
    assert Settings.from_json(settings.model_dump(mode="json")) == settings
    assert changed(settings, {"guidance.max_climb_mps": "1"}).camera == settings.camera
    assert settings.camera.lens == LENS_MODEL


def test_changed_settings_keep_the_rest() -> None:
    keys = {"guidance.max_climb_mps": "1", "cameras.down.source.uri": "down.mp4"}
    before = load_settings(os.devnull, keys, {})
    after = changed(before, {"guidance.brake_s": "1"})
    assert (after.guidance.brake_s, after.guidance.max_climb_mps) == (1.0, 1.0)
    assert after.cameras == before.cameras != {}
    with pytest.raises(ConfigurationError, match=r"guidance\.brake_s"):
        changed(before, {"guidance.brake_s": "fast"})
