"""An object is one value: seen, flown to, recorded and published."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from benchmarks.rendered import camera_settings
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.synthetic_camera import SyntheticCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose, SyntheticDetector
from companion.bus.messages import Localization, tracks_message
from companion.guidance.behaviour import Behaviour
from companion.guidance.behaviours.approach import ApproachBehaviour
from companion.guidance.behaviours.follow import FollowBehaviour
from companion.guidance.behaviours.orbit import OrbitBehaviour
from companion.guidance.interface import GuidanceInput, StreamStatus
from companion.recording.encoding import decode, dumps, encode
from tests.companion.guidance.guidance_harness import in_the_air
from vision.camera_model import CameraModel, CameraMount
from vision.tracking import TrackEvent, TrackEventKind
from vision.tracking.tracks import Track, TrackState

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
MOUNT = CameraMount(pitch_rad=math.radians(-15.0))


def walking(seconds: float) -> ScenePose:
    return ScenePose(14.0 + 0.2 * seconds, 0.3 * seconds, 0.3)


@pytest.mark.parametrize(
    "behaviour", [ApproachBehaviour("car"), FollowBehaviour("car"), OrbitBehaviour(8.0, class_name="car")]
)
def test_object_is_the_same_value_everywhere(behaviour: Behaviour) -> None:
    settings = camera_settings(CAMERA, MOUNT, {})
    detector = SyntheticDetector([SceneObject("car", (4.2, 1.8, 1.5), walking)], CAMERA, MOUNT, seed=5)
    camera = SyntheticCamera(settings, detect=detector)
    flight = LockstepFlight.of_vehicle(in_the_air(seed=3), camera=camera)
    flight.run(1.0)
    flight.command(behaviour)
    flight.run(4.0)
    flight.step()  # with the newest result
    perceived, context = camera.perceived, flight.guidance.context
    assert context is not None
    seen = context.objects.of(behaviour._subject)  # type: ignore[attr-defined]
    assert seen is not None
    assert seen in perceived.objects.objects
    assert seen is behaviour._object  # type: ignore[attr-defined]

    inputs = flight.inputs.assemble(flight.now_ns, flight.state, StreamStatus())
    assert seen in inputs.objects
    read = decode(GuidanceInput, json.loads(dumps(encode(GuidanceInput, inputs))))
    assert encode(GuidanceInput, read) == encode(GuidanceInput, inputs)  # NaN included

    assert seen.track_id is not None
    track = Track(
        seen.track_id, 0, "car", TrackState.CONFIRMED, (1.0, 2.0, 3.0, 4.0), 0.9, 0.8, 5, 1, seen.last_ns
    )
    assert perceived.newest is not None
    result = replace(perceived.newest, track_events=(TrackEvent(TrackEventKind.UPDATE, seen.last_ns, track),))
    message = tracks_message(result, "v", 1, localization=Localization(objects=perceived.objects))
    assert seen.position_ned_m is not None
    assert message["events"][0]["position_ned_m"] == [round(value, 3) for value in seen.position_ned_m]
