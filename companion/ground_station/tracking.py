"""An operator's clicks on a camera's video become `select`; what is selected goes to stations as its status.

Commands 2004, 2005 and 2010 of the camera protocol (https://mavlink.io/en/services/camera.html), and
CAMERA_TRACKING_IMAGE_STATUS and CAMERA_TRACKING_GEO_STATUS. Pure: the bus and the link are elsewhere.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.bus.bodies.frames import DetectionBody, DetectionsBody, ObjectBody
from companion.bus.bodies.service import CommandStateBody
from companion.bus.bodies.vehicle import VehicleBody
from companion.ground_station.component import Answer, Command, Message, RequestTable, Stream
from companion.host.clock import PAUSED_S
from companion.vehicle.gimbal import Address
from vision.tracking import TARGET_CLASS

Reply = Mapping[str, Any]
SendCommand = Callable[[str, Callable[[Reply], None]], None]
"""Sends a command to the service. Its reply, or {"success": False, "reason": …}, arrives in the same loop."""
Say = Callable[[int, str], None]
"""Sends a STATUSTEXT: MAV_SEVERITY, text."""
Rectangle = tuple[float, float, float, float]
"""Left, top, right, bottom: fractions of the image."""

IMAGE_STATUS = mavlink.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS
GEO_STATUS = mavlink.MAVLINK_MSG_ID_CAMERA_TRACKING_GEO_STATUS
FLAGS = (
    mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_POINT
    | mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
    | mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_GEO_STATUS
)
_IDLE, _ACTIVE, _ERROR = (
    mavlink.CAMERA_TRACKING_STATUS_FLAGS_IDLE,
    mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE,
    mavlink.CAMERA_TRACKING_STATUS_FLAGS_ERROR,
)
_DENIED, _FAILED, _IN_PROGRESS = (
    mavlink.MAV_RESULT_DENIED,
    mavlink.MAV_RESULT_FAILED,
    mavlink.MAV_RESULT_IN_PROGRESS,
)
_REJECTED, _CANCELLED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED, 6  # not in pymavlink 2.4
_WARNING, _INFO = mavlink.MAV_SEVERITY_WARNING, mavlink.MAV_SEVERITY_INFO
_NAN, _UNKNOWN_E7 = math.nan, 2**31 - 1

_MS = 1_000_000
IMAGE_INTERVAL_NS = 100 * _MS
MAX_AGE_NS, LATE_NS, LOST_NS = 140 * _MS, 100 * _MS, 400 * _MS
"""A box is not sent so long after its capture, so that a station gets none older than 150 ms; where frames
usually take more than `LATE_NS` to their publication, `LATE_NS` after it. `LOST_NS` later, as a camera may
have a few frames a second, the status is ERROR.
"""
_DELAYS = 21
# A station may lose a message, and would then show the last rectangle without end.
_IDLE_REPEATED_NS = 2_000 * _MS
_PROGRESS_NS = 500 * _MS
# A station repeats a command whose acknowledgement was lost; QGroundControl after 3 s, without counting it.
_REPEATED_NS = 5_000 * _MS
_MOST_SENDERS = 64
FOLLOW_WITHIN_NS = round(PAUSED_S * 1e9)
"""A click whose selection takes longer is not followed: the operator may want something else by then."""
_OWN_FOLLOW = re.compile(r"follow track=\d+")
# An image that `select` still has (the last second), and whose boxes are where the operator points.
_IMAGE_NS = 500 * _MS
# A click this far beside a box, of the image's width, still means it; and half a side of the square around
# a click on nothing: QGroundControl draws that radius.
POINT_MARGIN, POINT_RADIUS = 0.01, 0.05
# The reason of a successful `select` (vision/tracking/selection.py).
_TRACK = re.compile(r"track (\d+), ")
_EDGES = ("left", "top", "right", "bottom")
_ROUNDING = 1e-6  # of the float32 of a message


class RequestError(ValueError):
    """A station's request cannot be executed. The message is one line."""


def requested_rectangle(parameters: Sequence[float]) -> Rectangle:
    """Return the rectangle of CAMERA_TRACK_RECTANGLE. Raises RequestError."""
    left, top, right, bottom = (
        _fraction(value, name) for value, name in zip(parameters, _EDGES, strict=False)
    )
    if right <= left or bottom <= top:
        raise RequestError(
            f"the rectangle ends at {right:g}, {bottom:g}, expected right of and below its begin, "
            f"{left:g}, {top:g}"
        )
    return left, top, right, bottom


def pointed_rectangle(parameters: Sequence[float], frame: DetectionsBody | None) -> tuple[Rectangle, bool]:
    """Return the rectangle that CAMERA_TRACK_POINT means, and whether an object's. Raises RequestError."""
    x, y = (_fraction(value, name) for value, name in zip(parameters, ("x", "y"), strict=False))
    if frame is not None and (box := box_under(x, y, frame)) is not None:
        return box, True
    across = max(parameters[2], POINT_MARGIN) if 0.0 < parameters[2] <= 1.0 else POINT_RADIUS
    down = across * (4 / 3 if frame is None else frame["width"] / frame["height"])
    return (max(x - across, 0.0), max(y - down, 0.0), min(x + across, 1.0), min(y + down, 1.0)), False


def box_under(x: float, y: float, detections: DetectionsBody) -> Rectangle | None:
    """Return the smallest box of a confirmed track at a point, within `POINT_MARGIN`; None: there is none."""
    width, height = detections["width"], detections["height"]
    margin_px = POINT_MARGIN * width
    under = [
        each["xyxy"]
        for each in detections["detections"]
        if each["track_state"] == "confirmed" and _reaches(each["xyxy"], x * width, y * height, margin_px)
    ]
    if not under:
        return None
    left, top, right, bottom = min(under, key=lambda box: (box[2] - box[0]) * (box[3] - box[1]))
    return max(left / width, 0.0), max(top / height, 0.0), min(right / width, 1.0), min(bottom / height, 1.0)


@dataclass(slots=True)
class Selection:
    """The selected object.

    Attributes:
        track_id: the newest one of its object. seen_ns: capture of the newest frame that shows it.
        as_point: it was asked for as a point.
        frame: the newest one that shows it. detection, seen: of it there; None: not known.
    """

    track_id: int
    seen_ns: int
    as_point: bool = False
    frame: DetectionsBody | None = None
    detection: DetectionBody | None = None
    seen: ObjectBody | None = None

    def find(self, frame: DetectionsBody) -> None:
        """Find it in a frame. Its object may have got another track id."""
        seen = next((each for each in frame["objects"] if self.track_id in each["track_ids"]), None)
        if seen is not None:
            self.track_id = seen["track_ids"][-1]
        found = next((each for each in frame["detections"] if each["track_id"] == self.track_id), None)
        if found is not None:
            self.seen_ns = frame["captured_ns"]
            self.frame, self.detection, self.seen = frame, found, seen


@dataclass(slots=True)
class _Request:
    """A command of a station that waits for the service.

    Attributes:
        result: at the end. mode: of the vehicle when it came. newest_ns: when it was repeated last.
    """

    command: Command
    progress_ns: int
    mode: str | None
    newest_ns: int
    result: int | None = None

    def is_repeated_by(self, command: Command) -> bool:
        """Whether a station sends it again. NaN is not equal to itself, its text is."""
        mine = self.command
        return (mine.sender, mine.number, str(mine.parameters)) == (
            command.sender,
            command.number,
            str(command.parameters),
        )


class Tracking:
    """The tracking of one camera.

    Args:
        camera: as `select` names it. component_id: of its component.
        requests: of that component; what this class executes is added.
        max_age_s: `tracker.max_age_s`; what is unseen for longer has ended.
        steers: it is the steering camera, whose tracks commands can be about.
        follows: what is selected is also followed.

    Attributes:
        selection: the selected object, also by others than stations. newest: frame of the camera.
        streams: message id → when it is sent.
    """

    def __init__(
        self,
        camera: str,
        component_id: Callable[[], int],
        requests: RequestTable,
        *,
        max_age_s: float,
        steers: bool,
        follows: bool,
        send: SendCommand,
        say: Say,
    ) -> None:
        self._camera, self._component_id = camera, component_id
        self._max_age_s = max_age_s
        self._steers, self._follows, self._send, self._say = steers, follows, send, say
        self.selection: Selection | None = None
        self.streams = requests.streams
        self.streams |= {IMAGE_STATUS: Stream(IMAGE_INTERVAL_NS), GEO_STATUS: Stream(None)}
        self.newest: DetectionsBody | None = None
        self._delays_ns: deque[int] = deque(maxlen=_DELAYS)
        self._now_ns = self._idle_until_ns = 0
        self._pending: list[_Request] = []
        self._clicks: dict[Address, _Request] = {}  # the newest of each sender
        self._unsent: list[Message] = []
        self._mode: str | None = None
        self._to_follow: tuple[int, _Request] | None = None  # track, and the click that selected it
        self._follow_sent_ns: int | None = None  # of a `follow` that the service has not answered yet
        self._open: dict[str, tuple[str, int]] = {}  # id of a command that has not ended → text, time
        self._ended = ""  # id of the one that has ended last
        self._service: str | None = None
        requests.actions |= {
            mavlink.MAV_CMD_CAMERA_TRACK_POINT: self._on_track,
            mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE: self._on_track,
            mavlink.MAV_CMD_CAMERA_STOP_TRACKING: self._on_stop,
        }
        requests.replies |= {
            IMAGE_STATUS: lambda _: [self._image_status()],
            GEO_STATUS: lambda _: [self._geo_status()],
        }

    # --- from the bus --------------------------------------------------------------------------------

    def on_detections(self, frame: DetectionsBody) -> None:
        """Use the newest frame."""
        self.newest = frame
        self._delays_ns.append(frame["published_ns"] - frame["captured_ns"])
        if (selection := self.selection) is None:
            return
        selection.find(frame)
        if frame["captured_ns"] - selection.seen_ns > self._max_age_s * 1e9:
            self._select(None)
            self._say(_INFO, f"track {selection.track_id} has ended: select the object again")

    def on_command_state(self, body: CommandStateBody) -> None:
        """Note which command is flown, and what anybody selects."""
        identifier, ended = body["id"], body["state"] == "ended"
        if not ended:
            self._open.setdefault(identifier, (body["command"], body["stamp_ns"]))
        elif self._open.pop(identifier, None) is not None:
            self._ended = identifier
        if ended and body["success"] and self._is_select(body["command"]):
            found = _TRACK.match(body["reason"])
            track_id = None if found is None else int(found[1])
            if track_id != (None if self.selection is None else self.selection.track_id):
                self._select(track_id)

    def on_vehicle(self, vehicle: VehicleBody) -> None:
        """Use the vehicle's mode: a pilot may change it between a click and its `follow`."""
        self._mode = vehicle["mode"]

    def on_service(self, service: str) -> None:
        """Forget what another process of the service knew. `service`: of its status."""
        if self._service not in (None, service):
            self._select(None)
            self.newest = self._to_follow = self._follow_sent_ns = None
        self._open = {key: each for key, each in self._open.items() if key.rpartition("-")[0] == service}
        self._service = service

    def abandon_clicks(self) -> None:
        """The computer or this process stood still: no click from before may select or fly."""
        self._to_follow = None
        for request in tuple(self._pending):
            if request.command.number != mavlink.MAV_CMD_CAMERA_STOP_TRACKING:
                self._finish(request, _FAILED)

    # --- the component -------------------------------------------------------------------------------

    def due(self, now_ns: int) -> list[Message]:
        """Return what is to be sent now. Called at least 20 times a second."""
        self._now_ns = now_ns
        if self._to_follow is not None:
            selected, self._to_follow = self._to_follow, None
            self._follow(*selected)
        for request in self._pending:
            if now_ns >= request.progress_ns:
                request.progress_ns = now_ns + _PROGRESS_NS
                self._unsent.append(_ack(request.command, _IN_PROGRESS))
        messages, self._unsent = self._unsent, []
        frame = None if self.selection is None else self.selection.frame
        status, _ = self._status()
        waits = status == _ERROR and self._late_ns < LOST_NS
        if waits or (self.selection is None and now_ns > self._idle_until_ns):
            return messages
        sequence = frame["sequence"] if frame is not None and status == _ACTIVE else None
        for message_id, make in ((IMAGE_STATUS, self._image_status), (GEO_STATUS, self._geo_status)):
            if self.streams[message_id].is_due(now_ns, sequence):
                messages.append(make())
        return messages

    def _on_track(self, command: Command) -> Answer:
        self._now_ns = command.received_ns
        point = command.number == mavlink.MAV_CMD_CAMERA_TRACK_POINT
        if not self._is_ours(command, 3 if point else 4):
            return Answer(mavlink.MAV_RESULT_UNSUPPORTED)
        if any(request.is_repeated_by(command) for request in self._pending):
            return Answer(_IN_PROGRESS)
        if self._pending:
            return Answer(_REJECTED)
        if (repeated := self._answer_to_repetition(command)) is not None:
            return repeated
        if (flown := self._flown_by_others()) is not None:
            self._say(_WARNING, f"not selected: {flown!r} needs the object selected now: end it first")
            return Answer(_DENIED)
        frame, on_object = self.newest, True
        if frame is not None and self._now_ns - frame["captured_ns"] > _IMAGE_NS:
            frame = None
        try:
            if point:
                rectangle, on_object = pointed_rectangle(command.parameters, frame)
            else:
                rectangle = requested_rectangle(command.parameters)
        except RequestError as error:
            self._say(_WARNING, f"not selected: {error}")
            return Answer(_DENIED)
        text = _select_text(self._camera, rectangle, None if frame is None else frame["captured_ns"])
        request = self._clicks[command.sender] = self._begin(command)
        if len(self._clicks) > _MOST_SENDERS:
            self._clicks.pop(next(iter(self._clicks)))
        self._send(text, partial(self._on_selected, request, as_point=point, on_object=on_object))
        return Answer(None)

    def _answer_to_repetition(self, command: Command) -> Answer | None:
        """Return the answer to a click that a station only sends again: it must not select and fly again."""
        before = self._clicks.get(command.sender)
        if (
            before is None
            or before.result not in (mavlink.MAV_RESULT_ACCEPTED, _CANCELLED)
            or not before.is_repeated_by(command)
            or command.received_ns - before.newest_ns >= _REPEATED_NS
        ):
            return None
        before.newest_ns = command.received_ns
        if before.result == mavlink.MAV_RESULT_ACCEPTED and self.selection is not None:
            return Answer(before.result)
        self._say(_WARNING, "not selected: the same click has ended; to repeat it, wait for 5 s")
        return Answer(_REJECTED)

    def _flown_by_others(self) -> str | None:
        """Return the open command of another that would lose its object with the selection; None: none."""
        selection = self.selection
        if selection is None or not self._steers:
            return None
        detection = selection.detection
        if detection is not None and detection["class_name"] != TARGET_CLASS:
            return None  # the detector's track goes on
        objects = {f"track={selection.track_id}", f"class={TARGET_CLASS}", TARGET_CLASS}
        open_texts = (text for text, _ in self._open.values())
        return next(
            (each for each in open_texts if objects & {*each.split()} and not self._is_own(each)), None
        )

    def _is_own(self, text: str) -> bool:
        """Whether a command is as a click sends it: after a restart of this process nothing else is known."""
        return self._follows and _OWN_FOLLOW.fullmatch(text) is not None

    def _on_selected(self, request: _Request, reply: Reply, *, as_point: bool, on_object: bool) -> None:
        track_id = reply.get("track")
        if request.result is not None:  # cancelled: what was selected now ends with the command behind it
            return
        if not reply["success"] or not isinstance(track_id, int):
            self._say(_WARNING, f"not selected: {reply['reason']}")
            self._finish(request, _FAILED)
            return
        if self.selection is None or self.selection.track_id != track_id:
            self._select(track_id)
        if self.selection is not None:
            self.selection.as_point = as_point
        self._finish(request, mavlink.MAV_RESULT_ACCEPTED)
        if not self._follows:
            return
        if not self._steers:
            self._say(_INFO, "not followed: this is not the steering camera")
        elif not on_object:
            self._say(_INFO, "not followed: no object is at this point; draw a rectangle around it")
        else:  # with the time of `due`: this process may have stood still since its newest call
            self._to_follow = track_id, request

    def _follow(self, track_id: int, request: _Request) -> None:
        if self._now_ns - request.command.received_ns > FOLLOW_WITHIN_NS:
            self._say(_WARNING, f"not followed: the selection took longer than {PAUSED_S:g} s; click again")
        elif request.mode != self._mode:
            self._say(
                _WARNING, f"not followed: the mode has become {self._mode} since the click; click again"
            )
        else:
            self._follow_sent_ns, text = self._now_ns, f"follow track={track_id}"
            self._send(text, partial(self._on_follow, text, self._now_ns))

    def _on_follow(self, text: str, sent_ns: int, reply: Reply) -> None:
        if self._follow_sent_ns == sent_ns:
            self._follow_sent_ns = None
        if not reply["success"]:  # without an id it may yet be executed
            self._say(_WARNING, f"not followed: {reply['reason']}")
        elif (identifier := reply["id"]) != self._ended:  # command_state may come later
            self._open.setdefault(identifier, (text, sent_ns))

    def _on_stop(self, command: Command) -> Answer:
        self._now_ns = command.received_ns
        if not self._is_ours(command, 0):
            return Answer(mavlink.MAV_RESULT_UNSUPPORTED)
        for request in tuple(self._pending):
            if request.command.number == command.number:  # one does the same for all
                return Answer(_IN_PROGRESS if request.is_repeated_by(command) else _REJECTED)
            self._finish(request, _CANCELLED)
        if (flown := self._flown_by_others()) is not None:
            self._say(_WARNING, f"still selected: {flown!r} needs the object: end that command instead")
            return Answer(_DENIED)
        # Held first: a vehicle whose object is gone would brake with a warning.
        texts = ["hold"] if self._is_following() else []
        self._to_follow = self._follow_sent_ns = None
        self._stop(self._begin(command), [*texts, f"select camera={self._camera}"])
        return Answer(None)

    def _stop(self, request: _Request, texts: Sequence[str], reply: Reply | None = None) -> None:
        """Send what is left of a stop, and answer it after the last."""
        if reply is not None and not reply["success"]:
            self._say(_WARNING, f"{reply.get('command', 'stop')}: {reply['reason']}")
            request.result = _FAILED
        if texts:
            self._send(texts[0], partial(self._stop, request, texts[1:]))
            return
        if request.result is None:
            self._select(None)
        self._finish(request, mavlink.MAV_RESULT_ACCEPTED if request.result is None else request.result)

    def _is_following(self) -> bool:
        """Whether the vehicle's newest command is a click's `follow`, and it has not ended."""
        text, stamp_ns = next(reversed(self._open.values()), ("", 0))
        on_its_way = self._follow_sent_ns is not None and stamp_ns < self._follow_sent_ns
        return on_its_way or self._is_own(text)

    def _begin(self, command: Command) -> _Request:
        received_ns = command.received_ns
        request = _Request(command, received_ns + _PROGRESS_NS, self._mode, received_ns)
        self._pending.append(request)
        return request

    def _finish(self, request: _Request, result: int) -> None:
        if request in self._pending:
            request.result = result
            self._pending.remove(request)
            self._unsent.append(_ack(request.command, result))

    def _select(self, track_id: int | None) -> None:
        self._idle_until_ns = self._now_ns + _IDLE_REPEATED_NS
        self.selection = None if track_id is None else Selection(track_id, self._now_ns)
        if self.selection is not None and self.newest is not None:
            self.selection.find(self.newest)

    def _is_ours(self, command: Command, index: int) -> bool:
        """Whether a command names no other camera: those up to 6 are cameras of an autopilot, 0 is all."""
        return not 6 < command.whole(index) != self._component_id()

    def _is_select(self, text: str) -> bool:
        word, _, rest = text.partition(" ")
        camera = next((each[7:] for each in rest.split() if each.startswith("camera=")), None)
        return word == "select" and (camera == self._camera or (camera is None and self._steers))

    # --- status --------------------------------------------------------------------------------------

    def _status(self) -> tuple[int, DetectionBody | None]:
        """CAMERA_TRACKING_STATUS_FLAGS, and the detection while it is ACTIVE."""
        if self.selection is None:
            return int(_IDLE), None
        if self._late_ns > 0:
            return int(_ERROR), None
        return int(_ACTIVE), self.selection.detection

    @property
    def _late_ns(self) -> float:
        """How long the newest box of the selected object is too old to be sent; below 0: it is not."""
        if self.selection is None or self.selection.frame is None:
            return math.inf
        usual_ns = median(self._delays_ns)
        limit_ns = MAX_AGE_NS if usual_ns <= LATE_NS else usual_ns + LATE_NS
        return self._now_ns - self.selection.frame["captured_ns"] - limit_ns

    def _image_status(self) -> Message:
        (status, detection), selection = self._status(), self.selection
        mode, data = mavlink.CAMERA_TRACKING_MODE_NONE, 0
        values = [_NAN] * 7  # x, y and radius of a point; edges of a rectangle
        if selection is not None:
            point = selection.as_point
            mode = mavlink.CAMERA_TRACKING_MODE_POINT if point else mavlink.CAMERA_TRACKING_MODE_RECTANGLE
            if detection is not None and selection.frame is not None:
                data = mavlink.CAMERA_TRACKING_TARGET_DATA_IN_STATUS
                width, height = selection.frame["width"], selection.frame["height"]
                left, top, right, bottom = detection["xyxy"]
                if point:
                    radius = max(right - left, bottom - top) / 2 / width
                    values[:3] = [(left + right) / 2 / width, (top + bottom) / 2 / height, radius]
                else:
                    values[3:] = [left / width, top / height, right / width, bottom / height]
        return mavlink.MAVLink_camera_tracking_image_status_message(status, mode, data, *values)

    def _geo_status(self) -> Message:
        """Latitude and longitude are INT32_MAX where the position is not known."""
        status, detection = self._status()
        seen = None if self.selection is None or detection is None else self.selection.seen
        latitude = longitude = _UNKNOWN_E7
        altitude, h_acc, speed_acc, distance = _NAN, _NAN, _NAN, _NAN
        velocity, course = (_NAN, _NAN), _NAN
        if detection is not None and detection["distance_m"] is not None:
            distance = detection["distance_m"]
        if seen is not None and seen["latitude_deg"] is not None and seen["longitude_deg"] is not None:
            latitude, longitude = round(seen["latitude_deg"] * 1e7), round(seen["longitude_deg"] * 1e7)
            altitude = _NAN if seen["altitude_amsl_m"] is None else seen["altitude_amsl_m"]
            h_acc, speed_acc = _sigmas(seen["covariance"])
            velocity = seen["velocity_ned_mps"][0], seen["velocity_ned_mps"][1]
            course = math.atan2(velocity[1], velocity[0]) if seen["moving"] else _NAN
        return mavlink.MAVLink_camera_tracking_geo_status_message(
            status,
            latitude,
            longitude,
            altitude,
            h_acc,
            _NAN,
            *velocity,
            _NAN,
            speed_acc,
            distance,
            course,
            _NAN,
        )


def _sigmas(covariance: Sequence[float]) -> tuple[float, float]:
    """Return the one-sigma errors along the longest axes of a position and of its velocity.

    Args:
        covariance: row by row, of north, east and their velocities.
    """
    first, second = (
        _largest_eigenvalue(covariance[at], covariance[at + 1], covariance[at + 5]) for at in (0, 10)
    )
    return math.sqrt(max(first, 0.0)), math.sqrt(max(second, 0.0))


def _largest_eigenvalue(a: float, b: float, d: float) -> float:
    """Of the symmetric matrix [[a, b], [b, d]]."""
    return (a + d) / 2 + math.hypot((a - d) / 2, b)


def _select_text(camera: str, rectangle: Rectangle, stamp_ns: int | None) -> str:
    left, top, right, bottom = (round(edge, 6) for edge in rectangle)
    stamp = "" if stamp_ns is None else f" stamp_ns={stamp_ns}"
    size = f"width={right - left:.6f} height={bottom - top:.6f}"
    return f"select x={left:.6f} y={top:.6f} {size} camera={camera}{stamp}"


def _fraction(value: float, name: str) -> float:
    if not -_ROUNDING <= value <= 1.0 + _ROUNDING:  # nor NaN
        raise RequestError(f"{name} is {value:g}, expected 0 to 1, a fraction of the image")
    return min(max(value, 0.0), 1.0)


def _reaches(box: Sequence[float], x: float, y: float, margin: float) -> bool:
    left, top, right, bottom = box
    return left - margin <= x <= right + margin and top - margin <= y <= bottom + margin


def _ack(command: Command, result: int) -> Message:
    progress = 255 if result == _IN_PROGRESS else 0  # not known
    return mavlink.MAVLink_command_ack_message(command.number, result, progress, 0, *command.sender)
