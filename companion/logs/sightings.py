"""`companion log show --objects`: the objects in a recording, as GeoJSON (RFC 7946) or KML 2.2."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from companion.bus.topics import TRACKS
from companion.geometry.geodesy import latitude_longitude
from companion.recording import RecordingError
from companion.recording.convert import RUN_CHANNEL
from companion.recording.files import RecordingReader

KML = "http://www.opengis.net/kml/2.2"
# Of two dimensions, 95 % are within this many sigma: sqrt(-2 ln 0.05).
SIGMAS_95 = 2.4477
_CORNERS = 36
_Track = tuple[str, str, int]  # service, camera, id
Degrees = tuple[float, float]  # longitude, latitude: the order of both formats


@dataclass(frozen=True, slots=True)
class Sighting:
    """One object with a confirmed track.

    Attributes:
        object_id: in the run; None: the camera is not the steering one, so this is a track.
        track_ids: the image tracker's, the newest last.
        camera: its topic's prefix; empty for the first camera.
        first_ns, last_ns: its first and newest detection, Unix time.
        seen: frames with a detection.
        position: (longitude, latitude), WGS 84; None: the track had no range.
        ellipse: semi-axes, metres, and orientation of the one-sigma error, as in the messages.
        moving: the position is the newest one.
    """

    object_id: int | None
    track_ids: tuple[int, ...]
    camera: str
    class_name: str
    score: float
    first_ns: int
    last_ns: int
    seen: int
    position: Degrees | None
    altitude_amsl_m: float | None
    ellipse: tuple[float, float, float] | None
    moving: bool

    def ellipse_95(self) -> list[Degrees]:
        """The 95 % ellipse as a closed ring, counterclockwise; empty without one."""
        if self.position is None or self.ellipse is None:
            return []
        major_m, minor_m, orientation_rad = self.ellipse
        north, east = math.cos(orientation_rad), math.sin(orientation_rad)
        longitude, latitude = self.position
        ring = []
        for corner in range(_CORNERS):
            angle = -math.tau * corner / _CORNERS
            along, across = major_m * SIGMAS_95 * math.cos(angle), minor_m * SIGMAS_95 * math.sin(angle)
            offset = (along * north - across * east, along * east + across * north)
            there = latitude_longitude((latitude, longitude), *offset)
            ring.append((round(there[1], 8), round(there[0], 8)))
        return [*ring, ring[0]]

    def properties(self) -> dict[str, Any]:
        """What both formats say about it."""
        ellipse = self.ellipse or (None, None, None)
        orientation_rad = ellipse[2]
        return {
            "object_id": self.object_id,
            "track_ids": list(self.track_ids),
            "camera": self.camera or None,
            "class_name": self.class_name,
            "track_score": self.score,
            "first_seen": _time(self.first_ns),
            "last_seen": _time(self.last_ns),
            "seen": self.seen,
            "moving": self.moving,
            "altitude_amsl_m": self.altitude_amsl_m,
            "semi_major_m": ellipse[0],
            "semi_minor_m": ellipse[1],
            "orientation_deg": None if orientation_rad is None else round(math.degrees(orientation_rad), 1),
        }


def sightings(paths: Sequence[Path]) -> list[Sighting]:
    """Read every object of the files of one or several runs, in order of its first detection.

    Raises:
        RecordingError: a file cannot be read, or has a message that is not what its topic says.
    """
    tracks: dict[_Track, Sighting] = {}
    owners: dict[_Track, int] = {}
    service = ""
    for path in paths:
        for channel, log_time_ns, data in RecordingReader(path).messages():
            camera, _, name = channel.topic.rpartition("/")
            if channel.topic != RUN_CHANNEL and (name != TRACKS.name or channel.encoding != "json"):
                continue
            try:
                message = json.loads(data)
                if channel.topic == RUN_CHANNEL:
                    service = str(message["service"])
                    continue
                offset_ns = log_time_ns - int(message["published_ns"])
                for event in message["events"]:
                    key = (service, camera, event["track_id"])
                    tracks[key] = _sighting(event, camera, offset_ns, tracks.get(key))
                for each in message.get("objects", ()):
                    owners |= {
                        (service, camera, track_id): each["object_id"] for track_id in each["track_ids"]
                    }
            except (ValueError, KeyError, TypeError) as error:
                raise RecordingError(
                    f"{path}: a message on {channel.topic!r} is not one of the service: "
                    f"{type(error).__name__}: {error}"
                ) from error
    objects: dict[tuple[str, str, int | None, int | None], Sighting] = {}
    for key, track in sorted(tracks.items(), key=lambda item: item[1].last_ns):
        object_id = owners.get(key)
        same = (*key[:2], object_id, key[2] if object_id is None else None)
        objects[same] = _joined(objects.get(same), replace(track, object_id=object_id))
    return sorted(objects.values(), key=lambda sighting: (sighting.first_ns, sighting.track_ids))


def _joined(before: Sighting | None, after: Sighting) -> Sighting:
    """The two tracks of one object: the newer one, and its position if it has one."""
    if before is None:
        return after
    located = after if after.position is not None else before
    return replace(
        after,
        track_ids=before.track_ids + after.track_ids,
        first_ns=min(before.first_ns, after.first_ns),
        seen=before.seen + after.seen,
        position=located.position,
        altitude_amsl_m=located.altitude_amsl_m,
        ellipse=located.ellipse,
        moving=located.moving,
    )


def _sighting(event: dict[str, Any], camera: str, offset_ns: int, before: Sighting | None) -> Sighting:
    latitude, longitude, ellipse = (
        event.get(key) for key in ("latitude_deg", "longitude_deg", "error_ellipse")
    )
    position, altitude_amsl_m, moving = None, event.get("altitude_amsl_m"), bool(event.get("moving"))
    axes = None
    if latitude is not None and longitude is not None:
        position = (float(longitude), float(latitude))
        if ellipse is not None:
            axes = (
                float(ellipse["semi_major_m"]),
                float(ellipse["semi_minor_m"]),
                float(ellipse["orientation_rad"]),
            )
            if (
                before is not None
                and before.ellipse is not None
                and before.position == position
                and not moving
            ):
                # The error of a position grows while no detection counts; here it is that of when one did.
                axes = min(axes, before.ellipse)
    elif before is not None:
        # The vehicle's own position may be unknown for a while.
        position, axes = before.position, before.ellipse
        altitude_amsl_m, moving = before.altitude_amsl_m, before.moving
    return Sighting(
        None,
        (int(event["track_id"]),),
        camera,
        str(event["class_name"]),
        float(event["track_score"]),
        int(event["first_ns"]) + offset_ns,
        int(event["last_ns"]) + offset_ns,
        int(event["seen"]),
        position,
        altitude_amsl_m,
        axes,
        moving,
    )


def geojson(found: Sequence[Sighting]) -> str:
    """Return a FeatureCollection: a Point of each sighting, and its ellipse as a Polygon."""
    features = [feature for sighting in found for feature in _features(sighting)]
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False)


def _features(sighting: Sighting) -> Iterator[dict[str, Any]]:
    point = None
    if sighting.position is not None:
        point = {"type": "Point", "coordinates": list(sighting.position)}
    yield {"type": "Feature", "geometry": point, "properties": sighting.properties()}
    if ring := sighting.ellipse_95():
        polygon = {"type": "Polygon", "coordinates": [[list(corner) for corner in ring]]}
        properties = {
            "object_id": sighting.object_id,
            "track_ids": list(sighting.track_ids),
            "error_ellipse": 0.95,
        }
        yield {"type": "Feature", "geometry": polygon, "properties": properties}


def kml(found: Sequence[Sighting]) -> str:
    """Return a KML document with a Placemark of each sighting: point and ellipse."""
    ElementTree.register_namespace("", KML)
    root = ElementTree.Element(f"{{{KML}}}kml")
    document = _child(root, "Document")
    for sighting in found:
        placemark = _child(document, "Placemark")
        _child(placemark, "name", f"{sighting.class_name} {sighting.track_ids[-1]}")
        span = _child(placemark, "TimeSpan")
        _child(span, "begin", _time(sighting.first_ns))
        _child(span, "end", _time(sighting.last_ns))
        extended = _child(placemark, "ExtendedData")
        for key, value in sighting.properties().items():
            if value is not None:
                data = _child(extended, "Data")
                data.set("name", key)
                text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
                _child(data, "value", text)
        if sighting.position is None:
            continue
        geometry = _child(placemark, "MultiGeometry")
        _child(_child(geometry, "Point"), "coordinates", _coordinates([sighting.position]))
        if ring := sighting.ellipse_95():
            boundary = _child(_child(_child(geometry, "Polygon"), "outerBoundaryIs"), "LinearRing")
            _child(boundary, "coordinates", _coordinates(ring))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True)


def _child(parent: ElementTree.Element, name: str, text: str | None = None) -> ElementTree.Element:
    element = ElementTree.SubElement(parent, f"{{{KML}}}{name}")
    element.text = text
    return element


def _coordinates(points: Sequence[Degrees]) -> str:
    return " ".join(f"{longitude:.8f},{latitude:.8f}" for longitude, latitude in points)


def _time(stamp_ns: int) -> str:
    moment = datetime.fromtimestamp(stamp_ns / 1e9, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
