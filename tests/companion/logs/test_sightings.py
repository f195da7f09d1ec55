"""`companion log show --objects`: the objects of a recording as GeoJSON and KML."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from companion.bench.lockstep_flight import plain_settings
from companion.geometry.geodesy import north_east
from companion.guidance.core import GuidanceOptions
from companion.recording.convert import Converter
from companion.recording.encoding import dumps
from companion.recording.tap import run_record
from tests.companion.command_line import companion_here
from tests.companion.recording.lockstep_recording import new_writer

SECOND_NS = 10**9
BEGAN_NS = 1_790_000_000 * SECOND_NS  # Unix time at the service's time 0
CAR = (47.39781404, 8.54560773)
ELLIPSE = {"semi_major_m": 2.0, "semi_minor_m": 0.5, "orientation_rad": math.radians(30.0)}
KML = "{http://www.opengis.net/kml/2.2}"


def event(
    track_id: int, first_s: int, last_s: int, at: tuple[float, float] | None, **changes: Any
) -> dict[str, Any]:
    latitude, longitude = at or (None, None)
    return {
        "event": "update",
        "stamp_ns": last_s * SECOND_NS,
        "track_id": track_id,
        "class_name": "car",
        "track_score": 0.9,
        "seen": 10 * (last_s - first_s),
        "first_ns": first_s * SECOND_NS,
        "last_ns": last_s * SECOND_NS,
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "altitude_amsl_m": None if at is None else 490.0,
        "error_ellipse": None if at is None else ELLIPSE,
        "moving": None if at is None else False,
    } | changes


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in which a car is seen twice, a person without a range, and a bus by a second camera."""
    writer, converter = new_writer(tmp_path_factory.mktemp("sightings")), Converter("vehicle1")
    run = run_record(plain_settings(), GuidanceOptions(), "service1")
    messages: list[tuple[str, dict[str, Any]]] = [
        ("@record/run", run | {"unix_offset_ns": BEGAN_NS}),
        ("tracks", {"published_ns": 3 * SECOND_NS, "events": [event(1, 2, 3, (47.0, 8.0))]}),
        (
            "tracks",
            {
                "published_ns": 9 * SECOND_NS,
                "events": [event(1, 2, 8, CAR), event(4, 1, 8, None, class_name="person")],
            },
        ),
        # The image's edge cuts the car off: the same position, its error grows.
        (
            "tracks",
            {
                "published_ns": 10 * SECOND_NS,
                "events": [event(1, 2, 9, CAR, error_ellipse=ELLIPSE | {"semi_major_m": 5.0})],
            },
        ),
        # The vehicle's own position has become unknown.
        ("tracks", {"published_ns": 11 * SECOND_NS, "events": [event(1, 2, 10, None, event="end")]}),
        (
            "cameras/down/tracks",
            {"published_ns": 9 * SECOND_NS, "events": [event(1, 5, 9, CAR, class_name="bus", moving=True)]},
        ),
    ]
    for topic, message in messages:
        for converted in converter.convert(topic, dumps(message)):
            writer.write(*converted)
    writer.close()
    return writer.path


@pytest.fixture(scope="module")
def changing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in which object 5 has track 1, then 7, then 8, which was that of object 6."""
    writer, converter = new_writer(tmp_path_factory.mktemp("changing")), Converter("vehicle1")
    run = run_record(plain_settings(), GuidanceOptions(), "service1") | {"unix_offset_ns": BEGAN_NS}
    messages: list[tuple[str, dict[str, Any]]] = [("@record/run", run)]
    for track, first_s, last_s, at, objects in (
        (1, 1, 3, (47.0, 8.0), {5: [1]}),
        (7, 4, 6, CAR, {5: [1, 7]}),
        (8, 7, 8, (47.1, 8.1), {6: [8]}),
        (8, 7, 9, None, {5: [1, 7, 8]}),
    ):
        message = {
            "published_ns": last_s * SECOND_NS,
            "events": [event(track, first_s, last_s, at)],
            "objects": [{"object_id": key, "track_ids": value} for key, value in objects.items()],
        }
        messages.append(("tracks", message))
    for topic, message in messages:
        for converted in converter.convert(topic, dumps(message)):
            writer.write(*converted)
    writer.close()
    return writer.path


def test_object_is_one_sighting_however_often_its_track_changes(changing: Path, tmp_path: Path) -> None:
    done = companion_here("log", "show", changing, "--objects", "geojson", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    car, ellipse = json.loads(done.stdout)["features"]
    assert car["properties"]["object_id"] == ellipse["properties"]["object_id"] == 5
    assert car["properties"]["track_ids"] == [1, 7, 8]
    assert car["properties"]["first_seen"] == "2026-09-21T14:13:21.000Z"
    assert car["properties"]["last_seen"] == "2026-09-21T14:13:29.000Z"
    assert car["properties"]["seen"] == 20 + 20 + 20
    done = companion_here("log", "show", changing, "--objects", "kml", cwd=tmp_path)
    (placemark,) = ElementTree.fromstring(done.stdout).iter(f"{KML}Placemark")
    assert placemark.findtext(f"{KML}name") == "car 8"
    data = {each.get("name"): each.findtext(f"{KML}value") for each in placemark.iter(f"{KML}Data")}
    assert (data["object_id"], data["track_ids"]) == ("5", "1, 7, 8")


def test_geojson_has_each_track_once(path: Path, tmp_path: Path) -> None:
    done = companion_here("log", "show", path, "--objects", "geojson", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["type"] == "FeatureCollection"
    points = [f for f in found["features"] if (f["geometry"] or {}).get("type") != "Polygon"]
    assert [(f["properties"]["class_name"], f["properties"]["camera"]) for f in points] == [
        ("person", None),
        ("car", None),
        ("bus", "cameras/down"),
    ]
    person, car, bus = points
    assert person["geometry"] is None
    assert car["geometry"]["type"] == "Point"
    assert car["geometry"]["coordinates"] == pytest.approx([CAR[1], CAR[0]], abs=1e-6)
    assert car["properties"] | {"track_score": 0} == {
        "object_id": None,
        "track_ids": [1],
        "camera": None,
        "class_name": "car",
        "track_score": 0,
        "first_seen": "2026-09-21T14:13:22.000Z",
        "last_seen": "2026-09-21T14:13:30.000Z",
        "seen": 80,
        "moving": False,
        "altitude_amsl_m": 490.0,
        "semi_major_m": 2.0,
        "semi_minor_m": 0.5,
        "orientation_deg": 30.0,
    }
    assert bus["properties"]["moving"] is True
    assert "1 of 3" in done.stderr


def test_ellipse_is_a_closed_counterclockwise_ring(path: Path, tmp_path: Path) -> None:
    done = companion_here("log", "show", path, "--objects", "geojson", cwd=tmp_path)
    (first, *_) = [f for f in json.loads(done.stdout)["features"] if f["properties"].get("error_ellipse")]
    assert first["properties"] == {"object_id": None, "track_ids": [1], "error_ellipse": 0.95}
    (ring,) = first["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    offsets = [north_east(CAR, (latitude, longitude)) for longitude, latitude in ring]
    assert max(math.hypot(*offset) for offset in offsets) == pytest.approx(2.0 * 2.4477, abs=0.01)
    assert min(math.hypot(*offset) for offset in offsets) == pytest.approx(0.5 * 2.4477, abs=0.01)
    north, east = max(offsets, key=lambda offset: (round(math.hypot(*offset), 2), offset[0]))
    assert math.degrees(math.atan2(east, north)) == pytest.approx(30.0, abs=0.5)
    area = sum(e0 * n1 - e1 * n0 for (n0, e0), (n1, e1) in itertools.pairwise(offsets)) / 2
    assert area == pytest.approx(math.pi * 2.0 * 0.5 * 2.4477**2, rel=0.02)


def test_kml_has_points_times_and_ellipses(path: Path, tmp_path: Path) -> None:
    done = companion_here("log", "show", path, "--objects", "kml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    root = ElementTree.fromstring(done.stdout)
    assert root.tag == f"{KML}kml"
    person, car, _ = root.findall(f"{KML}Document/{KML}Placemark")
    assert person.find(f"{KML}MultiGeometry") is None
    assert car.findtext(f"{KML}name") == "car 1"
    assert car.findtext(f"{KML}TimeSpan/{KML}begin") == "2026-09-21T14:13:22.000Z"
    text = car.findtext(f"{KML}MultiGeometry/{KML}Point/{KML}coordinates")
    assert text is not None
    assert [float(value) for value in text.split(",")] == pytest.approx([CAR[1], CAR[0]], abs=1e-6)
    ring = car.findtext(
        f"{KML}MultiGeometry/{KML}Polygon/{KML}outerBoundaryIs/{KML}LinearRing/{KML}coordinates"
    )
    assert ring is not None
    assert len(ring.split()) == 37
    data = {each.get("name"): each.findtext(f"{KML}value") for each in car.iter(f"{KML}Data")}
    assert (data["class_name"], data["semi_major_m"]) == ("car", "2.0")


def test_bad_input_is_one_line_and_exit_code_two(tmp_path: Path) -> None:
    other = tmp_path / "notes.mcap"
    other.write_text("not a recording")
    writer, converter = new_writer(tmp_path / "odd"), Converter("vehicle1")
    for converted in converter.convert("tracks", dumps({"published_ns": 1, "events": [{"track_id": 1}]})):
        writer.write(*converted)
    writer.close()
    for arguments, words in (
        ((tmp_path / "none.mcap", "kml"), "none.mcap"),
        ((other, "geojson"), "not an MCAP file"),
        ((writer.path, "geojson"), "class_name"),
    ):
        done = companion_here("log", "show", "--objects", arguments[1], arguments[0], cwd=tmp_path)
        assert done.returncode == 2
        assert done.stdout == ""
        assert len(done.stderr.splitlines()) == 1
        assert words in done.stderr


def test_recording_without_tracks_gives_an_empty_collection(tmp_path: Path) -> None:
    writer = new_writer(tmp_path / "empty")
    writer.close()
    done = companion_here("log", "show", writer.path, "--objects", "geojson", cwd=tmp_path)
    assert (done.returncode, json.loads(done.stdout)["features"]) == (0, [])
