"""`companion learn collect`: frames in which the detector was in doubt, as a data set to label.

Such frames teach a detector most. Each is labelled with the model's own boxes, to be corrected by hand.
"""

from __future__ import annotations

import json
import queue
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import yaml

from companion.bus.client import message_of, open_client
from companion.bus.topics import DETECTIONS, IMAGE, Topic
from companion.host.peer_data import PeerDataError, parse_object
from companion.logs.frames import DetectedFrame
from companion.recording import RecordingError
from companion.settings import ZenohSection
from vision.class_names import fold_name
from vision.detections import TRACK_CONFIRMED, TRACK_TENTATIVE
from vision.image_file import decode_image
from vision.plain_yaml import load_plain_yaml
from vision.text_file import read_text

DOUBTED, LOST, CHANGED = "doubted", "lost", "changed class"
# The last of every five parts of a flight is for validation. At its ends nothing is kept: these images would
# look like those to train on.
PART_S, PARTS, GAP_S = 30.0, 5, 5.0
# A track is confirmed after `tracker.min_hits` detections, 3 by default, if its scores and class allow it.
DOUBTED_FRAMES = 5
# The same doubt about the same track again counts as new after this.
REPEAT_S = 10.0
# A lost track whose box was this near to the image's edge has left the image: share of its width.
EDGE = 0.02
# Messages that wait for their image: about two seconds of a fast camera.
_MOST_WAITING = 100
_POLL_S = 0.1


class DoubtFinder:
    """Compares each frame's tracks with those of the frame before."""

    def __init__(self) -> None:
        self._confirmed: dict[int, dict[str, Any]] = {}
        self._class_of: dict[int, str] = {}
        self._tentative: Counter[int] = Counter()

    def update(self, message: dict[str, Any]) -> list[str]:
        """The reasons to keep a frame, such as `doubted car 12`; empty for none.

        Doubted is a track that is not confirmed by its fifth detection: low scores, or two classes. Lost is a
        confirmed one that the frame before had, and that was not at the edge. `message`: on `detections`.
        """
        tracks = {one["track_id"]: one for one in message["detections"] if one["track_id"] is not None}
        reasons = []
        for number, one in tracks.items():
            before = self._class_of.get(number, one["class_name"])
            if before != one["class_name"]:
                reasons.append(f"{CHANGED} {before} {number} to {one['class_name']}")
            self._tentative[number] += one["track_state"] == TRACK_TENTATIVE
            if self._tentative[number] >= DOUBTED_FRAMES and one["track_state"] == TRACK_TENTATIVE:
                reasons.append(f"{DOUBTED} {one['class_name']} {number}")
        for number, one in self._confirmed.items():
            if number not in tracks and not _at_edge(one["xyxy"], message["width"], message["height"]):
                reasons.append(f"{LOST} {one['class_name']} {number}")
        self._class_of |= {number: one["class_name"] for number, one in tracks.items()}
        self._confirmed = {n: one for n, one in tracks.items() if one["track_state"] == TRACK_CONFIRMED}
        return reasons


def _at_edge(xyxy: list[float], width: int, height: int) -> bool:
    margin = EDGE * width
    left, top, right, bottom = xyxy
    return min(left, top, width - right, height - bottom) < margin


def split_at(elapsed_s: float) -> str | None:
    """`train` or `val`, by the time since a flight's first frame; None between the two."""
    into_s = elapsed_s % (PART_S * PARTS) - PART_S * (PARTS - 1)
    if into_s < 0:
        return "train"
    return "val" if GAP_S <= into_s < PART_S - GAP_S else None


class LabelFolder:
    """A YOLO data set that grows: images, labels and `data.yaml`.

    An existing one is continued. Of its `data.yaml` only `names` is extended, and a missing `val` is added.

    Raises:
        OSError: it cannot be written. ValueError: its `data.yaml` has no list of names, or its splits do not
            have the folders of images.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._file = folder, folder / "data.yaml"
        self._text, self._names = "train: images/train\nnames: []\n", list[str]()
        self._splits: dict[str, Any] = {"train": "images/train"}
        if self._file.is_file():
            self._text = read_text(self._file)
            table = load_plain_yaml(self._text)
            names = table.get("names") if isinstance(table, dict) else None
            if not isinstance(names, list):
                raise ValueError(
                    f"{self._file}: expected a list `names`, as `companion learn collect` writes it"
                )
            self._names = [str(name) for name in names]
            self._splits = {split: table[split] for split in ("train", "val") if table.get(split)}
            self._check_splits(folder / str(table.get("path") or ""))
        self._index_of = {fold_name(name): index for index, name in reversed([*enumerate(self._names)])}

    def _check_splits(self, base: Path) -> None:
        base = base if base.is_dir() else self._folder  # as `open_dataset`
        for split, value in self._splits.items():
            images = self._folder / "images" / split
            entries = [base / str(one) for one in (value if isinstance(value, list) else [value])]
            if not any(images.resolve().is_relative_to(entry.resolve()) for entry in entries):
                raise ValueError(f"{self._file}: `{split}` does not have {images}, where images are added")

    def add(self, name: str, split: str, frame: DetectedFrame) -> Path | None:
        """Write an image and its labels; returns the image's file.

        None: there is an image of that name. Its labels may have been corrected; they are kept.
        """
        if any(self._folder.glob(f"images/*/{name}.jpg")):
            return None
        image, labels = (
            self._folder / kind / split / f"{name}{suffix}"
            for kind, suffix in (("images", ".jpg"), ("labels", ".txt"))
        )
        for path in (image, labels):
            path.parent.mkdir(parents=True, exist_ok=True)
        done, jpeg = cv2.imencode(".jpg", frame.image, (cv2.IMWRITE_JPEG_QUALITY, 95))
        if not done:
            raise OSError(f"cannot encode {image}")
        known = len(self._names)
        lines = "".join(self._lines(frame.message))
        text = _with_names(self._text, self._names[known:])
        if split == "val" and "train" in self._splits and "val" not in self._splits:
            text += ("" if text.endswith("\n") else "\n") + "val: images/val\n"
            self._splits["val"] = "images/val"
        if text != self._text or not self._file.is_file():
            if [str(one) for one in load_plain_yaml(text)["names"]] != self._names:
                raise ValueError(f"{self._file}: write its `names` as a list in one line, to add to it")
            self._file.write_bytes(text.encode("utf-8"))
            self._text = text
        image.write_bytes(jpeg.tobytes())
        labels.write_text(lines, "utf-8")
        return image

    def _lines(self, message: dict[str, Any]) -> Iterator[str]:
        """`class x y width height` of each detection: centre and size as fractions of the image."""
        for one in message["detections"]:
            class_id = self._index_of.setdefault(fold_name(one["class_name"]), len(self._names))
            if class_id == len(self._names):
                self._names.append(one["class_name"])
            sides = (message["width"], message["height"])
            left, top, right, bottom = np.clip(np.divide(one["xyxy"], sides * 2), 0.0, 1.0).tolist()
            if left < right and top < bottom:
                numbers = ((left + right) / 2, (top + bottom) / 2, right - left, bottom - top)
                yield f"{class_id} " + " ".join(f"{number:.6f}" for number in numbers) + "\n"


def _with_names(text: str, added: list[str]) -> str:
    """Add to the list `names` of a YAML table, and leave all else as it is."""
    if not added:
        return text
    table: Any = yaml.compose(text, Loader=yaml.SafeLoader)
    node = next(value for key, value in table.value if key.value == "names")
    words = [json.dumps(name, ensure_ascii=False) for name in added]
    if not node.flow_style:  # one entry a line
        before, after = text[: node.value[-1].end_mark.index], text[node.value[-1].end_mark.index :]
        rest, newline, after = after.partition("\n")
        lines = "\n".join(" " * node.start_mark.column + f"- {word}" for word in words)
        return f"{before}{rest}\n{lines}{newline}{after}"
    at = node.value[-1].end_mark.index if node.value else node.start_mark.index + 1
    return text[:at] + (", " if node.value else "") + ", ".join(words) + text[at:]


def live_frames(
    zenoh: ZenohSection, vehicle: str, camera: str | None, ending: Event
) -> Iterator[DetectedFrame]:
    """The preview images of a running service with their detections, until `ending` is set.

    Raises:
        NoAnswerError: no service at the endpoint. RecordingError: detections are drawn into the images.
    """
    received: queue.Queue[tuple[Topic, bytes, bytes | None]] = queue.Queue(_MOST_WAITING)
    waiting: dict[int, Any] = {}

    def receive(topic: Topic, sample: Any) -> None:
        # One that is too large is ignored; while the reader is late, so are new ones.
        with suppress(PeerDataError, queue.Full):
            received.put_nowait((topic, *message_of(sample, topic)))

    with open_client(zenoh) as session:
        subscribers = [
            session.declare_subscriber(topic.key(vehicle, camera), partial(receive, topic))
            for topic in (DETECTIONS, IMAGE)
        ]
        while not ending.is_set():
            try:
                topic, payload, attachment = received.get(timeout=_POLL_S)
                about = parse_object(payload if topic is DETECTIONS else attachment or b"{}")
                stamp_ns = about["captured_ns"]
            except (queue.Empty, PeerDataError, KeyError):  # none, or another program's
                continue
            if topic is DETECTIONS:
                waiting[stamp_ns] = about
                waiting = dict(list(waiting.items())[-_MOST_WAITING:])
                continue
            if about.get("annotated"):
                raise RecordingError(
                    f"{vehicle}: detections are drawn into its images: set preview.annotate = false"
                )
            found = waiting.get(stamp_ns)
            image = decode_image(payload)
            if found is not None and image is not None:
                yield DetectedFrame(stamp_ns, image, found)
        for subscriber in subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]


def collect(
    frames: Iterable[DetectedFrame], folder: Path, source: str, *, interval_s: float = 1.0, most: int = 200
) -> Iterator[tuple[Path, list[str]]]:
    """Add the frames with a doubt to a folder, and return each image's file with the reasons.

    Args:
        source: first part of the files' names; the rest is the frame's number.
        interval_s: least time between two of them; what follows at once looks the same.
        most: number of images.
    """
    labelled, doubts = LabelFolder(folder), DoubtFinder()
    due_ns = kept = 0
    first_ns: int | None = None
    repeated_ns: dict[str, int] = {}
    for frame in frames:
        now_ns = frame.captured_ns
        first_ns = now_ns if first_ns is None else first_ns
        split = split_at((now_ns - first_ns) / 1e9)
        reasons = [one for one in doubts.update(frame.message) if now_ns >= repeated_ns.get(one, 0)]
        if not reasons or now_ns < due_ns or split is None:
            continue
        due_ns = now_ns + round(interval_s * 1e9)
        repeated_ns |= dict.fromkeys(reasons, now_ns + round(REPEAT_S * 1e9))
        path = labelled.add(f"{source}_{frame.message['sequence']:07d}", split, frame)
        if path is not None:
            yield path, reasons
            kept += 1
        if kept >= most:
            return
