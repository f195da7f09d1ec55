"""Detections of one frame: parallel arrays, validated on construction, sliceable."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray


class _OptionalFields(TypedDict):
    track_id: NotRequired[int | None]
    track_score: NotRequired[float | None]
    track_state: NotRequired[str | None]
    middle_px: NotRequired[float]


class DetectionRecord(_OptionalFields):
    """One detection as plain values, ready for JSON. `xyxy` and `center` are pixels of the frame.

    `depth_m` and `nearest_camera_m` are as in `Detections`, None where unknown; so is `middle_px`, left out
    where unknown. `track_id` and `track_score` are None for a detection without a track; `track_state` is
    then `none`, and None without tracking.
    """

    class_id: int
    class_name: str
    confidence: float
    xyxy: list[float]
    center: list[float]
    depth_m: float | None
    nearest_camera_m: list[float] | None


TRACK_NONE, TRACK_TENTATIVE, TRACK_CONFIRMED = "none", "tentative", "confirmed"
"""A record's `track_state`: no track, tentative (possibly a false detection), confirmed."""
NO_TRACK = -1
"""In `Detections.track_id`: no track."""


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """N detections of one frame.

    Attributes:
        xyxy: (N, 4) float32, pixels of the frame: left, top, right, bottom.
        confidence: (N,) float32 in 0..1.
        class_id: (N,) int64, index into `class_names`.
        class_names: the model's class table, id → name.
        nearest_camera_m: (N, 3) float32, optical frame, metres right, down and forward of the lens: the
            horizontally nearest point of the object's visible surface. NaN where unknown.
        middle_px: (N,) float32, column of the middle between the object's ends: the nearer end looks larger,
            so it is not the box's centre. NaN where unknown.
        track_id: (N,) int64, 1 or more, `NO_TRACK` for none. Set together with the next two; all None without
            tracking.
        track_score: (N,) float32, the track's median confidence, NaN without a track.
        track_confirmed: (N,) bool, whether the track is confirmed and its class is not in doubt.
        track_first_ns: (N,) int64, capture stamp of the track's first detection, 0 without a track; None: not
            known.

    >>> import numpy as np
    >>> from vision import Detections
    >>> found = Detections(
    ...     np.array([[10, 20, 50, 60], [70, 20, 90, 40]], np.float32),
    ...     np.array([0.9, 0.4], np.float32),
    ...     np.array([1, 0]),
    ...     ("person", "car"),
    ... )
    >>> found.names, found[found.confidence > 0.5].center.tolist()
    (['car', 'person'], [[30.0, 40.0]])
    """

    xyxy: NDArray[np.float32]
    confidence: NDArray[np.float32]
    class_id: NDArray[np.int64]
    class_names: tuple[str, ...]
    nearest_camera_m: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    track_id: NDArray[np.int64] | None = None
    track_score: NDArray[np.float32] | None = None
    track_confirmed: NDArray[np.bool_] | None = None
    track_first_ns: NDArray[np.int64] | None = None
    middle_px: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))

    def __post_init__(self) -> None:
        count = len(self.xyxy)
        if self.nearest_camera_m.shape == (0, 3) and count:
            object.__setattr__(self, "nearest_camera_m", np.full((count, 3), np.nan, np.float32))
        if self.middle_px.shape == (0,) and count:
            object.__setattr__(self, "middle_px", np.full(count, np.nan, np.float32))
        if self.xyxy.shape != (count, 4):
            raise ValueError(f"Detections.xyxy must be (N, 4), got {self.xyxy.shape}")
        if self.nearest_camera_m.shape != (count, 3):
            shape = self.nearest_camera_m.shape
            raise ValueError(f"Detections.nearest_camera_m must be ({count}, 3) like xyxy, got {shape}")
        for name in ("confidence", "class_id", "middle_px"):
            shape = getattr(self, name).shape
            if shape != (count,):
                raise ValueError(f"Detections.{name} must be ({count},) like xyxy, got {shape}")
        tracks = {name: getattr(self, name) for name in ("track_id", "track_score", "track_confirmed")}
        missing = [name for name, values in tracks.items() if values is None]
        if missing and len(missing) < len(tracks):
            raise ValueError(f"Detections needs all of {', '.join(tracks)} or none; {missing[0]} is missing")
        for name, values in {**tracks, "track_first_ns": self.track_first_ns}.items():
            if values is not None and values.shape != (count,):
                raise ValueError(f"Detections.{name} must be ({count},) like xyxy, got {values.shape}")
        if count and not (0 <= int(self.class_id.min()) and int(self.class_id.max()) < len(self.class_names)):
            raise ValueError(
                f"Detections.class_id must be 0..{len(self.class_names) - 1}, got {self.class_id}"
            )

    @classmethod
    def empty(cls, class_names: tuple[str, ...]) -> Detections:
        """No detections, with the class table of a model."""
        return cls(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int64), class_names)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as three writable byte buffers: many arrays took ten times as long."""
        floats, integers = (
            [self.xyxy.ravel(), self.confidence, self.nearest_camera_m.ravel(), self.middle_px],
            [self.class_id],
        )
        tracked, bool_bytes, first_known = False, bytearray(), self.track_first_ns is not None
        if self.track_id is not None and self.track_score is not None and self.track_confirmed is not None:
            floats.append(self.track_score)
            integers.append(self.track_id)
            tracked, bool_bytes = True, bytearray(self.track_confirmed)
        if self.track_first_ns is not None:
            integers.append(self.track_first_ns)
        float_bytes = bytearray(np.concatenate(floats, dtype=np.float32))
        int_bytes = bytearray(np.concatenate(integers, dtype=np.int64))
        return _unpickled, (
            self.class_names,
            len(self),
            float_bytes,
            int_bytes,
            bool_bytes,
            tracked,
            first_known,
        )

    def __len__(self) -> int:
        return len(self.xyxy)

    def __iter__(self) -> Iterator[DetectionRecord]:
        return iter(self.records())

    def __getitem__(self, index: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Detections:
        """The detections at a slice, a boolean mask or an index array."""
        return Detections(
            self.xyxy[index],
            self.confidence[index],
            self.class_id[index],
            self.class_names,
            self.nearest_camera_m[index],
            None if self.track_id is None else self.track_id[index],
            None if self.track_score is None else self.track_score[index],
            None if self.track_confirmed is None else self.track_confirmed[index],
            None if self.track_first_ns is None else self.track_first_ns[index],
            self.middle_px[index],
        )

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """(N,) float32, metres along the optical axis to `nearest_camera_m`, NaN where unknown."""
        return self.nearest_camera_m[:, 2]

    @property
    def center(self) -> NDArray[np.float32]:
        """(N, 2) float32, pixels: x, y of each box's centre."""
        return ((self.xyxy[:, :2] + self.xyxy[:, 2:]) / 2).astype(np.float32)

    @property
    def names(self) -> list[str]:
        """The class name of each detection."""
        return [self.class_names[index] for index in self.class_id]

    def of_class(self, class_name: str) -> Detections:
        """The detections of one class; empty if the model does not have the class."""
        return self[np.array([name == class_name for name in self.names], dtype=np.bool_)]

    def records(self) -> list[DetectionRecord]:
        """Plain values, rounded to their precision (0.01 px, 0.0001, 1 mm)."""
        values = zip(
            self.class_id.tolist(),
            self.confidence.tolist(),
            self.xyxy.tolist(),
            self.center.tolist(),
            self.nearest_camera_m.tolist(),
            strict=True,
        )
        records = [
            DetectionRecord(
                class_id=class_id,
                class_name=self.class_names[class_id],
                confidence=round(confidence, 4),
                xyxy=[round(edge, 2) for edge in xyxy],
                center=[round(middle, 2) for middle in center],
                depth_m=None if math.isnan(nearest[2]) else round(nearest[2], 3),
                nearest_camera_m=None if math.isnan(nearest[2]) else [round(value, 3) for value in nearest],
                **self._track_record(index),
            )
            for index, (class_id, confidence, xyxy, center, nearest) in enumerate(values)
        ]
        for index in np.flatnonzero(np.isfinite(self.middle_px)).tolist():
            records[index]["middle_px"] = round(float(self.middle_px[index]), 2)
        return records

    def _track_record(self, index: int) -> _OptionalFields:
        if self.track_id is None or self.track_score is None or self.track_confirmed is None:
            return {"track_id": None, "track_score": None, "track_state": None}
        if self.track_id[index] == NO_TRACK:
            return {"track_id": None, "track_score": None, "track_state": TRACK_NONE}
        return {
            "track_id": int(self.track_id[index]),
            "track_score": round(float(self.track_score[index]), 4),
            "track_state": TRACK_CONFIRMED if self.track_confirmed[index] else TRACK_TENTATIVE,
        }


def _unpickled(
    class_names: tuple[str, ...],
    count: int,
    float_bytes: bytearray,
    int_bytes: bytearray,
    bool_bytes: bytearray,
    tracked: bool,
    first_known: bool,
) -> Detections:
    floats, integers = np.frombuffer(float_bytes, np.float32), np.frombuffer(int_bytes, np.int64)
    return Detections(
        floats[: 4 * count].reshape(count, 4),
        floats[4 * count : 5 * count],
        integers[:count],
        class_names,
        floats[5 * count : 8 * count].reshape(count, 3),
        integers[count : 2 * count] if tracked else None,
        floats[9 * count :] if tracked else None,
        np.frombuffer(bool_bytes, np.bool_) if tracked else None,
        integers[-count:] if first_known else None,
        floats[8 * count : 9 * count],
    )
