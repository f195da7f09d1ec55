"""`mavlink-sim camera`: the built-in world rendered from the pose of any autopilot on a link."""

from __future__ import annotations

import json
import math
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import Annotated, NoReturn

import typer

from mavlink_sim.camera.autopilot_link import AutopilotLink
from mavlink_sim.camera.cli_options import CameraOutputs, CameraRate, CameraTruth, SceneName
from mavlink_sim.camera.process import OUTPUT_FAILED, CameraProcess
from mavlink_sim.camera.scene import Scene
from mavlink_sim.camera.scene_file import scene_or_demo
from mavlink_sim.camera.vehicle_pose import Pose, PoseHistory, Vector
from mavlink_sim.camera.video_outputs import STANDARD_OUTPUT
from mavlink_sim.world.truth_file import TruthFile, object_truth
from vision.attitude import euler_from_quaternion

VEHICLE_TIMEOUT_S = 10.0
OTHERS_S = 1.5
"""Time after the first heartbeat: each autopilot on the link sends one per second."""
POSE_TIMEOUT_S = 60.0
"""An autopilot that has just started has no position before its estimator has converged."""
POSE_LOST_S = 3.0
TRUTH_RATE_HZ = 20.0
POLL_S = 0.05

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


class CameraError(Exception):
    """The camera cannot start (exit code 2) or continue (1). The text is one line for the user."""

    def __init__(self, text: str, code: int = 2) -> None:
        super().__init__(text)
        self.code = code


@app.command()
def camera(
    vehicle_url: Annotated[
        str,
        typer.Option(help="The autopilot's link: udpin://HOST:PORT, udpout://HOST:PORT or tcp://HOST:PORT."),
    ],
    scene: SceneName = None,
    camera: Annotated[
        str | None, typer.Option(help="Send frames with depth to this shared memory; read it as shm://NAME.")
    ] = None,
    camera_rate: CameraRate = None,
    camera_output: CameraOutputs = None,
    camera_truth: CameraTruth = None,
    truth: Annotated[
        Path | None,
        typer.Option(help="Write the pose and the range to every object to this file, JSON lines, 20 Hz."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the demo world.")] = 0,
    origin: Annotated[
        str | None,
        typer.Option(
            help="Origin of the world in the autopilot's local frame: N,E,D in metres; "
            "default: the vehicle's position when the camera starts."
        ),
    ] = None,
    listen_only: Annotated[
        bool, typer.Option("--listen-only", help="Send nothing, not even requests for the pose.")
    ] = False,
) -> None:
    """Render the built-in world from any autopilot's vehicle, until interrupted (Ctrl-C).

    Attitude and position come from ATTITUDE_QUATERNION (or ATTITUDE) and LOCAL_POSITION_NED, or from
    HIL_STATE_QUATERNION where a simulator sends it. Exit code 2: it cannot start; 1: the pose stopped.
    """
    if STANDARD_OUTPUT in (camera_output or []):
        sys.stdout = sys.stderr  # standard output carries only the frames
    try:
        if camera_rate is not None and not 1.0 <= camera_rate <= 120.0:
            raise CameraError(f"--camera-rate {camera_rate:g}: expected 1 to 120")
        chosen = scene_or_demo(scene, seed)
        rate_hz = camera_rate or chosen.camera.rate_hz
        world_origin = None if origin is None else _parse_origin(origin)
        with ExitStack() as resources:
            process = CameraProcess(
                chosen, rate_hz=rate_hz, shared_name=camera, outputs=camera_output or (), truth=camera_truth
            )
            lines = None
            if truth is not None:
                lines = TruthFile(truth)
                resources.callback(lines.close)
            link = AutopilotLink(vehicle_url, listen_only)
            resources.callback(link.close)
            resources.callback(process.stop)
            process.start()
            _Run(link, process, chosen, rate_hz, world_origin, lines).run()
    except CameraError as error:
        _fail(str(error), error.code)
    except (OSError, ValueError) as error:
        _fail(str(error), 2)
    print("stopped", flush=True)


def _parse_origin(text: str) -> Vector:
    try:
        north, east, down = map(float, text.split(","))
    except ValueError:
        north = east = down = math.nan
    if not all(map(math.isfinite, (north, east, down))):
        raise CameraError(f"--origin {text!r}: expected N,E,D in metres, for example 0,0,-1.5")
    return north, east, down


def _fail(text: str, code: int) -> NoReturn:
    print(f"mavlink-sim camera: {text}", file=sys.stderr, flush=True)
    raise typer.Exit(code)


class _Run:
    """Passes one autopilot's poses to the camera's process, from the search for it to the end."""

    def __init__(
        self,
        link: AutopilotLink,
        process: CameraProcess,
        scene: Scene,
        rate_hz: float,
        origin: Vector | None,
        lines: TruthFile | None,
    ) -> None:
        self._link, self._process, self._scene = link, process, scene
        self._rate_hz, self._origin, self._lines = rate_hz, origin, lines
        self._history = PoseHistory()
        self._stopping = False
        self._start_ns: int | None = None
        self._next_ns = self._next_truth_ns = 0
        self._stamp_ns = 0

    def run(self) -> None:
        """Run until SIGINT or SIGTERM. Raises CameraError."""

        def stop(_number: int, _frame: FrameType | None) -> None:
            self._stopping = True

        before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            self._find_autopilot()
            self._wait_for_pose()
            self._draw()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _receive(self) -> None:
        try:
            messages = self._link.receive(POLL_S)
        except ConnectionError as error:
            raise CameraError(f"the pose stopped: {error}", 1) from error
        for message in messages:
            self._history.add(message, time.monotonic_ns())
        if not self._process.alive and not self._stopping:
            code = self._process.exit_code
            raise CameraError(
                "an output of the camera cannot be opened, see the line before"
                if code == OUTPUT_FAILED
                else f"the camera's process ended with code {code}",
                2 if code == OUTPUT_FAILED else 1,
            )

    def _until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Receive until a condition is met; False: not in time. A signal ends it too."""
        deadline_s = time.monotonic() + timeout_s
        while not self._stopping:
            if condition():
                return True
            if time.monotonic() > deadline_s:
                return False
            self._receive()
        return True

    def _find_autopilot(self) -> None:
        link = self._link
        if not self._until(lambda: bool(link.systems), VEHICLE_TIMEOUT_S):
            raise CameraError(
                f"no autopilot within {VEHICLE_TIMEOUT_S:g} s: expected its HEARTBEAT on --vehicle-url; "
                "check that it runs and sends to that address"
            )
        self._until(lambda: max(len(link.systems), len(link.senders)) > 1, OTHERS_S)
        if len(link.systems) > 1:
            found = " and ".join(map(str, sorted(link.systems)))
            raise CameraError(f"autopilots of system ids {found} on one link; use a separate port for each")
        if len(link.senders) > 1:
            found = " and ".join(f"{host}:{port}" for _, (host, port) in sorted(link.senders))
            (system,) = link.systems
            raise CameraError(f"two autopilots of system id {system} on one link ({found}); end one of them")
        if link.systems:
            (link.system_id,) = link.systems

    def _wait_for_pose(self) -> None:
        history, system_id = self._history, self._link.system_id

        def known() -> bool:
            if (span := history.span_ns) is not None and self._origin is None:
                self._place_origin(history.at(span[1]).position)
            return span is not None and self._process.ready

        if not self._until(known, 2 * OTHERS_S):
            if history.missing:
                print(f"waiting for {' and '.join(history.missing)} of system {system_id}", flush=True)
            if not self._until(known, POSE_TIMEOUT_S):
                what = " and ".join(history.missing) or "pose"
                raise CameraError(
                    f"system {system_id} sent no {what} within {POSE_TIMEOUT_S:g} s: its estimator "
                    "has no position yet, or its link does not send it and takes no request"
                )

    def _draw(self) -> None:
        history, period_ns = self._history, 1e9 / self._rate_hz
        others: set[int] = set()
        newest_ns, advanced_s, announced = None, time.monotonic(), False
        while not self._stopping:
            span = history.span_ns
            if span is not None and span[1] != newest_ns:
                newest_ns, advanced_s = span[1], time.monotonic()
                if self._start_ns is None or not span[0] <= self._next_ns <= span[1] + 1e9:
                    self._begin(span[1])  # also after a restart of the vehicle's clock
                if span[1] >= self._next_ns:
                    # Several may be due where poses arrive less often than frames: the newest is drawn.
                    due = int((span[1] - self._next_ns) // period_ns)
                    self._show(self._next_ns + round(due * period_ns))
                    self._next_ns += round((due + 1) * period_ns)
            elif time.monotonic() - advanced_s > POSE_LOST_S:
                self._receive()  # messages received while this process was stopped are used
                if history.span_ns == span:
                    text = f"the pose of system {self._link.system_id} stopped {POSE_LOST_S:g} s ago"
                    raise CameraError(f"{text}; no more frames are written", 1)
            if not announced and self._process.written:
                announced = True
                self._announce()
            if found := set(self._link.systems) - {self._link.system_id} - others:
                others |= found
                print(f"ignoring system {', '.join(map(str, found))}, also on this link", file=sys.stderr)
            self._receive()

    def _begin(self, boot_ns: int) -> None:
        self._start_ns = self._next_ns = self._next_truth_ns = boot_ns

    def _place_origin(self, position: Vector) -> None:
        """Set the world's origin below the vehicle, as soon as that is known: it may take off while the
        camera's process still prepares the ground."""
        self._origin = position
        if self._link.systems.get(self._link.system_id or 0):
            print(
                "the vehicle is armed: the ground is drawn at its present height; "
                "if it is in the air, give --origin N,E,D",
                file=sys.stderr,
                flush=True,
            )

    def _show(self, boot_ns: int) -> None:
        assert self._origin is not None
        assert self._start_ns is not None
        pose = self._history.at(boot_ns)
        stamp_ns = self._history.monotonic_ns(boot_ns)
        if stamp_ns <= self._stamp_ns:
            return  # the clock offset has improved; a frame must not be older than the previous one
        self._stamp_ns = stamp_ns
        n, e, d = (value - zero for value, zero in zip(pose.position, self._origin, strict=True))
        time_s = (boot_ns - self._start_ns) / 1e9
        self._process.send_pose((n, e, d), pose.attitude, stamp_ns, time_s)
        if self._lines is not None and boot_ns >= self._next_truth_ns:
            self._next_truth_ns = boot_ns + round(1e9 / TRUTH_RATE_HZ)
            why = self._lines.write(json.dumps(self._truth(pose, (n, e, d), stamp_ns, time_s)))
            if why is not None:
                print(why, file=sys.stderr, flush=True)

    def _truth(self, pose: Pose, here: Vector, stamp_ns: int, time_s: float) -> dict[str, object]:
        return {
            "stamp_ns": stamp_ns,
            "position_ned_m": [round(value, 4) for value in here],
            "velocity_ned_mps": [round(value, 4) for value in pose.velocity],
            "yaw_rad": round(euler_from_quaternion(pose.attitude)[2], 5),
            "armed": self._link.systems[self._link.system_id or 0],
            "objects": [object_truth(scene_object, here) for scene_object in self._scene.objects_at(time_s)],
        }

    def _announce(self) -> None:
        assert self._origin is not None
        model = self._scene.camera.model
        print(
            f"ready: camera {self._process.name}, {model.width}x{model.height} at {self._rate_hz:g} Hz, "
            f"{'simulator truth' if self._history.truth else 'estimate'} of system {self._link.system_id}, "
            f"world origin at N,E,D {','.join(f'{value:.3f}' for value in self._origin)} m",
            flush=True,
        )
