"""Events of objects from the topic `tracks`: their identity, their rate, and their snapshots."""

from __future__ import annotations

import base64
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from companion.mqtt.object_events import ObjectEvent, ObjectEvents

S = 1_000_000_000


class Sender:
    """ObjectEvents with messages as the service sends them."""

    def __init__(self) -> None:
        self.wanted: list[tuple[str | None, bool]] = []
        self.events = ObjectEvents(lambda *wanted: self.wanted.append(wanted), lambda: 1_700_000_000 * S)

    def tracks(
        self, stamp_ns: int, *events: tuple[str, int, int | None], camera: str | None = None
    ) -> list[ObjectEvent]:
        """Process one message; events are kind, track id and object id."""
        body = {
            "vehicle": "v",
            "camera": camera,
            "width": 640,
            "height": 480,
            "events": [track_event(stamp_ns, *event) for event in events],
        }
        return self.events.on_tracks(body, stamp_ns)

    def said(self, stamp_ns: int, *events: tuple[str, int, int | None]) -> list[tuple[str, str]]:
        """The same, as kind and id; an image comes at once."""
        sent = self.tracks(stamp_ns, *events) + self.events.on_image(None, stamp_ns, b"jpeg")
        return [(event.kind, event.about["id"]) for event in sent]


def track_event(stamp_ns: int, kind: str, track: int, number: int | None) -> dict[str, Any]:
    place = {"latitude_deg": 47.1, "longitude_deg": 8.5, "altitude_amsl_m": 490.0}
    return {
        "event": kind,
        "stamp_ns": stamp_ns,
        "track_id": track,
        "object_id": number,
        "class_name": "Kuh, schöne",
        "confidence": 0.8,
        "xyxy": [64.0, 48.0, 320.0, 240.0],
        "first_ns": 0,
        "last_ns": stamp_ns,
        "moving": False,
        "error_ellipse": {"semi_major_m": 0.4, "semi_minor_m": 0.3, "orientation_rad": 0.0},
        **place,
    }


def test_an_object_is_one_sequence_of_events_while_its_track_changes() -> None:
    sender = Sender()
    assert sender.said(1 * S, ("new", 1, 7)) == [("new", "object-7")]
    assert sender.said(2 * S, ("lost", 1, 7)) == [("lost", "object-7")]
    assert sender.said(3 * S, ("new", 2, 7)) == [("update", "object-7")]  # it is back, with another track
    assert sender.said(4 * S, ("end", 1, 7)) == []
    assert sender.said(5 * S, ("lost", 2, 7)) == [("lost", "object-7")]
    assert sender.said(6 * S, ("end", 2, 7)) == [("end", "object-7")]
    assert sender.said(7 * S, ("new", 3, 7)) == [("new", "object-7")]


def test_a_track_keeps_its_id_when_its_range_becomes_known() -> None:
    sender = Sender()
    assert sender.said(1 * S, ("new", 5, None)) == [("new", "track-5")]
    assert sender.said(3 * S, ("update", 5, 1)) == [("update", "track-5")]
    assert sender.said(4 * S, ("end", 5, None)) == [("end", "track-5")]


def test_updates_come_at_most_once_a_second_and_at_once_after_a_loss() -> None:
    sender = Sender()
    sender.said(0, ("new", 1, 1))
    said = [sender.said(ms * 1_000_000, ("update", 1, 1)) for ms in range(50, 3050, 50)]
    assert sum(map(len, said)) == 3
    assert sender.said(int(3.05 * S), ("lost", 1, 1)) == [("lost", "object-1")]
    assert sender.said(int(3.1 * S), ("update", 1, 1)) == [("update", "object-1")]


def test_what_was_there_before_is_new_here() -> None:
    sender = Sender()
    assert sender.said(1 * S, ("lost", 8, 2), ("end", 9, 3)) == []
    assert sender.said(2 * S, ("update", 8, 2)) == [("new", "object-2")]


def test_new_waits_for_an_image_that_is_not_older() -> None:
    sender = Sender()
    assert sender.tracks(5 * S, ("new", 1, 1)) == []
    assert sender.wanted == [(None, True)]
    assert sender.tracks(int(5.1 * S), ("new", 2, 2), ("lost", 1, 1)) == []
    assert sender.events.on_image(None, 4 * S, b"old") == []
    first, second, lost = sender.events.on_image(None, 5 * S, b"jpeg")
    assert [first.kind, second.kind, lost.kind] == ["new", "new", "lost"]
    assert first.snapshot == b"jpeg"
    assert second.snapshot is None  # the image is older than it
    assert lost.snapshot is None
    assert sender.wanted == [(None, True), (None, False)]
    body = first.body(with_snapshot=True)
    assert base64.b64decode(body.pop("snapshot")) == b"jpeg"
    assert body == first.body(with_snapshot=False)
    assert body["time"] == "2023-11-14T22:13:25.000Z"
    assert body["box"] == [0.1, 0.1, 0.5, 0.5]
    assert (body["class"], body["error_m"]) == ("Kuh, schöne", 0.4)


def test_new_is_sent_without_an_image_after_a_second() -> None:
    sender = Sender()
    sender.tracks(5 * S, ("new", 1, 1), camera="rear")
    assert sender.events.due(int(5.9 * S)) == []
    (event,) = sender.events.due(6 * S)
    assert (event.kind, event.camera, event.snapshot) == ("new", "rear", None)
    assert sender.wanted == [("rear", True), ("rear", False)]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["new", "update", "lost", "end"]),
            st.integers(1, 4),
            st.sampled_from([None, 1, 2]),
            st.integers(0, 2 * S),
        ),
        max_size=60,
    )
)
def test_every_object_begins_once_and_ends_once(steps: list[tuple[str, int, int | None, int]]) -> None:
    sender, now_ns, alive = Sender(), 0, set[str]()
    for kind, track, number, pause_ns in steps:
        now_ns += pause_ns
        for said, name in sender.said(now_ns, (kind, track, number)):
            assert (name in alive) is (said != "new")
            (alive.discard if said == "end" else alive.add)(name)
