"""Bad input that one call refuses: the type of its error, and the names and values that its message holds."""

import importlib
import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.clear_mot import Labelled
from benchmarks.flights import UnknownFlightError, flight_named, summary
from companion.bench.detector import BenchError, read_result
from companion.bus.messages import transforms_message
from companion.geometry import formation
from companion.geometry.fence import Fence
from companion.guidance import Patrol, Seek, Select, Takeoff
from companion.guidance.behaviour import ModeRequest
from companion.guidance.command import NO_CONTEXT, GrammarError
from companion.guidance.grammar import parse
from companion.guidance.limits.battery import BatteryMinimum
from companion.guidance.limits.envelope import Limits
from companion.guidance.missions.mission_file import MissionError, find_mission, read_mission
from companion.guidance.objects.from_detections import HistoryError, StateHistory
from companion.guidance.policy_file import PolicyError, find_policy
from companion.host.peer_data import PeerDataError
from companion.language.clauses import UnclearError
from companion.language.sentences import understand
from companion.language.tools import ToolCall, read_call
from companion.recording import RecordingError
from companion.recording.files import RecordingReader
from companion.settings.calibration import adopt_calibration
from companion.settings.reading import ConfigurationError, Settings, load_settings
from companion.vehicle.driver import LinkError
from companion.vehicle.drivers import open_driver
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.link_url import LinkUrlError, parse_link_url
from companion.vehicle.px4_modes import request_of_mode
from companion.vehicle.report_reader import LARGEST_UNPACKED, EventCatalogue
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, VehicleState, with_fields
from companion.vehicle.streamer import Streamer
from mavlink_sim import LockstepVehicle
from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.lens import Lens, Shutter
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.camera.scene import Path as ObjectPath
from mavlink_sim.camera.scene_file import SceneError, load_scene, parse_scene
from mavlink_sim.camera.video_outputs import check_output
from mavlink_sim.datasets import dataset
from mavlink_sim.datasets.dataset import DatasetOptions, make_dataset
from mavlink_sim.faults.grammar import FaultError, parse_fault
from mavlink_sim.faults.kinds import KINDS
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.px4.parameters import Parameters, UnknownParameterError
from mavlink_sim.releases import release_named
from mavlink_sim.wire.messages import dialect
from mavlink_sim.wire.packing import packer
from mavlink_sim.wire.signing import key_of
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.shapes import shape_of
from mavlink_sim.world.world import World, WorldObject
from tests.companion.language.sentence_table import CLASSES, SCENE
from tools.compile_simulator import compile_simulator
from tools.recorded_flight import read_flight
from vision.annotate import annotate
from vision.calibration.boards import Board
from vision.calibration.calibrate import CalibrationError
from vision.calibration.marker_sheets import marker_sheets
from vision.calibration.mount import mount_from_markers
from vision.calibration_files.camera_info import read_camera_info, write_camera_info
from vision.camera_model import CameraCalibration, CameraModel, CameraMount
from vision.detections import Detections
from vision.detector import Detector
from vision.evaluation import datasets
from vision.evaluation.metrics import average_precision
from vision.frame_selection import FrameSelector
from vision.letterbox import fit
from vision.levelling import level_image
from vision.markers import MarkerDetector, MarkerKind
from vision.plain_yaml import PlainYamlError, load_plain_yaml
from vision.point_cloud import (
    CloudFileError,
    PointCloud,
    RegistrationError,
    align,
    cloud_from_depth,
    read_cloud,
    voxel_grid,
    write_cloud,
)
from vision.recording import Recording
from vision.runtimes.base import RuntimeUnusableError
from vision.runtimes.source import read_source
from vision.shared_frame import SharedFrameReader, segment_path
from vision.sources import SourceError, SourceSettings, open_source
from vision.sources.network import UdpStream
from vision.sources.stream_formats import StreamError, Y4mParser, parse_y4m_header
from vision.text_file import NotUtf8Error, read_text
from vision.tracking import TrackerSettings, association
from vision.video_writer import VideoWriter, VideoWriterError
from vision.yolo.checkpoint_error import CheckpointError
from vision.yolo.level_outputs import Head, LevelOutput
from vision.yolo.postprocess import boxes_of

LONGEST = 300  # characters of a message, without the folder of its file
FOREIGN = ("<class", "object at 0x", "Traceback")  # of Python, for nobody who reads a message


@dataclass(frozen=True)
class Row:
    """`call` gets an empty folder; `error` is the type that it raises, or the `module:name` of that type."""

    name: str
    call: Callable[[Path], object]
    error: type[Exception] | str
    words: tuple[str, ...]  # in its text: the thing, and the value that came


def row(name: str, call: Callable[[Path], object], error: type[Exception] | str, *words: str) -> Row:
    return Row(name, call, error, words)


def of(name: str) -> Any:
    """The object `module:name`, imported when its row runs: torch takes seconds."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def file(folder: Path, name: str, content: bytes) -> Path:
    (path := folder / name).write_bytes(content)
    return path


def settings(flags: dict[str, str]) -> Settings:
    return load_settings(os.devnull, flags, environment={})


SERVICE = [
    row(
        "bench result []",
        lambda f: read_result(file(f, "r.json", b"[]")),
        BenchError,
        "r.json",
        "bench detector",
    ),
    row(
        "bench result {}",
        lambda f: read_result(file(f, "r.json", b"{}")),
        BenchError,
        "r.json",
        "bench detector",
    ),
    row(
        "bench rows 1",
        lambda f: read_result(file(f, "r.json", b'{"rows": [1]}')),
        BenchError,
        "r.json",
        "rows",
    ),
    row(
        "bench row {}",
        lambda f: read_result(file(f, "r.json", b'{"rows": [{}]}')),
        BenchError,
        "r.json",
        "rows",
    ),
    row(
        "transforms without attitude",
        lambda _: transforms_message(7, 5_000_000_000, CameraMount(), StateHistory(), "v"),
        HistoryError,
        "attitude",
    ),
    row("slots shape", lambda _: formation.slots("star", 3, 5.0), ValueError, "shape", "'star'"),
    row("slots count", lambda _: formation.slots("line", -1, 5.0), ValueError, "count", "-1"),
    row("slots spacing 0", lambda _: formation.slots("line", 3, 0.0), ValueError, "spacing_m", "0.0"),
    row("slots spacing nan", lambda _: formation.slots("line", 3, math.nan), ValueError, "spacing_m", "nan"),
    row(
        "slots missing",
        lambda _: formation.assign([(0, 0, 0), (1, 0, 0)], [(0, 0, 0)]),
        ValueError,
        "2",
        "got 1",
    ),
    row(
        "slot nan",
        lambda _: formation.assign([(math.nan, 0, 0)], [(0, 0, 0)]),
        ValueError,
        "position",
        "finite",
    ),
    row(
        "recording empty",
        lambda f: RecordingReader(file(f, "a.mcap", b"")),
        RecordingError,
        "a.mcap",
        "empty",
    ),
    row(
        "recording cut",
        lambda f: RecordingReader(file(f, "a.mcap", b"\x89MCAP")),
        RecordingError,
        "a.mcap",
        "MCAP",
    ),
    row(
        "recording script",
        lambda f: RecordingReader(file(f, "a.mcap", b"#!/bin/sh\n" * 10)),
        RecordingError,
        "a.mcap",
        "not an MCAP",
    ),
    row(
        "recording missing",
        lambda f: RecordingReader(f / "none.mcap"),
        RecordingError,
        "none.mcap",
        "No such file",
    ),
]


def fence(key: str, corners: str, *words: str) -> Row:
    text = f'[guidance]\n{key} = "{corners}"\n'.encode()
    return row(
        f"{key} {corners}",
        lambda folder: load_settings(file(folder, "c.toml", text), {}, {}),
        ConfigurationError,
        key,
        "c.toml",
        *words,
    )


def lens_file(folder: Path) -> str:
    model = CameraModel.from_horizontal_fov(640, 480, math.radians(70.0))
    write_camera_info(path := folder / "camera.yaml", model, "front")
    return str(path)


def calibration(
    numbers: tuple[float, float, float, float], mount: dict[str, Any], key: str, value: str
) -> Row:
    made = CameraCalibration(CameraModel(640, 480, *numbers), CameraMount(**mount))
    camera = load_settings(os.devnull, {}, environment={}).camera
    return row(f"calibration's {key}", lambda _: adopt_calibration(camera, made), ValueError, key, value)


USUAL = (450.0, 450.0, 320.0, 240.0)

SETTINGS = [
    fence("fence_include", "0,0 1,1", "3 corners"),
    fence("fence_exclude", "0,0 1,1", "3 corners"),
    fence("fence_include", "0,0 10,10 10,0 0,10", "cross"),
    fence("fence_exclude", "0,0 10,10 10,0 0,10", "cross"),
    fence("fence_include", "0,0 0,0 10,0", "cross"),
    fence("fence_exclude", "0,0 0,0 10,0", "cross"),
    fence("fence_include", "0,0 10,0,5 10,10", "north,east"),
    fence("fence_exclude", "0,0 10,0,5 10,10", "north,east"),
    fence("fence_include", "0,0 10,x 10,10", "'10,x'"),
    fence("fence_exclude", "0,0 10,x 10,10", "'10,x'"),
    calibration((1e-3, 450.0, 320.0, 240.0), {}, "fx", "0.001"),
    calibration((450.0, 1e9, 320.0, 240.0), {}, "fy", "1"),
    calibration((450.0, 450.0, 1e12, 240.0), {}, "cx", "1"),
    calibration((450.0, 450.0, 320.0, -1e6), {}, "cy", "-1"),
    calibration(USUAL, {"down_m": 1e30}, "mount_down_m", "1e+30"),
    calibration(USUAL, {"forward_m": math.nan}, "mount_forward_m", "nan"),
    calibration(USUAL, {"pitch_rad": 7.0}, "mount_pitch_deg", "401"),
    row(
        "calibration_file missing",
        lambda f: settings({"camera.calibration_file": str(f / "none.yaml")}),
        ConfigurationError,
        "camera: ",
        "none.yaml",
    ),
    row(
        "lens given twice",
        lambda f: settings({"camera.calibration_file": lens_file(f), "camera.horizontal_fov_deg": "90"}),
        ConfigurationError,
        "camera: calibration_file",
        "horizontal_fov_deg",
    ),
    row(
        "frames of another aspect",
        lambda f: settings({"camera.calibration_file": lens_file(f)}).camera.model(1280, 720),
        ValueError,
        "640x480",
        "1280x720",
    ),
    row(
        "avoid without obstacles",
        lambda _: settings({"guidance.avoid": "true", "guidance.obstacles": "off"}),
        ConfigurationError,
        "guidance: avoid",
        "obstacles",
        "off",
    ),
    row(
        "send_obstacle_distance without obstacles",
        lambda _: settings({"guidance.send_obstacle_distance": "true", "guidance.obstacles": "off"}),
        ConfigurationError,
        "guidance: send_obstacle_distance",
        "obstacles",
        "off",
    ),
    row(
        "level without video",
        lambda _: settings({"recording.level": "true"}),
        ConfigurationError,
        "recording: level",
        "video",
    ),
    row(
        "depth_scale without depth",
        lambda _: settings({"source.depth_scale": "0.001"}),
        ConfigurationError,
        "source: depth_scale",
    ),
    row(
        "markers.print of another dictionary",
        lambda _: settings({"markers.dictionary": "4X4_50", "markers.print": "apriltag"}),
        ConfigurationError,
        "markers: ",
        "'apriltag'",
        "4X4_50",
    ),
    row(
        "copy with no setting",
        lambda _: Settings().source.model_copy(update={"realtime": False}),
        KeyError,
        "SourceSection",
        "realtime",
    ),
    row(
        "views",
        lambda f: load_settings(file(f, "c.toml", b'[views.down.source]\nuri = "down.mp4"\n'), {}, {}),
        ConfigurationError,
        "[views]",
        "c.toml",
        "[cameras]",
    ),
]

GUIDANCE = [
    row("minimum 1.5", lambda _: BatteryMinimum(1.5, "rtl"), ValueError, "minimum charge", "0 to 1", "1.5"),
    row(
        "minimum -0.1", lambda _: BatteryMinimum(-0.1, "rtl"), ValueError, "minimum charge", "0 to 1", "-0.1"
    ),
    row(
        "minimum action",
        lambda _: BatteryMinimum(0.2, "dive"),  # type: ignore[arg-type]
        ValueError,
        "action",
        "rtl, land, hold",
        "'dive'",
    ),
    row("limits climb 0", lambda _: Limits(max_climb_mps=0.0), ValueError, "max_climb_mps", "0.0"),
    row(
        "limits distance nan", lambda _: Limits(max_distance_m=math.nan), ValueError, "max_distance_m", "nan"
    ),
    row(
        "limits altitudes",
        lambda _: Limits(min_altitude_m=60.0),
        ValueError,
        "min_altitude_m",
        "max_altitude_m",
        "60.0",
    ),
    row("limits turning", lambda _: Limits(max_yaw_rate_radps=-1), ValueError, "max_yaw_rate_radps", "-1"),
    row("takeoff low", lambda _: Takeoff(0.1), GrammarError, "takeoff: altitude", "1 to 50 m", "0.1"),
    row("seek no class", lambda _: Seek(""), GrammarError, "seek: class", "''"),
    row(
        "seek laps nan", lambda _: Seek("car", laps=math.nan), GrammarError, "seek: laps", "0.25 to 20", "nan"
    ),
    row("patrol classes", lambda _: Patrol("0,0 9,9", "car,"), GrammarError, "patrol: classes", "'car,'"),
    row("takeoff request", lambda _: ModeRequest(FlightMode.TAKEOFF), ValueError, "TAKEOFF", "altitude_m"),
    row(
        "select without size",
        lambda _: parse("select x=0.4 y=0.3"),
        GrammarError,
        "select: width, height",
        "missing",
    ),
    row(
        "select beyond the image",
        lambda _: parse("select x=0.4 y=0.3 width=0.7 height=0.1"),
        GrammarError,
        "select: ",
        "1.1, 0.4",
        "fractions",
    ),
    row(
        "select width 0",
        lambda _: parse("select x=0.4 y=0.3 width=0 height=0.1"),
        GrammarError,
        "select: width and height",
        "above 0",
        "0, 0.1",
    ),
    row(
        "select in pixels",
        lambda _: parse("select x=400 y=0.3 width=0.1 height=0.1"),
        GrammarError,
        "select: x",
        "0 to 1",
        "400",
    ),
    row("select in a mission", lambda _: Select().build(NO_CONTEXT), GrammarError, "select: ", "mission"),
    row("mission name long", lambda _: find_mission("x" * 245), MissionError, "mission 'xxx", "demo"),
    row("mission name too long", lambda _: find_mission("x" * 600), MissionError, "'xxx", "too long"),
    row("policy name too long", lambda _: find_policy("x" * 600), PolicyError, "'xxx", "too long"),
    row("fence nan", lambda _: Fence(((0, 0), (1, math.nan), (2, 2))), ValueError, "corner", "1,nan"),
    row(
        "mission UTF-16",
        lambda f: read_mission(file(f, "m.toml", b"\xff\xfe\x00")),
        MissionError,
        "m.toml: ",
        "UTF-16",
        "UTF-8",
    ),
    row(
        "mission too long",
        lambda f: read_mission(file(f, "m.toml", b"#" * 100_001)),
        MissionError,
        "m.toml: ",
        "100000 bytes",
        "100001",
    ),
    row(
        "gimbal without its attitude",
        lambda _: CameraMount(on_gimbal=True).ned_from_optical(np.eye(3)),
        ValueError,
        "gimbal",
        "`held`",
    ),
    row(
        "gimbal has no fixed rotation",
        lambda _: CameraMount(on_gimbal=True).body_from_optical,
        ValueError,
        "gimbal",
        "body_from_optical",
    ),
]


def call(name: Any, arguments: Any, *words: str) -> Row:
    tool = ToolCall(name, arguments)
    return row(f"call {name} {arguments}", lambda _: read_call(tool, CLASSES), ValueError, *words)


LANGUAGE = [
    call("explode", {}, "command 'explode'", "takeoff, land"),
    call("take off", {}, "command 'take off'", "takeoff?"),
    call("", {}, "command ''", "takeoff, land"),
    call("takeoff", "5", "takeoff: ", "object", "'5'"),
    call("takeoff", "altitude=5", "takeoff: ", "object", "'altitude=5'"),
    call("takeoff", '[{"altitude": 5}]', "takeoff: ", "object", '[{"altitude": 5}]'),
    call("takeoff", '{"altitude": 5, "altitude": 9}', "takeoff: ", "object", '"altitude": 9'),
    call("takeoff", '{"altitude": NaN}', "takeoff: altitude ", "1 to 50 m", "nan"),
    call("takeoff", [5], "takeoff: ", "object", "'[5]'"),
    call("takeoff", {"altitude": "high"}, "takeoff: altitude ", "1 to 50 m", "'high'"),
    call("takeoff", {"altitude": 1000}, "takeoff: altitude ", "1 to 50 m", "1000"),
    call("takeoff", {"altitude": True}, "takeoff: altitude ", "number", "'True'"),
    call("takeoff", {"altitude": {"value": 5}}, "takeoff: altitude ", "number", "'value': 5"),
    call("takeoff", {"altitude": math.nan}, "takeoff: altitude ", "1 to 50 m", "nan"),
    call("takeoff", {"height": 5}, "takeoff: ", "'height'", "known: altitude"),
    call("takeoff", {"altitude=5 speed": 5}, "takeoff: ", "'altitude=5 speed'"),
    call("seek", {"class": "unicorn"}, "class 'unicorn'", "person, bicycle"),
    call("seek", {}, "seek: class ", "missing", "seek CLASS"),
    call("orbit", {"class": "car", "track": 3}, "orbit: ", "class or track or marker", "class and track"),
    call("approach", {"track": 1.5}, "approach: track ", "track_id", "'1.5'"),
    call("mission", {"file": "demo\n[[step]]"}, "mission "),
    call("mission", {"file": "demo"}, "mission "),
    call("policy", {"file": "a.onnx", "class": "car"}, "policy "),
    call("Mission", {"file": "demo"}, "command 'Mission'", "takeoff, land"),
    call("velocity", {}, "velocity "),
    call('"mission"', {"file": "/tmp/other.toml"}, """command '"mission"'"""),
    call('"policy"', {"file": "a.onnx", "class": "car"}, """command '"policy"'"""),
    call('"velocity"', {}, """command '"velocity"'"""),
    call('"takeoff"', {}, """command '"takeoff"'""", "takeoff?"),
    call("Takeoff", {}, "command 'Takeoff'", "takeoff?"),
    call(" takeoff", {}, "command ' takeoff'", "takeoff?"),
    call(None, {}, "tool 'None'"),
    call(["seen"], {}, "tool ", "['seen']"),
    row(
        "condition that no command expresses",
        lambda _: understand("find the purple dog unless it barks", SCENE),
        UnclearError,
        "'unless barks'",
    ),
    row(
        "altitude of a sentence",
        lambda _: understand("take off to nine hundred metres", SCENE),
        GrammarError,
        "takeoff: altitude ",
        "1 to 50 m",
        "900",
    ),
]

POSITION = (1.0, 2.0, -3.0)
URL = "udpin://0.0.0.0:14540"


def link(text: str, *words: str) -> Row:
    return row(f"link {text}", lambda _: parse_link_url(text), LinkUrlError, f"link '{text}': ", *words)


def setpoint(name: str, values: dict[str, Any], *words: str) -> Row:
    return row(f"setpoint {name}", lambda _: Setpoint(0, **values), ValueError, "setpoint", *words)


def metadata(content: bytes, *words: str) -> Row:
    return row(f"metadata {content[:40]!r}", lambda _: EventCatalogue(content), PeerDataError, *words)


def event_with(**changes: object) -> bytes:
    """Events metadata of one event, number 1."""
    event = {"name": "an_event", "message": "text", "arguments": [], **changes}
    component = {"namespace": "px4", "event_groups": {"default": {"events": {"1": event}}}}
    return json.dumps({"components": {"1": component}}).encode()


VEHICLE = [
    metadata(b"", "metadata", "JSON"),
    metadata(b"{", "metadata", "JSON"),
    metadata(b"[]", "metadata", "object"),
    metadata(b"\xff", "metadata", "JSON"),
    metadata(b"null", "metadata", "object"),
    metadata(b"[" * 100_000, "metadata", "JSON", "recursion"),
    metadata(b'{"components":' * 10_000, "metadata", "JSON", "recursion"),
    metadata(b'{"components": 3}', "metadata, components: "),
    metadata(b'{"components": {"1": 3}}', "metadata, components.1: "),
    metadata(b'{"components": {"' + b"9" * 5000 + b'": {}}}', "metadata, components.9999", "integer"),
    metadata(b'{"components": {"1": {"namespace": 5}}}', "metadata, components.1.namespace: "),
    metadata(b'{"components": ' + b"9" * 5000 + b"}", "metadata", "JSON", "number"),
    metadata(event_with(message=5), "metadata, components.1.", ".message: "),
    metadata(event_with(message="x" * 1001), "metadata, components.1.", ".message: ", "1000"),
    metadata(event_with(arguments=[{"name": "no type"}]), "metadata, components.1.", ".type: "),
    metadata(
        event_with(arguments=[{"type": "uint8_t"}] * 41), "metadata, components.1.", ".arguments: ", "40"
    ),
    metadata(b" " * (LARGEST_UNPACKED + 1), str(LARGEST_UNPACKED + 1), str(LARGEST_UNPACKED)),
    row(
        "driver",
        lambda _: open_driver("dronekit", URL),  # type: ignore[arg-type]
        ValueError,
        "'dronekit'",
        "pymavlink, mavsdk, auto",
    ),
    row("driver's link", lambda _: open_driver("mavsdk", "14540"), ValueError, "link '14540': ", "link url"),
    row(
        "system_id",
        lambda _: open_driver("mavsdk", URL, system_id=0),
        ValueError,
        "system_id",
        "1..255",
        "got 0",
    ),
    row(
        "own_component_id",
        lambda _: open_driver("pymavlink", URL, own_component_id=256),
        ValueError,
        "own_component_id",
        "1..255",
        "256",
    ),
    row("gimbal pitch", lambda _: GimbalAim(-1.6, 0.0), ValueError, "gimbal aim", "-90° to 90°", "-91.6732°"),
    row("gimbal yaw", lambda _: GimbalAim(0.0, 3.2), ValueError, "gimbal aim", "-180° to 180°", "183.346°"),
    row("gimbal nan", lambda _: GimbalAim(math.nan, 0.0), ValueError, "gimbal aim", "nan°"),
    row(
        "landing target nan",
        lambda _: LandingTarget(0, 1, (math.nan, 0.0, 0.0), (0.0, 0.0, 1.0), 0.5),
        ValueError,
        "landing target",
        "finite",
        "(nan, ",
    ),
    link("", "not a link url"),
    link("14540", "not a link url"),
    link("/dev/ttyAMA0", "not a link url"),
    link("udp://:14540", "use udpin:// ", "udpout://"),
    link("udpin:127.0.0.1:14540", "not a link url"),
    link("udpin://14540", "udpin://HOST:PORT"),
    link("udpin://127.0.0.1", "udpin://HOST:PORT"),
    link("udpin://127.0.0.1:0", "port", "1..65535", "got 0"),
    link("udpin://127.0.0.1:65536", "port", "1..65535", "got 65536"),
    link("udpin://127.0.0.1:14540;rm", "udpin://HOST:PORT"),
    link("tcp://a b:1", "tcp://HOST:PORT"),
    link("serial://ttyAMA0:57600", "serial:///dev/NAME:BAUD"),
    link("serial:///dev/ttyAMA0", "serial:///dev/NAME:BAUD"),
    link("serial:///dev/ttyAMA0:0", "baud rate 0 ", "57600"),
    link("serial:///dev/ttyAMA0:12345", "baud rate 12345 ", "57600"),
    link("none://", "not a link url"),
    link("http://127.0.0.1:80", "not a link url"),
    row("link, an error of links", lambda _: parse_link_url("14540"), LinkError, "14540"),
    row("link, an error of values", lambda _: parse_link_url("14540"), ValueError, "14540"),
    row("mode", lambda _: request_of_mode(FlightMode.UNKNOWN), ValueError, "mode unknown", "known: ", "hold"),
    setpoint("of nothing", {}, "position_ned_m", "velocity_ned_mps"),
    setpoint(
        "of both",
        {"position_ned_m": POSITION, "velocity_ned_mps": POSITION},
        "position_ned_m and velocity_ned_mps",
    ),
    setpoint(
        "yaw and its rate",
        {"position_ned_m": POSITION, "yaw_rad": 0.0, "yaw_rate_radps": 0.0},
        "yaw_rad or yaw_rate_radps",
    ),
    row(
        "setpoint feed-forward of a position",
        lambda _: Setpoint(0, position_ned_m=POSITION, acceleration_ned_mps2=POSITION),
        ValueError,
        "acceleration_ned_mps2",
        "velocity_ned_mps",
    ),
    setpoint(
        "acceleration nan",
        {"velocity_ned_mps": POSITION, "acceleration_ned_mps2": (0.0, math.nan, 0.0)},
        "finite",
        "[1.0, 2.0, -3.0, 0.0, nan, 0.0]",
    ),
    setpoint("velocity nan", {"velocity_ned_mps": (math.nan, 0.0, 0.0)}, "finite", "[nan, 0.0, 0.0]"),
    setpoint("position inf", {"position_ned_m": (0.0, math.inf, 0.0)}, "finite", "[0.0, inf, 0.0]"),
    setpoint("yaw nan", {"velocity_ned_mps": POSITION, "yaw_rad": math.nan}, "finite", "-3.0, nan]"),
    setpoint("rate inf", {"velocity_ned_mps": POSITION, "yaw_rate_radps": math.inf}, "finite", "-3.0, inf]"),
    row(
        "state's field",
        lambda _: with_fields(VehicleState(), batery_fraction=0.1),  # type: ignore[call-arg]
        TypeError,
        "VehicleState",
        "batery_fraction",
    ),
    row(
        "streamer's rate",
        lambda _: Streamer(lambda _: None, rate_hz=2.0),
        ValueError,
        "rate_hz",
        "above 2",
        "2.0",
    ),
]


def scene(text: str, *words: str) -> Row:
    return row(f"scene {text}", lambda _: parse_scene(text), SceneError, "scene: ", *words)


def fault(text: str, *words: str) -> Row:
    return row(f"fault {text[:40]}", lambda _: parse_fault(text, KINDS), FaultError, *words)


def options(changes: dict[str, Any], *words: str) -> Row:
    made = {"frames": 1, **changes}
    return row(f"dataset {changes}", lambda _: DatasetOptions(**made), dataset.DatasetError, *words)


def output(text: str, *words: str) -> Row:
    return row(f"output {text}", lambda _: check_output(text), ValueError, *words)


ORIGIN = (0.0, 0.0, 0.0)
FULL = World((WorldObject(0, "box", ORIGIN, size_m=(400.0, 400.0, 50.0)),))
CAR = "[[objects]]\nclass = 'car'\n"

SIMULATOR = [
    row(
        "ardupilot gimbal",
        lambda _: LockstepVehicle(autopilot="ardupilot", gimbal=True),
        ValueError,
        "gimbal",
    ),
    row(
        "ardupilot parameter",
        lambda _: LockstepVehicle(autopilot="ardupilot", parameters={"COM_OF_LOSS_T": 1.0}),
        KeyError,
        "'COM_OF_LOSS_T'",
        "PARAM_REQUEST_LIST",
    ),
    row(
        "autopilot",
        lambda _: LockstepVehicle(autopilot="betaflight"),
        ValueError,
        "'betaflight'",
        "px4, ardupilot",
    ),
    row(
        "ardupilot px4",
        lambda _: LockstepVehicle(autopilot="ardupilot", px4="1.14"),
        ValueError,
        "px4 '1.14'",
        "ArduPilot",
        "--px4",
    ),
    row("release", lambda _: release_named("2.0"), ValueError, "'2.0'", "1.14, 1.15, 1.16, 1.17"),
    row(
        "link fault without links",
        lambda _: LockstepVehicle({}).vehicle.faults.begin("link_delay 0.2"),
        FaultError,
        "link fault: ",
        "no links",
    ),
    row("shutter exposure", lambda _: Shutter(-0.1, 0.0), ValueError, "exposure_s", "0 to 0.5 s", "-0.1"),
    row("shutter readout", lambda _: Shutter(0.0, 0.6), ValueError, "readout_s", "0 to 0.5 s", "0.6"),
    row("shutter nan", lambda _: Shutter(math.nan, 0.0), ValueError, "exposure_s", "0 to 0.5 s", "nan"),
    row("depth baseline", lambda _: DepthSensor(baseline_m=-1.0), ValueError, "baseline", "0 to 2 m", "-1.0"),
    row("depth step", lambda _: DepthSensor(step_px=5.0), ValueError, "step", "0 to 4 px", "5.0"),
    row(
        "depth range", lambda _: DepthSensor(minimum_m=5.0, maximum_m=5.0), ValueError, "range", "5.0 to 5.0"
    ),
    row("depth dropout", lambda _: DepthSensor(dropout=1.0), ValueError, "dropout", "0 to below 1", "1.0"),
    row(
        "dataset without viewpoint",
        lambda f: make_dataset(f / "set", Scene(FULL), DatasetOptions(1, classes=("box",))),
        dataset.DatasetError,
        "viewpoint",
        "1.5 and 40.0 m",
    ),
    options({"frames": 0}, "1 frame", "got 0"),
    options({"classes": ("car", "cat")}, "classes", "person, bicycle", "got car, cat"),
    options({"classes": ()}, "classes", "person, bicycle", "got none"),
    options({"validation": 1.0}, "validation", "0 to 1", "got 1.0"),
    options({"altitude_m": (5.0, 2.0)}, "altitudes", "0 to 500 m", "(5.0, 2.0)"),
    options({"size": (8, 8)}, "sides", "32 to 4096", "8x8"),
    options({"seed": -1}, "seed", "-1"),
    fault("link_dely 1", "'link_dely'", "link_delay?"),
    fault("", "''", "help"),
    fault("at=3", "'at=3'", "help"),
    fault(f"{'y' * 400} 1", "'yyyy", "help"),
    fault(f"gps_loss {'y' * 400}", "gps_loss: ", "'yyyy"),
    fault(f"gps_loss {'y' * 400}=1", "gps_loss: ", "'yyyy"),
    fault(f"gps_loss {'y' * 400}=1 {'y' * 400}=1", "gps_loss: ", "yyyy", "twice"),
    fault(f"link_delay {'y' * 400}", "link_delay: seconds=yyyy", "0 to 60 s"),
    fault("link_delay", "link_delay needs seconds", "link_delay SECONDS"),
    fault("link_delay x", "link_delay: seconds=x: ", "0 to 60 s"),
    fault("link_delay nan", "link_delay: seconds=nan: ", "0 to 60 s"),
    fault("link_delay 1 2 gcs in 5", "link_delay: ", "unexpected '5'"),
    fault("link_delay 1 colour=red", "link_delay: ", "unexpected 'colour='"),
    fault("link_delay 1 way=up", "link_delay: way=up: ", "both, out, in"),
    fault("link_delay 1 at=-1", "link_delay: at=-1: ", "0 to 1e+06 s"),
    fault("link_delay 1 for=0", "link_delay: for=0: ", "above 0 s"),
    fault("link_delay 1 for=1 for=2", "link_delay: for ", "twice"),
    fault("motor_failure 5", "motor_failure: motor=5: ", "1 to 4"),
    fault("battery full", "battery: remaining=full: ", "low, critical, emergency"),
    fault("lost_ack 0", "lost_ack: which=0: ", "whole number", "1 to 1000000"),
    fault("gps_loss seed=x", "gps_loss: seed=x: ", "whole number"),
    row("message with text", lambda _: packer(dialect.MAVLink_statustext_message), ValueError, "STATUSTEXT"),
    row(
        "parameter",
        lambda _: Parameters({"COM_OF_LOST": 1.0}),
        UnknownParameterError,
        "'COM_OF_LOST'",
        "PARAM_REQUEST_LIST",
    ),
    row("INT32 1.5", lambda _: Parameters({"NAV_RCL_ACT": 1.5}), ValueError, "NAV_RCL_ACT", "INT32", "1.5"),
    row(
        "INT32 2**40",
        lambda _: Parameters({"NAV_RCL_ACT": 2**40}),
        ValueError,
        "NAV_RCL_ACT",
        "INT32",
        str(2**40),
    ),
    row("float 1e300", lambda _: Parameters({"COM_OF_LOSS_T": 1e300}), ValueError, "1e+300", "32-bit float"),
    row("motor 4", lambda _: Multirotor().fail_motor(4, 0.0), ValueError, "motor 4", "0 to 3"),
    row("motor -1", lambda _: Multirotor().fail_motor(-1, 0.0), ValueError, "motor -1", "0 to 3"),
    row(
        "motor at 1.5",
        lambda _: Multirotor().fail_motor(0, 1.5),
        ValueError,
        "motor effectiveness 1.5",
        "0 (",
        "1 (",
    ),
    row(
        "motor at nan", lambda _: Multirotor().fail_motor(0, math.nan), ValueError, "motor effectiveness nan"
    ),
    scene("[ground", "']'"),
    scene("[grund]", "key grund", "ground?"),
    scene("[camera]\nheigth = 3", "camera.heigth", "height?"),
    scene("[camera.depth]\nnosie_px = 3", "camera.depth.nosie_px", "noise_px?"),
    scene("[camera]\nwidth = '640'", "camera.width: ", "integer", "'640'"),
    scene("[camera]\nwidth = 3", "camera.width: ", "16", "got 3"),
    scene("[camera]\nloss = 1.0", "camera.loss: ", "less than 1", "got 1.0"),
    scene(
        "[camera]\nfocal_px = [1, 2]\nhorizontal_fov_deg = 60",
        "camera: ",
        "horizontal_fov_deg",
        "focal_px",
        "both",
    ),
    scene("[camera]\ncentre_px = [1, 2]", "camera.centre_px: ", "camera.focal_px"),
    scene("[camera]\ndistortion = [0.1]", "camera: distortion", "plumb_bob", "0, 4 or 5", "got 1"),
    scene(
        "[camera]\nwidth = 64\nheight = 48\ndistortion = [-3, 0, 0, 0]",
        "camera.distortion: ",
        "(-3.0, 0.0, 0.0, 0.0)",
        "invertible",
        "64x48",
    ),
    scene("[camera.depth]\nminimum_m = 9\nmaximum_m = 3", "camera.depth: minimum_m 9.0", "maximum_m 3.0"),
    scene("[ground]\nkinds = ['grass', 'lava']", "ground.kinds[1]: ", "grass, ", "'lava'"),
    scene("[[objects]]\nclass = 'cat'\nplace_m = [1, 2]", "objects[0].class: ", "person, ", "'cat'"),
    scene("[[objects]]\nclass = 'cra'\nplace_m = [1, 2]", "objects[0].class: ", "'cra'", "crate or car?"),
    scene("[[objects]]\nplace_m = [1, 2]", "objects[0].class: ", "missing"),
    scene(CAR, "objects[0]: ", "place_m", "path", "neither"),
    scene(f"{CAR}place_m = [1]", "objects[0].place_m: ", "2 items", "[1]"),
    scene(f"{CAR}place_m = [1, inf]", "objects[0].place_m[1]: ", "finite", "inf"),
    scene(f"{CAR}place_m = [1, 2]\nsize_m = [1, 1, 1]", "objects[0]: ", "car", "size_m"),
    scene(
        f"{CAR}path = {{ waypoints_m = [[0, 0], [0, 0]], speed_mps = 1 }}",
        "objects[0]: ",
        "waypoints",
        "identical",
    ),
    scene(
        f"{CAR}path = {{ waypoints_m = [[0, 0], [0, 1]], speed_mps = 0 }}",
        "objects[0].path.speed_mps: ",
        "got 0",
    ),
    scene("[[plates]]\nid = 50\nsize_m = 1\nplace_m = [0, 0]", "plates[0]: marker 50", "4X4_50", "0 to 49"),
    scene(
        "[[plates]]\ndictionary = '4x4'\nid = 1\nsize_m = 1\nplace_m = [0, 0]",
        "plates[0].dictionary: ",
        "4X4_50, 4X4_100",
        "'4x4'",
    ),
    row(
        "scene missing",
        lambda f: load_scene(f / "field.toml"),
        SceneError,
        "field.toml: ",
        "No such file",
        "village",
    ),
    row(
        "scene in Latin 1",
        lambda f: load_scene(file(f, "field.toml", b"name = '\xff'")),
        SceneError,
        "field.toml: ",
        "UTF-8",
        "line 1",
    ),
    row(
        "lens bent too far",
        lambda _: Lens(CameraModel(160, 120, 104.0, 104.0, 81.0, 58.5, (-2.0, 0.0, 0.0, 0.0))),
        ValueError,
        "distortion (-2.0, ",
        "160x120",
    ),
    row(
        "path of no object",
        lambda _: Scene(FULL, {4: ObjectPath((ORIGIN, (1.0, 0.0, 0.0)), 1.0)}),
        ValueError,
        "paths",
        "[4]",
    ),
    row("camera loss", lambda _: CameraSettings(loss=1.0), ValueError, "frames lost", "0 to below 1", "1.0"),
    row(
        "camera latency",
        lambda _: CameraSettings(latency_s=-1.0),
        ValueError,
        "latency",
        "0 to 5 s",
        "-1.0 s",
    ),
    row("camera rate", lambda _: CameraSettings(rate_hz=0.0), ValueError, "rate", "1000 Hz", "0.0 Hz"),
    row("key of 31 bytes", lambda _: key_of("00" * 31), ValueError, "signing key", "32 bytes", "31"),
    row(
        "key of no kind", lambda _: key_of("nothing"), ValueError, "signing key", "64 hexadecimal", "neither"
    ),
    row("key empty", lambda _: key_of(""), ValueError, "signing key", "32 bytes", "has 0"),
    output("ftp://x", "'ftp://x'", "shm://NAME, pipe:PATH, pipe:-, http://HOST:PORT, rtp://HOST:PORT"),
    output("pipe:", "'pipe:'", "pipe:PATH", "FIFO"),
    output("http://127.0.0.1", "'http://127.0.0.1'", "http://HOST:PORT", "65535"),
    output("http://127.0.0.1:99999", "'http://127.0.0.1:99999'", "http://HOST:PORT", "65535"),
    output("rtp://127.0.0.1:0", "'rtp://127.0.0.1:0'", "rtp://HOST:PORT", "65535"),
    output("rtp://:5600", "'rtp://:5600'", "rtp://HOST:PORT"),
    output("shm://a/b", "shared memory", "file name", "'a/b'"),
    row(
        "object's class",
        lambda _: WorldObject(0, "zebra", ORIGIN),
        ValueError,
        "object 0: ",
        "'zebra'",
        "person",
    ),
    row(
        "object's scale",
        lambda _: WorldObject(0, "car", ORIGIN, scale=0.0),
        ValueError,
        "object 0: scale",
        "0.0",
    ),
    row("shape's class", lambda _: shape_of("zebra", 0), ValueError, "'zebra'", "autumn_tree, bale, barrel"),
    row("print's dictionary", lambda _: Print("4X4_51", 0, 0.5), ValueError, "dictionary '4X4_51'", "4X4_50"),
    row("print's marker", lambda _: Print("4X4_50", 50, 0.5), ValueError, "marker 50", "4X4_50", "0 to 49"),
    row(
        "print's size", lambda _: Print("4X4_50", 0, 0.0), ValueError, "marker's size", "0.01 to 50 m", "0.0"
    ),
    row(
        "plate without print",
        lambda _: WorldObject(0, "plate", ORIGIN),
        ValueError,
        "object 0: ",
        "plate",
        "print",
    ),
    row(
        "car with a size",
        lambda _: WorldObject(0, "car", ORIGIN, size_m=(1.0, 1.0, 1.0)),
        ValueError,
        "object 0: ",
        "car",
        "size_m",
    ),
    row(
        "wall without a width",
        lambda _: WorldObject(0, "wall", ORIGIN, size_m=(1.0, 0.0, 1.0)),
        ValueError,
        "wall's size",
        "0.001 to 500 m",
        "(1.0, 0.0, 1.0)",
    ),
]

TOOLS = [
    row("identities", lambda _: Labelled([1, 1], np.zeros((2, 4))), ValueError, "identities", "[1, 1]"),
    row(
        "identities and boxes",
        lambda _: Labelled([1], np.zeros((2, 4))),
        ValueError,
        "xyxy",
        "(1, 4)",
        "(2, 4)",
    ),
    row("flight", lambda _: flight_named("nix"), UnknownFlightError, "'nix'", "approach, approach-depth"),
    row("no flights", lambda _: summary("follow", []), ValueError, "follow: ", "no flights"),
    row("compiled already", lambda f: compile_simulator(file(f, "built", b"")), FileExistsError, "built"),
    row("no flight", lambda f: read_flight(file(f, "a.tlog", b"")), ValueError, "a.tlog", "ATTITUDE"),
]


def board(*arguments: Any) -> Callable[[Path], object]:
    return lambda _: Board.parse(*arguments)


A4 = (210.0, 297.0)
CAMERA = CameraModel(40, 30, 35.0, 33.0, 19.0, 15.5)
DEPTH = np.ones((30, 40), np.float32)
POINTS = np.zeros((4, 3), np.float32)
PLY = (
    b"ply\nformat %s 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty %s z\nend_header\n"
)
PCD = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nHEIGHT 1\nPOINTS %d\nDATA %s\n"


def lens(model: str, coefficients: int) -> Callable[[Path], object]:
    numbers = (640, 480, 300.0, 300.0, 320.0, 240.0)
    return lambda _: CameraModel(*numbers, (0.0,) * coefficients, model)  # type: ignore[arg-type]


def of_numbers(numbers: tuple[float, float, float, float]) -> Callable[[Path], object]:
    return lambda _: CameraModel(640, 480, *numbers)


def depth(metres: Any = DEPTH, **values: Any) -> Callable[[Path], object]:
    return lambda _: cloud_from_depth(metres, CAMERA, **values)


def cloud(name: str, content: bytes, *words: str) -> Row:
    return row(
        f"cloud {name} {content[-30:]!r}",
        lambda f: read_cloud(file(f, name, content)),
        CloudFileError,
        name,
        *words,
    )


GEOMETRY = [
    row("board's kind", board("circles", "10x7", 0.02), ValueError, "chessboard, charuco", "'circles'"),
    row("board's size", board("chessboard", "10", 0.02), ValueError, "size", "COLUMNSxROWS", "'10'"),
    row("board of 2x7", board("chessboard", "2x7", 0.02), ValueError, "3x3 to 100x100", "2x7"),
    row("square 0", board("chessboard", "10x7", 0.0), ValueError, "side of a square", "above 0 m", "got 0"),
    row("square nan", board("chessboard", "10x7", math.nan), ValueError, "side of a square", "got nan"),
    row(
        "chessboard's marker",
        board("chessboard", "10x7", 0.02, 0.015, None),
        ValueError,
        "chessboard",
        "marker",
    ),
    row("charuco's marker", board("charuco", "10x7", 0.02), ValueError, "charuco", "markers", "dictionary"),
    row(
        "markers as squares",
        board("charuco", "10x7", 0.02, 0.02, "4X4_50"),
        ValueError,
        "markers",
        "0.02 m",
        "0.02",
    ),
    row(
        "charuco's dictionary",
        board("charuco", "10x7", 0.02, 0.015, "4X4_51"),
        ValueError,
        "'4X4_51'",
        "4X4_50",
    ),
    row(
        "charuco's markers",
        board("charuco", "11x10", 0.02, 0.015, "4X4_50"),
        ValueError,
        "11x10",
        "55",
        "4X4_50",
    ),
    row(
        "paper",
        lambda _: marker_sheets(MarkerKind("APRILTAG_36h11", 0.5), [0], A4),
        ValueError,
        "marker 0 of 500 mm",
        "635x662 mm",
        "210x297",
    ),
    row(
        "sheet's marker",
        lambda _: marker_sheets(MarkerKind("4X4_50", 0.1), [50], A4),
        ValueError,
        "id 50",
        "4X4_50",
        "0 to 49",
    ),
    row("mount without markers", lambda _: mount_from_markers([]), CalibrationError, "marker", "none"),
    row(
        "calibration missing",
        lambda f: read_camera_info(f / "none.yaml"),
        ValueError,
        "none.yaml",
        "No such file",
    ),
    row(
        "calibration an image",
        lambda f: read_camera_info(file(f, "a.jpg", b"\xff\xd8\xff\xe0")),
        ValueError,
        "a.jpg",
        "JPEG",
    ),
    row("plumb_bob of 8", lens("plumb_bob", 8), ValueError, "distortion", "plumb_bob", "0, 4 or 5", "got 8"),
    row("plumb_bob of 3", lens("plumb_bob", 3), ValueError, "distortion", "plumb_bob", "0, 4 or 5", "got 3"),
    row(
        "rational of 5", lens("rational_polynomial", 5), ValueError, "rational_polynomial", "8 coeff", "got 5"
    ),
    row("equidistant of 0", lens("equidistant", 0), ValueError, "equidistant", "4 coefficients", "got 0"),
    row("equidistant of 5", lens("equidistant", 5), ValueError, "equidistant", "4 coefficients", "got 5"),
    row(
        "distortion_model", lens("thin_prism", 0), ValueError, "distortion_model", "plumb_bob", "'thin_prism'"
    ),
    *(
        row(f"lens {numbers}", of_numbers(numbers), ValueError, "finite")
        for numbers in (
            (math.nan, 450.0, 320.0, 240.0),
            (450.0, math.nan, 320.0, 240.0),
            (450.0, 450.0, math.nan, 240.0),
            (450.0, 450.0, 320.0, math.nan),
        )
    ),
    row(
        "level image",
        lambda _: level_image(
            np.zeros((120, 160), np.uint8), CameraModel.from_horizontal_fov(320, 240, 1.4), np.eye(3)
        ),
        ValueError,
        "lens",
        "320x240",
        "160x120",
    ),
    row("dictionary's length", lambda _: MarkerKind("4x4", 0.5), ValueError, "'4x4'", "4X4_50, 4X4_100"),
    row(
        "family's length", lambda _: MarkerKind("DICT_5X5", 0.5), ValueError, "'DICT_5X5'", "5X5_50, 5X5_100"
    ),
    row(
        "size of no marker",
        lambda _: MarkerKind("4X4_50", 0.5, {50: 0.1}),
        ValueError,
        "id 50",
        "4X4_50",
        "0 to 49",
    ),
    row(
        "marker's side",
        lambda _: MarkerKind("4X4_50", 0.5, {1: -1}),
        ValueError,
        "marker's side",
        "0 m",
        "got -1",
    ),
    row(
        "marker's image",
        lambda _: MarkerDetector(MarkerKind("4X4_50", 0.5)).detect(
            np.zeros((240, 320, 3), np.uint8), CameraModel.from_horizontal_fov(640, 480, 1.2)
        ),
        ValueError,
        "640x480",
        "320x240",
    ),
    cloud("a.ply", b"", "PLY", "`ply`"),
    cloud("a.ply", b"ply\nformat ascii 1.0\n", "PLY", "`end_header`"),
    cloud("a.ply", PLY % (b"binary_big_endian", 1, b"float"), "binary_big_endian"),
    cloud("a.ply", PLY % (b"binary_little_endian", 3, b"float") + bytes(30), "2 of 3"),
    cloud("a.ply", PLY % (b"ascii", 3, b"float") + b"1 2 3\n", "1 of 3"),
    cloud("a.ply", PLY % (b"ascii", 1, b"float") + b"1 2 x\n", "'x'"),
    cloud("a.ply", PLY % (b"ascii", 1, b"complex"), "complex"),
    cloud("a.ply", PLY % (b"ascii", 1, b"list uchar int"), "list"),
    cloud("a.ply", PLY % (b"binary_little_endian", 1 << 40, b"float"), str(1 << 40)),
    cloud("a.pcd", b"VERSION 0.7\n", "PCD", "`DATA`"),
    cloud("a.pcd", PCD % (1, b"binary_compressed"), "binary_compressed"),
    cloud("a.pcd", PCD % (3, b"binary") + bytes(20), "1 of 3"),
    cloud("a.pcd", b"FIELDS x y\nSIZE 4 4\nTYPE F F\nPOINTS 1\nDATA binary\n" + bytes(8), "name z"),
    cloud("a.pcd", PCD.replace(b"TYPE F", b"TYPE \0") % (1, b"binary") + bytes(20), "TYPE"),
    cloud("a.xyz", b"1 2 3", ".ply or .pcd"),
    row(
        "cloud written as .las",
        lambda f: write_cloud(f / "cloud.las", PointCloud(POINTS)),
        CloudFileError,
        "cloud.las",
        ".ply or .pcd",
    ),
    row(
        "voxel 0",
        lambda _: voxel_grid(PointCloud(POINTS), 0.0),
        ValueError,
        "cell's size",
        "above 0 m",
        "0.0",
    ),
    row(
        "voxel -1",
        lambda _: voxel_grid(PointCloud(POINTS), -1.0),
        ValueError,
        "cell's size",
        "above 0 m",
        "-1.0",
    ),
    row("voxel nan", lambda _: voxel_grid(PointCloud(POINTS), math.nan), ValueError, "cell's size", "nan"),
    row(
        "voxel tiny",
        lambda _: voxel_grid(PointCloud(np.eye(3, dtype=np.float32)), 1e-12),
        ValueError,
        "cells of 1e-12 m",
    ),
    row("depth's size", depth(np.ones((30, 41), np.float32)), ValueError, "depth", "(30, 40)", "(30, 41)"),
    row(
        "depth's image",
        depth(image=np.zeros((30, 39, 3), np.uint8)),
        ValueError,
        "image",
        "(30, 40, 3)",
        "(30, 39, 3)",
    ),
    row("average 0", depth(average=0), ValueError, "average", "1 to 30", "got 0"),
    row("average 31", depth(average=31), ValueError, "average", "1 to 30", "got 31"),
    row("body without mount", depth(frame="body"), ValueError, "'body'", "mount"),
    row("ned without attitude", depth(frame="ned", mount=CameraMount()), ValueError, "'ned'", "attitude"),
    row("cloud on a gimbal", depth(frame="body", mount=CameraMount(on_gimbal=True)), ValueError, "gimbal"),
    row(
        "points' shape",
        lambda _: PointCloud(np.zeros((4, 2), np.float32)),
        ValueError,
        "points",
        "(4, 2) float32",
    ),
    row("points' type", lambda _: PointCloud(np.zeros((4, 3))), ValueError, "points", "(4, 3) float64"),  # type: ignore[arg-type]
    row(
        "points nan",
        lambda _: PointCloud(np.full((4, 3), np.nan, np.float32)),
        ValueError,
        "points",
        "finite",
    ),
    row(
        "colours",
        lambda _: PointCloud(POINTS, np.zeros((3, 3), np.uint8)),
        ValueError,
        "colours",
        "(4, 3) uint8",
        "(3, 3) uint8",
    ),
    row("points' frame", lambda _: PointCloud(POINTS, None, "map"), ValueError, "camera, body, ned", "'map'"),  # type: ignore[arg-type]
    row(
        "body of ned",
        lambda _: PointCloud(POINTS, frame="ned").in_body(CameraMount()),
        ValueError,
        "'camera'",
        "'ned'",
    ),
    row(
        "ned of ned",
        lambda _: PointCloud(POINTS, frame="ned").in_ned(np.eye(3)),
        ValueError,
        "'body'",
        "got 'ned'",
    ),
    row(
        "few points",
        lambda _: align(PointCloud(np.eye(3, dtype=np.float32)), PointCloud(np.eye(3, dtype=np.float32))),
        RegistrationError,
        "source has 3",
        "20",
    ),
]


def source(uri: str, values: dict[str, Any], *words: str) -> Row:
    return row(
        f"source {uri} {values}",
        lambda _: open_source(uri, SourceSettings(**values)),
        SourceError,
        f"{uri}: ",
        *words,
    )


def source_settings(values: dict[str, Any], *words: str) -> Row:
    return row(f"source {values}", lambda _: SourceSettings(**values), ValueError, *values, *words)


def video(name: str, size: tuple[int, int], rate_hz: float, *words: str) -> Row:
    def write(folder: Path) -> None:
        file(folder, "file", b"in the way")
        (folder / "taken.webm").mkdir()
        VideoWriter(folder / name, *size, rate_hz)

    return row(f"video {name} {size} {rate_hz}", write, VideoWriterError, f"{name}: ", *words)


def segment(name: str) -> Row:
    return row(
        f"segment {name!r}", lambda _: SharedFrameReader(name), ValueError, "shared memory", repr(name)
    )


SOURCES = [
    source_settings({"width": 0}, "1..32768", "got 0"),
    source_settings({"rate_hz": 0.0}, "1000", "0.0"),
    source_settings({"rate_hz": math.nan}, "1000", "nan"),
    source_settings({"open_timeout_s": 0.0}, "3600 s", "0.0"),
    source_settings({"retry_min_s": 5.0, "retry_max_s": 1.0}, "5.0", "3600 s", "1.0"),
    source_settings({"pixel_format": "yuv"}, "bgr24", "'yuv'"),
    source_settings({"rotate_deg": 45}, "0, 90, 180 or 270", "got 45"),
    source("csi://front", {}, "csi://NUMBER"),
    source("csi://0", {"width": 640}, "both width and height"),
    source("csi://0", {"width": 650, "height": 480}, "width", "64", "650"),
    source("csi://0", {"width": 640, "height": 481}, "even", "640x481"),
    source("csi://0", {"pixel_format": "YUYV"}, "pixel_format", "yuv420 or mjpeg", "'YUYV'"),
    row("camera 98765", lambda _: open_source("98765"), SourceError, "/dev/video98765: "),
    row(
        "payload",
        lambda _: UdpStream("udp://:5600?format=rtp-h264&payload=200", SourceSettings()),
        SourceError,
        "payload ",
        "0 to 127",
        "'200'",
    ),
    row(
        "name of shared memory",
        lambda _: segment_path("n" * 300),
        ValueError,
        "shared memory",
        "200 characters",
        "'nnnn",
    ),
    row(
        "source of shared memory",
        lambda _: open_source(f"shm://{'n' * 300}"),
        SourceError,
        "shm://nnnn",
        "200 characters",
    ),
    row(
        "source of no shared memory",
        lambda _: open_source(f"shm://{'n' * 100}", SourceSettings(open_timeout_s=0.3, retry_min_s=0.1)),
        SourceError,
        "'nnnn",
        "No such file",
    ),
    source(
        "shm://test-none",
        {"open_timeout_s": 0.3, "retry_min_s": 0.1},
        "0.3 s",
        "'test-none'",
        "No such file",
        "writer",
    ),
    row(
        "y4m height", lambda _: parse_y4m_header(b"YUV4MPEG2 W640 C420"), StreamError, "height", "1 to 32768"
    ),
    row("y4m W0", lambda _: parse_y4m_header(b"YUV4MPEG2 W0 H480"), StreamError, "width", "1 to 32768", "W0"),
    row(
        "y4m W-4",
        lambda _: parse_y4m_header(b"YUV4MPEG2 W-4 H480"),
        StreamError,
        "width",
        "1 to 32768",
        "W-4",
    ),
    row("y4m W99999", lambda _: parse_y4m_header(b"YUV4MPEG2 W99999 H480"), StreamError, "width", "W99999"),
    row(
        "y4m colours",
        lambda _: parse_y4m_header(b"YUV4MPEG2 W4 H4 C420p10"),
        StreamError,
        "C420p10",
        "yuv420p",
    ),
    row("y4m magic", lambda _: parse_y4m_header(b"RIFFxxxx"), StreamError, "YUV4MPEG2", "RIFFxxxx"),
    row(
        "y4m without line",
        lambda _: Y4mParser().push(b"YUV4MPEG2 " + b"W" * 5000),
        StreamError,
        "YUV4MPEG2",
        "4096",
    ),
    row("rate 0", lambda _: FrameSelector(0.0), ValueError, "rate_hz", "above 0", "0.0"),
    row("rate -1", lambda _: FrameSelector(-1.0), ValueError, "rate_hz", "above 0", "-1.0"),
    *(segment(name) for name in ("", "..", "a/b", "../x", "a\0b")),
    video("video.mp4", (64, 48), 10.0, ".webm"),
    video("video.webm", (0, 48), 10.0, "1..16383 pixels", "0x48"),
    video("video.webm", (64, 48), 0.0, "rate_hz", "0.1..240", "0.0"),
    video("file/video.webm", (64, 48), 10.0, "File exists"),
    video("taken.webm", (64, 48), 10.0, "Is a directory"),
    row("recorded mp4", lambda f: Recording(f / "a.mp4", 20.0), VideoWriterError, "a.mp4: ", ".webm"),
    row(
        "recorded in a file",
        lambda f: Recording(file(f, "file", b"") / "a.webm", 20.0),
        VideoWriterError,
        "file/a.webm: ",
        "File exists",
    ),
]


def yaml(text: str, *words: str) -> Row:
    return row(f"yaml {text[:30]!r}", lambda _: load_plain_yaml(text), PlainYamlError, *words)


def text_file(name: str, content: bytes, *words: str) -> Row:
    return row(name, lambda f: read_text(file(f, "names.txt", content)), NotUtf8Error, *words, "UTF-8")


def tracker(values: dict[str, Any], *words: str) -> Row:
    return row(f"tracker {values}", lambda _: TrackerSettings(**values), ValueError, *values, *words)


def stage(values: dict[str, Any], *words: str) -> Row:
    made = {"width": 64, "height": 64, "batch_size": 1, "steps": 100, **values}
    return row(f"stage {values}", lambda _: of("vision.training.training:Stage")(**made), ValueError, *words)


def training(changes: dict[str, Any], *words: str) -> Row:
    def make(_: Path) -> object:
        small = of("vision.training.training:Stage")(64, 64, 4, 4)
        values = {"class_names": ("red", "green"), "stages": (small,), **changes}
        return of("vision.training.training:TrainingSettings")(**values)

    return row(f"training {changes}", make, ValueError, *words)


def three(**tracks: Any) -> Detections:
    boxes = np.arange(12, dtype=np.float32).reshape(3, 4)
    scores, classes = np.array([0.9, 0.5, 0.2], np.float32), np.array([0, 1, 1])
    return Detections(boxes, scores, classes, ("person", "car"), **tracks)


def highlighted(index: int) -> Callable[[Path], object]:
    return lambda _: annotate(np.zeros((16, 16, 3), np.uint8), three(), highlight=index)


def named_in_latin_1(suffix: str) -> Row:
    path = Path(os.fsdecode(b"caf\xe9" + suffix.encode()))
    return row(f"name of {suffix} in Latin 1", lambda _: read_source(path), CheckpointError, suffix, "UTF-8")


def image_size(pixels: int) -> Row:
    return row(
        f"image_size {pixels}",
        lambda _: fit(640, 480, pixels),
        ValueError,
        "image_size",
        "32",
        f"got {pixels}",
    )


NETWORKS = [
    row(
        "data set missing",
        lambda f: datasets.open_dataset(f / "none"),
        datasets.DatasetError,
        "none: ",
        "data.yaml",
    ),
    row("data set empty", datasets.open_dataset, datasets.DatasetError, "no images", "images/ and labels/"),
    row(
        "precision of nothing",
        lambda _: average_precision(np.zeros(0, np.float32), np.zeros(0, bool), 0),
        ValueError,
        "average precision",
        "one true object",
        "got 0",
    ),
    row(
        "plan missing",
        lambda f: read_source(f / "none.engine"),
        RuntimeUnusableError,
        "none.engine: ",
        "NAME.safetensors",
    ),
    row("folder without a model", read_source, CheckpointError, "0 .xml files"),
    *(named_in_latin_1(suffix) for suffix in (".pt", ".onnx", ".xml", ".torchscript")),
    row(
        "runtime",
        lambda _: Detector("/none.pt", runtime="abacus"),  # type: ignore[arg-type]
        ValueError,
        "runtime",
        "auto, torch, onnxruntime, openvino, tensorrt",
        "'abacus'",
    ),
    row("model missing", lambda f: Detector(f / "none.pt"), CheckpointError, "none.pt: ", "NAME.safetensors"),
    row(
        "checkpoint missing",
        lambda f: of("vision.yolo.checkpoint:load_checkpoint")(f / "none.pt"),
        CheckpointError,
        "none.pt: ",
        ".pt checkpoint",
    ),
    row(
        "checkpoint a folder",
        lambda f: of("vision.yolo.checkpoint:load_checkpoint")(f),
        CheckpointError,
        "folder",
        ".pt checkpoint",
    ),
    row(
        "family",
        lambda _: of("vision.training.published:published_description")("YOLO13", "n", ("car",)),
        "vision.yolo.architecture:ArchitectureError",
        "'YOLO13'",
        "YOLOv5u, YOLOv8",
    ),
    row(
        "scale",
        lambda _: of("vision.training.published:published_description")("YOLO11", "b", ("car",)),
        "vision.yolo.architecture:ArchitectureError",
        "YOLO11",
        "'b'",
        "n, s, m, l, x",
    ),
    row(
        "outputs without sides",
        lambda _: boxes_of(
            Head((8,), 16, False, 1, (0,)), [LevelOutput(classes=np.ones((1, 2, 2), np.float32))]
        ),
        ValueError,
        "neck",
        "branches",
    ),
    *(image_size(pixels) for pixels in (0, 31, 100, -32)),
    row(
        "letterbox of another frame",
        lambda _: fit(640, 480).apply(np.zeros((10, 10, 3), np.uint8)),
        ValueError,
        "letterbox",
        "(480, 640, 3)",
        "(10, 10, 3)",
    ),
    row("letterbox of nothing", lambda _: fit(0, 480), ValueError, "size", "0x480"),
    yaml("a: 1\nb: !!python/object/apply:os.system [id]", "line 2: ", "python/object/apply:os.system"),
    yaml("a: &x [1]\nb: *x", "line 1: ", "(& and *)"),
    yaml("a: 1\na: 2", "line 2: ", "key 'a'"),
    yaml("? [1, 2]\n: 3", "line 1: ", "key", "plain value"),
    yaml("a: [1, 2", "line ", "']'"),
    yaml("a: \0", "#x0000"),
    yaml("--- 1\n--- 2\n", "line 2: ", "document"),
    yaml("[" * 100 + "]" * 100, "line 1: ", "32 levels"),
    yaml("[" + "[]," * 200_000 + "]", "100000 values"),
    yaml(" " * (3 << 20), "3145728 characters", "2097152"),
    text_file("UTF-16", "a".encode("utf-16"), "UTF-16"),
    text_file("UTF-16 of the other order", b"\xfe\xff\x00a", "UTF-16"),
    text_file("Latin 1", b"ok\nFu\xdfg", "line 2, byte 5"),
    row(
        "cost nan",
        lambda _: association.assign(np.array([[1.0, np.nan], [0.0, 1.0]])),
        ValueError,
        "cost",
        "finite",
    ),
    row(
        "cost inf",
        lambda _: association.assign(np.array([[1.0, np.inf], [0.0, 1.0]])),
        ValueError,
        "cost",
        "finite",
    ),
    tracker({"low_confidence": 0.5, "high_confidence": 0.4}, "0 to 1", "0.5 and 0.4"),
    tracker({"high_confidence": 1.5}, "0 to 1", "1.5"),
    tracker({"confirm_score": -0.1}, "0 to 1", "-0.1"),
    tracker({"keep_confidence": 2.0}, "0 to 1", "got 2"),
    tracker({"min_iou": math.nan}, "0 to 1", "nan"),
    tracker({"min_hits": 0}, "1", "got 0"),
    tracker({"coast_timeout_s": 0.0}, "max_age_s", "0 and 2"),
    tracker({"coast_timeout_s": 3.0, "max_age_s": 2.0}, "3 and 2"),
    training({"stages": ()}, "one stage"),
    training({"learning_rate": 0.0}, "learning rate"),
    training({"average_decay": 1.0}, "average_decay"),
    row(
        "track_id alone",
        lambda _: three(track_id=np.array([1, 2, 3])),
        ValueError,
        "track_id, track_score, track_confirmed",
        "track_score is",
    ),
    row(
        "tracks of two boxes",
        lambda _: three(
            track_id=np.arange(1, 4),
            track_score=np.zeros(3, np.float32),
            track_confirmed=np.zeros(2, np.bool_),
        ),
        ValueError,
        "track_confirmed",
        "(3,)",
        "(2,)",
    ),
    *(
        row(f"highlight {index}", highlighted(index), IndexError, "highlight", "0..2", f"got {index}")
        for index in (-1, 3)
    ),
    stage({"rate": 0.0}, "rate of a stage", "rate=0.0"),
    stage({"decay_steps": -1}, "decay_steps of a stage", "decay_steps=-1"),
    stage({"decay_steps": 101}, "decay_steps of a stage", "decay_steps=101"),
    stage({"width": 100}, "32 pixels", "100x64"),
]

PACKAGES = [SERVICE, SETTINGS, GUIDANCE, LANGUAGE, VEHICLE, SIMULATOR, TOOLS, GEOMETRY, SOURCES, NETWORKS]
ROWS = [each for package in PACKAGES for each in package]


@pytest.mark.parametrize("one", ROWS, ids=[each.name for each in ROWS])
def test_error_names_the_thing_and_what_came(one: Row, tmp_path: Path) -> None:
    error = of(one.error) if isinstance(one.error, str) else one.error
    with pytest.raises(error) as refused:
        one.call(tmp_path)
    text = str(refused.value)
    assert [word for word in one.words if word not in text] == []
    assert len(text.splitlines()) == 1
    assert len(text.replace(str(tmp_path), "")) <= LONGEST
    assert [word for word in FOREIGN if word in text] == []
