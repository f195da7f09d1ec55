"""Detect and track objects in a video: `python detect_video.py street.mp4 yolo11n` prints the tracks."""

import sys

from vision import Detector, Tracker, open_source
from vision.tracking import TrackerSettings, TrackEventKind


def main(video: str, model: str = "default") -> None:
    settings = TrackerSettings()
    # A tracker continues tracks with weak detections too, and drops weak ones without a track.
    detector = Detector(model, confidence=settings.low_confidence)
    tracker = Tracker(settings)
    with open_source(video) as source:
        for frame in source:
            time_s = frame.media_s or 0.0
            tracked = tracker.update(detector.detect(frame.image), round(time_s * 1e9))
            for record in tracked.detections:
                if record["track_state"] == "confirmed":
                    left, top, right, bottom = record["xyxy"]
                    print(
                        f"{time_s:7.2f} s  {record['class_name']} #{record['track_id']} "
                        f"{record['confidence']:.2f} at {left:.0f},{top:.0f} to {right:.0f},{bottom:.0f} px"
                    )
            for event in tracked.events:
                if event.kind is TrackEventKind.END:
                    print(f"{time_s:7.2f} s  {event.track.class_name} #{event.track.track_id} ended")


if __name__ == "__main__":
    main(*sys.argv[1:])
