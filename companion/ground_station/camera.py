"""One camera as a MAVLink component (https://mavlink.io/en/services/camera.html)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from pymavlink.dialects.v20 import common as mavlink

from companion import __version__
from companion.bus.bodies.frames import CameraInfoBody
from companion.ground_station.captures import Captures, Photo
from companion.ground_station.component import (
    ACCEPTED,
    DENIED,
    REJECTED,
    Answer,
    Command,
    Message,
    RequestTable,
)
from companion.ground_station.positions import Place, Positions
from companion.host.clock import unix_offset_ns

COMPONENT_IDS = range(mavlink.MAV_COMP_ID_CAMERA, mavlink.MAV_COMP_ID_CAMERA6 + 1)
VENDOR = "companion"
_HEARTBEAT_NS = 1_000_000_000
DEFINITION_WAIT_NS = 20_000_000_000
"""A service has loaded its model by then, or video is not to wait for it."""
# `status` comes once a second.
STATUS_MAX_AGE_NS = 3_000_000_000
_UNKNOWN_I32, _NAN = 2**31 - 1, math.nan
_NO_ORIENTATION = (_NAN,) * 4
_PHOTOS_KEPT = 1000
_MOST_STATIONS, _STATION_GONE_NS = 16, 3_000_000_000
# Some 600 bytes each.
_ANNOUNCED_AFTER_S = tuple(0.2 + 0.7 * count for count in range(13))
_ANNOUNCED = (
    mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION,
    mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS,
    mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION,
    mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS,
    mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION,
    mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS,
)
_CAPTURES = (
    mavlink.CAMERA_CAP_FLAGS_CAPTURE_VIDEO
    | mavlink.CAMERA_CAP_FLAGS_CAPTURE_IMAGE
    | mavlink.CAMERA_CAP_FLAGS_HAS_MODES
    | mavlink.CAMERA_CAP_FLAGS_CAN_CAPTURE_IMAGE_IN_VIDEO_MODE
    | mavlink.CAMERA_CAP_FLAGS_CAN_CAPTURE_VIDEO_IN_IMAGE_MODE
)


@dataclass(frozen=True, slots=True)
class VideoStream:
    """A video stream of a camera.

    Attributes:
        name: for people. uri: as a station reaches it. size: width and height, pixels; 0: not known yet.
        encoding: VIDEO_STREAM_ENCODING; 0 for JPEG, which has no value there.
        rate_hz: at most. bit_rate: of the encoder, bit/s; 0: not known.
    """

    name: str
    uri: str
    size: tuple[int, int] = (0, 0)
    encoding: int = mavlink.VIDEO_STREAM_ENCODING_UNKNOWN
    rate_hz: float = 0.0
    bit_rate: int = 0


class Camera:
    """A camera of the settings.

    Args:
        name: of the settings; None: the first. component_id: of `COMPONENT_IDS`.
        field_rad: horizontal field of view by the settings, until the lens is known.
        captures: takes its photos and videos. positions: where it was at a time.
        warn: called with a line for the operator.

    Attributes:
        requests: what it answers; other parts add to it.
        sources: functions as `due`, of other parts that send as this component.
        flags: CAMERA_CAP_FLAGS of other parts.
        streams: its video streams; their numbers count from 1.
        definition: its definition file and the version; None: there is none yet.
        needs_definition: CAMERA_INFORMATION waits for `define`, for `DEFINITION_WAIT_NS` at most.
    """

    def __init__(
        self,
        name: str | None,
        component_id: int,
        *,
        field_rad: float,
        captures: Captures,
        positions: Positions,
        warn: Callable[[str], None],
    ) -> None:
        self.name, self.component_id = name, component_id
        self.captures, self.positions, self._warn = captures, positions, warn
        self.requests = RequestTable()
        self.sources: list[Callable[[int], Iterable[Message]]] = []
        self.flags = 0
        self.streams: Sequence[VideoStream] = ()
        self.definition: tuple[bytes, int] | None = None
        self.needs_definition = False
        self._definition_uri, self._definition_version = "", 0
        self._first_ns: int | None = None
        self._field_rad = field_rad
        self._info: CameraInfoBody | None = None
        self._status_ns: int | None = None
        self._heartbeat_ns: int | None = None
        self._mode = mavlink.CAMERA_MODE_IMAGE
        self._now_ns = 0
        self._is_changed = False
        self._stations_ns: dict[int, int] = {}
        self._announcements_ns: list[int] = []
        self._photos: dict[int, Message] = {}
        self.requests.replies |= {
            mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION: lambda _: self._informations(),
            mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS: lambda _: [self._settings()],
            mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION: self._storage,
            mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS: lambda _: [self._capture_status()],
            mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION: self._stream_information,
            mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS: self._stream_status,
            mavlink.MAVLINK_MSG_ID_CAMERA_FOV_STATUS: lambda _: [self._fov_status()],
            mavlink.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED: lambda n: (
                [self._photos[n]] if n in self._photos else ()
            ),
        }
        self.requests.actions |= {
            mavlink.MAV_CMD_SET_CAMERA_MODE: self._set_mode,
            mavlink.MAV_CMD_IMAGE_START_CAPTURE: self._start_photos,
            mavlink.MAV_CMD_IMAGE_STOP_CAPTURE: self._stop_photos,
            mavlink.MAV_CMD_VIDEO_START_CAPTURE: self._start_video,
            mavlink.MAV_CMD_VIDEO_STOP_CAPTURE: self._stop_video,
            mavlink.MAV_CMD_VIDEO_START_STREAMING: self._streaming,
            mavlink.MAV_CMD_VIDEO_STOP_STREAMING: self._streaming,
        }

    # --- from the bus --------------------------------------------------------------------------------

    def on_status(self, now_ns: int) -> None:
        """Note that the service has published its status."""
        self._status_ns = now_ns

    def on_camera_info(self, info: CameraInfoBody) -> None:
        """Use the lens; stations that asked before get it too."""
        changed = self._info is None or self.size != (info["width"], info["height"])
        self._info = info
        self._is_changed |= changed

    def define(self, uri: str, version: int) -> None:
        """Announce where its definition file is; empty: nowhere. Stations that asked before get it too."""
        self._definition_uri, self._definition_version = uri, version
        self.needs_definition, self._is_changed = False, True

    def show_streams(self, streams: Sequence[VideoStream]) -> list[Message]:
        """Use the streams that there are now; returns what stations are sent of new ones."""
        is_new = len(streams) != len(self.streams)
        self.streams = streams
        self._is_changed |= is_new
        return [*self._stream_information(0)] if is_new else []

    # --- the component -------------------------------------------------------------------------------

    def handle(self, message: Message, now_ns: int) -> Iterable[Message]:
        """See Component."""
        self._now_ns = now_ns
        if message.get_type() == "HEARTBEAT":
            self._on_station(message.get_srcSystem(), now_ns)
            return []
        return self.requests.handle(message, now_ns)

    def _on_station(self, system_id: int, now_ns: int) -> None:
        """Announce everything to a station that is new or back.

        QGroundControl repeats a lost request after 3 s and more, and uses what it did not ask for. With 30 %
        of the messages lost it has everything after 2.4 s (median of 2000 simulated cases; 9.7 s at most). By
        its requests alone that takes 15 s, and in four of five cases more than 10 s.
        """
        before_ns = self._stations_ns.pop(system_id, None)
        self._stations_ns[system_id] = now_ns
        if len(self._stations_ns) > _MOST_STATIONS:
            self._stations_ns.pop(next(iter(self._stations_ns)))
        if before_ns is None or now_ns - before_ns > _STATION_GONE_NS:
            self._announcements_ns = [now_ns + round(after_s * 1e9) for after_s in _ANNOUNCED_AFTER_S]

    def due(self, now_ns: int) -> Iterable[Message]:
        """See Component."""
        self._now_ns = now_ns
        if self._first_ns is None:
            self._first_ns = now_ns
        if self.needs_definition and now_ns - self._first_ns > DEFINITION_WAIT_NS:
            self.needs_definition, self._is_changed = False, True
        if self._heartbeat_ns is None or now_ns - self._heartbeat_ns >= _HEARTBEAT_NS:
            late = self._heartbeat_ns is None or now_ns - self._heartbeat_ns >= 2 * _HEARTBEAT_NS
            self._heartbeat_ns = now_ns if late else (self._heartbeat_ns or 0) + _HEARTBEAT_NS
            yield self._heartbeat()
        if self._is_changed and not self.needs_definition:
            self._is_changed = False
            yield self._information()
        if self._announcements_ns and now_ns >= self._announcements_ns[0]:
            self._announcements_ns.pop(0)
            for message_id in _ANNOUNCED:
                yield from self.requests.replies[message_id](0)
        for photo in self.captures.due(now_ns):
            yield self._photo(photo)
            yield self._capture_status()
        yield from self.requests.due(now_ns)
        for source in self.sources:
            yield from source(now_ns)

    @property
    def label(self) -> str:
        """Its name for people and in file names."""
        return self.name or "camera"

    @property
    def is_active(self) -> bool:
        """Whether the service's status is fresh."""
        return self._state == int(mavlink.MAV_STATE_ACTIVE)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames, pixels; 0: not known yet."""
        return (0, 0) if self._info is None else (self._info["width"], self._info["height"])

    @property
    def field_rad(self) -> tuple[float, float]:
        """Horizontal and vertical field of view, radians; the latter NaN until the lens is known."""
        if self._info is None:
            return self._field_rad, _NAN
        (width, height), k = self.size, self._info["k"]
        return 2 * math.atan(width / 2 / k[0]), 2 * math.atan(height / 2 / k[4])

    @property
    def boot_ms(self) -> int:
        """CLOCK_MONOTONIC of the newest call, milliseconds, as `time_boot_ms`."""
        return self._now_ns // 1_000_000 & 0xFFFF_FFFF

    # --- messages ------------------------------------------------------------------------------------

    @property
    def _state(self) -> int:
        if self._status_ns is None:
            return int(mavlink.MAV_STATE_BOOT)
        fresh = self._now_ns - self._status_ns < STATUS_MAX_AGE_NS
        return int(mavlink.MAV_STATE_ACTIVE if fresh else mavlink.MAV_STATE_CRITICAL)

    def _heartbeat(self) -> Message:
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, self._state, 3
        )

    def _informations(self) -> Sequence[Message]:
        """QGroundControl reads the address of a definition once, and asks again while there is no message."""
        return [] if self.needs_definition else [self._information()]

    def _information(self) -> Message:
        width, height = self.size
        has_stream = mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM if self.streams else 0
        return mavlink.MAVLink_camera_information_message(
            self.boot_ms,
            _text(VENDOR, 32),
            _text(self.label, 32),
            _firmware_version(__version__),
            _NAN,
            _NAN,
            _NAN,
            width,
            height,
            0,
            _CAPTURES | has_stream | self.flags,
            self._definition_version,
            _text(self._definition_uri, 140),
        )

    def _settings(self) -> Message:
        return mavlink.MAVLink_camera_settings_message(self.boot_ms, self._mode, _NAN, _NAN)

    def _storage(self, number: int) -> Sequence[Message]:
        if number not in (0, 1):
            return ()
        space, directory = self.captures.storage, self.captures.directory
        total, used, free = (0.0, 0.0, 0.0) if space is None else (space.total, space.used, space.free)
        usage = mavlink.STORAGE_USAGE_FLAG_SET | mavlink.STORAGE_USAGE_FLAG_PHOTO
        return [
            mavlink.MAVLink_storage_information_message(
                self.boot_ms,
                1,
                1,
                mavlink.STORAGE_STATUS_EMPTY if directory is None else mavlink.STORAGE_STATUS_READY,
                total,
                used,
                free,
                _NAN,
                _NAN,
                mavlink.STORAGE_TYPE_OTHER,
                _text("" if directory is None else directory.name, 32),
                usage | mavlink.STORAGE_USAGE_FLAG_VIDEO,
            )
        ]

    def _capture_status(self) -> Message:
        captures = self.captures
        recording_ms = captures.recording_ms(self._now_ns)
        return mavlink.MAVLink_camera_capture_status_message(
            self.boot_ms,
            captures.image_status,
            int(recording_ms is not None),
            captures.interval_s,
            recording_ms or 0,
            0.0 if captures.storage is None else captures.storage.free,
            captures.image_count,
        )

    def _stream_information(self, number: int) -> Sequence[Message]:
        return [
            mavlink.MAVLink_video_stream_information_message(
                index,
                len(self.streams),
                mavlink.VIDEO_STREAM_TYPE_RTSP,
                mavlink.VIDEO_STREAM_STATUS_FLAGS_RUNNING,
                stream.rate_hz,
                *stream.size,
                stream.bit_rate,
                0,
                self._field_deg,
                _text(stream.name, 32),
                _text(stream.uri, 160),
                stream.encoding,
            )
            for index, stream in self._numbered(number)
        ]

    def _stream_status(self, number: int) -> Sequence[Message]:
        return [
            mavlink.MAVLink_video_stream_status_message(
                index,
                mavlink.VIDEO_STREAM_STATUS_FLAGS_RUNNING,
                stream.rate_hz,
                *stream.size,
                stream.bit_rate,
                0,
                self._field_deg,
            )
            for index, stream in self._numbered(number)
        ]

    def _numbered(self, number: int) -> Iterable[tuple[int, VideoStream]]:
        return [each for each in enumerate(self.streams, 1) if number in (0, each[0])]

    @property
    def _field_deg(self) -> int:
        return round(math.degrees(self.field_rad[0]))

    def _fov_status(self) -> Message:
        place, orientation = self.positions.newest(self._now_ns), self.positions.orientation()
        horizontal_rad, vertical_rad = self.field_rad
        return mavlink.MAVLink_camera_fov_status_message(
            self.boot_ms,
            *_coordinates(place)[:3],
            _UNKNOWN_I32,
            _UNKNOWN_I32,
            _UNKNOWN_I32,
            orientation or _NO_ORIENTATION,
            math.degrees(horizontal_rad),
            math.degrees(vertical_rad),
        )

    def _photo(self, photo: Photo) -> Message:
        """CAMERA_IMAGE_CAPTURED, kept for stations that did not receive it."""
        place, orientation = None, None
        if photo.path is not None:
            place = self.positions.place(photo.captured_ns)
            orientation = self.positions.orientation(photo.captured_ns)
        message = mavlink.MAVLink_camera_image_captured_message(
            photo.captured_ns // 1_000_000 & 0xFFFF_FFFF,
            max(unix_offset_ns() + photo.captured_ns, 0) // 1000,
            0,
            *_coordinates(place),
            orientation or _NO_ORIENTATION,
            photo.index,
            int(photo.path is not None),
            _text("" if photo.path is None else f"{photo.path.parent.name}/{photo.path.name}", 205),
        )
        self._photos[photo.index] = message
        if len(self._photos) > _PHOTOS_KEPT:
            self._photos.pop(next(iter(self._photos)))
        return message

    # --- commands ------------------------------------------------------------------------------------

    def _set_mode(self, command: Command) -> Answer:
        mode = command.whole(1)
        if mode not in (mavlink.CAMERA_MODE_IMAGE, mavlink.CAMERA_MODE_VIDEO):
            return Answer(DENIED)
        self._mode = mode
        return Answer(ACCEPTED, [self._settings()])

    def _streaming(self, command: Command) -> Answer:
        """A viewer of RTSP begins and ends its stream itself."""
        return Answer(ACCEPTED if self._numbered(command.whole(0)) else DENIED)

    def _start_photos(self, command: Command) -> Answer:
        interval_s, count = command.parameters[1], command.whole(2)
        if count < 0 or interval_s < 0 or math.isinf(interval_s):
            return Answer(DENIED)
        if (refused := self._rejection()) is not None:
            return refused
        self.captures.start_photos(0.0 if math.isnan(interval_s) else interval_s, count, command.received_ns)
        return Answer(ACCEPTED)

    def _stop_photos(self, _: Command) -> Answer:
        self.captures.stop_photos()
        return Answer(ACCEPTED, [self._capture_status()])

    def _start_video(self, command: Command) -> Answer:
        if (refused := self._rejection()) is not None:
            return refused
        self.captures.start_video(command.received_ns)
        return Answer(ACCEPTED, [self._capture_status()])

    def _stop_video(self, _: Command) -> Answer:
        self.captures.stop_video()
        return Answer(ACCEPTED, [self._capture_status()])

    def _rejection(self) -> Answer | None:
        """Return the answer to a capture that cannot begin, and warn of its reason."""
        if self.captures.directory is None:
            self._warn("no photos and videos: recording.directory is not set")
            return Answer(DENIED)
        if not self.is_active:
            self._warn(f"no photos and videos of camera {self.label}: the service does not run")
            return Answer(REJECTED)
        return None


def _coordinates(place: Place | None) -> tuple[int, int, int, int]:
    """Return latitude and longitude, 1e-7 degrees, heights above sea and home, mm; INT32_MAX: unknown."""
    if place is None:
        return (_UNKNOWN_I32,) * 4
    heights = (place.altitude_amsl_m, place.altitude_m)
    above_sea, above_home = (_UNKNOWN_I32 if math.isnan(m) else round(m * 1000) for m in heights)
    return (round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7), above_sea, above_home)


def _text(text: str, size: int) -> bytes:
    """Return a text with its final zero, in `size` bytes."""
    return text.encode()[: size - 1].ljust(size, b"\0")


def _firmware_version(version: str) -> int:
    """Return a version as CAMERA_INFORMATION has it: a byte for each number, the first one lowest."""
    numbers = [int(part) for part in version.split(".")[:3] if part.isdecimal()]
    return sum(min(number, 255) << 8 * index for index, number in enumerate(numbers))
