"""Bodies of the messages about the service: status, events, and the replies to commands and queries."""

from __future__ import annotations

from typing import Annotated, NotRequired

from typing_extensions import TypedDict

from companion.bus.bodies import Sha256, Two, one_of

LevelWord = Annotated[str, one_of("info", "warning", "error")]
CommandStateWord = Annotated[str, one_of("accepted", "in_progress", "ended")]
Corners = list[Two]


class OtherCommanderBody(TypedDict):
    """Another service that commands this vehicle."""

    via: str
    """mavlink or zenoh"""
    identity: str
    """its MAVLink address, or service of its status"""
    uptime_s: float
    """since its start"""
    in_command: bool
    """whether it is in command"""


class StatusSilenceBody(TypedDict):
    """What the autopilot does in flight when our setpoints stop."""

    effect: str
    """return, land, hold, pilot, sink, drift, fall, fly_on or unknown"""
    mode: str
    """the flight mode then; unknown: none is entered, or it is not known"""
    after_s: float | None
    """from the last setpoint; null: not known, or never"""
    warning: bool
    """it endangers the vehicle, takes longer than 2 s, or is not known"""
    text: str
    """one sentence"""


class StatusReceptionBody(TypedDict):
    """Received MAVLink frames since the link was opened."""

    frames: int
    """of the autopilot"""
    split: int
    """put together from several datagrams"""
    lost: int
    """missing in the autopilot's sequence numbers"""
    skipped_bytes: int
    """in no frame: not MAVLink, damaged, or rests of lost datagrams"""


class StatusVehicleBody(TypedDict):
    """The link to the vehicle."""

    name: str
    """its name"""
    connected: bool
    """a heartbeat was received within 3 s"""
    autopilot: str | None
    """PX4 or ArduPilot; null until known"""
    firmware: str | None
    """its version, for example 1.16.2; null until known"""
    driver: str
    """MAVLink library: mavsdk or pymavlink"""
    mode: str
    """flight mode"""
    armed: bool
    """motors are armed"""
    failsafe: bool
    """MAV_STATE_CRITICAL or EMERGENCY"""
    not_flown: str | None
    """why it gets no flight commands, by its type; null: it gets them"""
    sticks: str | None
    """what a pilot's sticks do while our setpoints are flown; null until known"""
    silence: StatusSilenceBody
    """without setpoints"""
    without_service: str
    """what the vehicle does if the service ends now, one sentence"""
    missing_streams: list[str]
    """required messages that arrive at less than half their rate"""
    reception: StatusReceptionBody
    """frames received, split and lost"""
    status_texts: list[str]
    """the autopilot's last 20 texts, newest last"""
    other_commanders: list[OtherCommanderBody]
    """other services seen within 3.5 s"""


class StatusStepBody(TypedDict):
    """A step of a mission that has ended."""

    title: str
    """its title in the mission"""
    command: str
    """its command"""
    success: bool
    """it reached its goal"""
    reason: str
    """how it ended"""
    started_ns: int
    """its start"""
    ended_ns: int
    """its end"""


class StatusMissionBody(TypedDict):
    """The active mission."""

    name: str
    """its name"""
    steps: list[str]
    """titles"""
    current: int
    """index of the active step"""
    failure: str
    """why its failure handling is active; empty: it is not"""
    ended: list[StatusStepBody]
    """the last 20 steps"""


class StatusLimitsBody(TypedDict):
    """Where the vehicle may fly, from home."""

    max_distance_m: float
    """horizontally"""
    max_altitude_m: float
    """above home"""
    max_horizontal_speed_mps: float
    """horizontal speed, after the autopilot's own limit"""
    max_climb_mps: float
    """upwards, after the autopilot's own limit"""
    max_descend_mps: float
    """downwards, after the autopilot's own limit"""
    fence_include: Corners
    """corners north, east; empty: no fence"""
    fence_exclude: list[Corners]
    """areas not to enter"""


class StatusCommandBody(TypedDict):
    """The command that the vehicle flies."""

    id: str
    """as in command_state"""
    command: str
    """the command as understood"""


class StatusPilotBody(TypedDict):
    """Guidance."""

    in_command: bool
    """the vehicle follows our setpoints"""
    behaviour: str
    """the active one"""
    stream: str
    """state of the streamer"""
    setpoints_sent: int
    """so far"""
    mission: StatusMissionBody | None
    """null: no mission is active"""
    command: StatusCommandBody | None
    """the one that has begun and not ended; null: none has"""


class StatusCameraBody(TypedDict):
    """One camera with its worker process."""

    state: str
    """stopped, starting, running, restarting, finished or failed"""
    pid: int | None
    """of the process"""
    restarts: int
    """so far"""
    frames: int
    """read so far"""
    results: int
    """received so far"""
    rate_hz: float
    """results a second"""
    sequence: int | None
    """of the newest result"""
    age_s: float | None
    """of the newest result"""
    timing_ms: dict[str, float]
    """stage: newest duration"""
    timing_p50_ms: dict[str, float]
    """stage: median of the newest 200"""
    timing_p99_ms: dict[str, float]
    """stage: 99th percentile of the newest 200"""
    dropped: int
    """frames lost unintentionally"""
    frames_skipped: dict[str, int]
    """reason: frames without a message"""
    frames_repeated: dict[str, int]
    """image or depth: frames identical to the one before"""
    stuck_after_s: float | None
    """silence after which the process is restarted"""
    class_names: list[str]
    """classes of the model"""
    tracks: int
    """confirmed tracks that have not ended"""
    model: str | None
    """name of the model"""
    model_sha256: Sha256 | None
    """of its file"""
    runtime: str | None
    """of the network"""
    precision: str | None
    """of the network"""
    runtime_reason: str
    """why this runtime and precision"""
    problem: str
    """why it does not run: the last error; empty: it runs"""


class StatusTargetsBody(TypedDict):
    """The objects that guidance may use."""

    camera: str | None
    """the steering camera; null: the first"""
    count: int
    """number of objects in its newest frame; 0 while frames do not arrive"""
    localization_error: str
    """why detections have no direction; empty if they have, or if there are none"""


class StatusGimbalBody(TypedDict):
    """The gimbal in `status`."""

    answers: bool
    """a gimbal was received"""
    pitch_deg: float | None
    """above the horizon; null while it is not reported"""
    primary_control: str | None
    """MAVLink address with primary control"""
    ours: bool
    """whether the service has primary control"""
    problem: str | None
    """why its attitude is unknown, or why it is not moved"""


class StatusNeighboursBody(TypedDict):
    """The other vehicles."""

    ages_s: dict[str, float]
    """vehicle: age of its pose"""
    out_of_order: int
    """messages older than the newest"""


class StatusBusBody(TypedDict):
    """The network."""

    connected: bool
    """a node is connected, or none is expected"""
    published: dict[str, int]
    """topic: messages so far, with or without a subscriber"""
    publish_failed: int
    """messages without a session, or refused by zenoh"""
    refused_commands: int
    """commands refused by the rate limit"""
    ignored: dict[str, int]
    """topic that is listened to: messages that were too large, not valid, or too many"""


class PartBody(TypedDict):
    """A part from outside: the autopilot, a camera, zenoh."""

    name: str
    """autopilot, camera, camera NAME or zenoh"""
    state: str
    """starting, ready, missing, retrying, failed or finished"""
    reason: str
    """why it is not ready; empty: it is"""
    since_ns: int
    """begin of the state"""
    next_try_ns: int | None
    """when it is tried again; null: all the time, or it needs no try"""


SettingValue = float | list[str | int]


class ChangedSettingBody(TypedDict):
    """A setting that was changed since the start."""

    key: str
    """for example guidance.max_altitude_m"""
    value: SettingValue
    """now"""
    file: SettingValue
    """at the start, and after the next one"""


class LiveSettingBody(TypedDict):
    """One setting in the reply of `settings`."""

    value: SettingValue
    """now"""
    file: SettingValue
    """at the start, and after the next one"""
    expected: str
    """its values in words"""
    minimum: float | None
    """of its range"""
    maximum: float | None
    """of its range"""
    narrower: Annotated[str, one_of("smaller", "larger")] | None
    """values that are accepted while armed; null: all"""


class StatusLogBody(TypedDict):
    """The log."""

    dropped_lines: int
    """lines not written because the reader stalled"""


class StatusBody(TypedDict):
    """The state of every part of the service."""

    stamp_ns: int
    """of this message"""
    unix_offset_ns: int
    """system clock minus CLOCK_MONOTONIC of this host, now: makes Unix time of a stamp"""
    service: str
    """changes at each start; source in pose"""
    uptime_s: float
    """since the start of the service"""
    healthy: bool
    """every camera delivers results, and the autopilot, if there is to be one, is connected"""
    unhealthy: list[str]
    """why it is not healthy; empty: it is"""
    parts: list[PartBody]
    """what comes from outside; without an autopilot in it there is no vehicle (vehicle.url is none)"""
    vehicle: StatusVehicleBody
    """the link to the vehicle"""
    pilot: StatusPilotBody
    """guidance"""
    limits: StatusLimitsBody
    """where the vehicle may fly"""
    changed_settings: list[ChangedSettingBody]
    """that differ from the file"""
    perception: StatusCameraBody
    """the first camera"""
    cameras: dict[str, StatusCameraBody]
    """name: each further camera"""
    targets: StatusTargetsBody
    """objects that guidance may use"""
    gimbal: StatusGimbalBody | None
    """null without a gimbal and a camera on one"""
    neighbours: StatusNeighboursBody
    """other vehicles"""
    bus: StatusBusBody
    """the network"""
    log: StatusLogBody
    """the log"""


class EventBody(TypedDict):
    """One event of the service."""

    stamp_ns: int
    """when"""
    level: LevelWord
    """severity"""
    text: str
    """for the operator"""


class CommandStateBody(TypedDict):
    """A command has reached a state. The last message of every command has the state ended."""

    stamp_ns: int
    """when"""
    id: str
    """of the command: service of status, and its number there"""
    command: str
    """the command as understood"""
    state: CommandStateWord
    """accepted: given to guidance; in_progress: flown, without an end of its own; ended: also if refused"""
    success: bool | None
    """result; null before the end"""
    reason: str
    """why it has ended; empty: accepted"""


class StepBody(TypedDict):
    """One ended step of a mission."""

    title: str
    """name of the step"""
    command: str
    """its command"""
    success: bool
    """result"""
    reason: str
    """reason of the result"""
    started_ns: int
    """begin"""
    ended_ns: int
    """end"""


class CommandReplyBody(TypedDict):
    """The reply to a command."""

    id: NotRequired[str]
    """as in command_state; missing where the command was refused before it was read"""
    state: NotRequired[CommandStateWord]
    """in_progress: it goes on, and command_state will have its end; ended: it does not"""
    command: str
    """the command as understood"""
    success: bool
    """result"""
    reason: str
    """reason of the result"""
    steps: NotRequired[list[StepBody]]
    """of a mission: its ended steps"""


class ModelBody(TypedDict):
    """One loaded model, in the reply of `models`."""

    camera: str | None
    """name of the camera; null: the first"""
    running: bool
    """whether its process runs"""
    model: str
    """its name"""
    model_sha256: Sha256 | None
    """of its file; null for a detector without one"""
    class_names: list[str]
    """its classes"""
    runtime: str | None
    """of the network"""
    precision: str | None
    """of the network"""


class PortParametersBody(TypedDict):
    """The reply of `port_parameters`."""

    parameters: dict[str, float]
    """of the autopilot's serial ports, those that it has"""
    not_read: str
    """why they are not read; empty: they are"""


class ModelsBody(TypedDict):
    """The reply of `models`."""

    loaded: list[ModelBody]
    """the models in use"""
    files: list[str]
    """file names in the models folder"""
