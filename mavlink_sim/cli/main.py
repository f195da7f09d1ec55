"""`mavlink-sim`: a PX4-like multirotor on UDP, with one readable line per event."""

from __future__ import annotations

import gc
import json
import logging
import math
import os
import select
import signal
import sys
import threading
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer
import typer.core
import typer.main

from mavlink_sim.camera.cli_options import CameraOutputs, CameraRate, CameraTruth, SceneName
from mavlink_sim.physics.contact import RADIUS_M
from mavlink_sim.px4.parameters import UnknownParameterError
from mavlink_sim.realtime.fleet import Fleet, instance_options
from mavlink_sim.realtime.options import SimulationOptions
from mavlink_sim.releases import NEWEST, RELEASES
from mavlink_sim.vehicles.firmware import AUTOPILOTS, PX4
from mavlink_sim.wire.endpoint import PortInUseError
from mavlink_sim.wire.signing import ALWAYS, key_of

# Tilted by 45 degrees, the airframe (SIH's, with its large drag) can hold against little more wind than this.
MAX_WIND_MPS = 8.0
DEFAULT_SPACING_M = 5.0
MAX_GUSTS_MPS = 4.0  # two standard deviations are that wind

# click's UsageError, through its public subclass: some versions of typer include their own click
_USAGE_ERROR: Any = typer.BadParameter.__base__

# Module with the command's `app`, imported when it runs: most need OpenCV. Help, for the list of commands.
_COMMANDS = {
    "camera": ("mavlink_sim.camera.cli", "Render the built-in world for any autopilot's vehicle."),
    "dataset": ("mavlink_sim.datasets.dataset", "Write labelled images for training."),
    "board": ("mavlink_sim.datasets.board_views", "Write images of a calibration board."),
    "bench": ("mavlink_sim.cli.bench", "Measure the speed of this machine."),
}


class _Commands(typer.core.TyperGroup):
    """`mavlink-sim` with options of its own, and the commands."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in _COMMANDS:
            return None
        return typer.main.get_command(import_module(_COMMANDS[cmd_name][0]).app)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in _COMMANDS.items()])


app = typer.Typer(cls=_Commands, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


def _fail(text: str) -> NoReturn:
    print(f"mavlink-sim: {text}", file=sys.stderr)
    raise typer.Exit(2)


def _print_line(text: str) -> None:
    print(text, flush=True)


def _parameters(assignments: list[str]) -> dict[str, float]:
    values = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not equals or not math.isfinite(value):
            _fail(f"--param {assignment!r}: expected NAME=NUMBER, for example COM_OF_LOSS_T=0.5")
        values[name.strip()] = value
    return values


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        _print_line(f"mavlink-sim {version('mavlink-companion')}")
        raise typer.Exit


def _refuse_without_camera(given: dict[str, float | None]) -> None:
    for name, value in given.items():
        if value is not None:
            _fail(
                f"--{name} {value:g}: there is no camera; add --camera NAME or --camera-output ADDRESS, "
                "or leave it out"
            )


def _refuse_options_before(context: typer.Context, command: str) -> None:
    for name in context.params:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            option = f"--{name.replace('_', '-')}"
            _fail(f"{option} is an option of mavlink-sim alone; give options of {command} after its name")


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        _fail(f"--{name} {value:g}: expected {low:g} to {high:g}")


@app.callback(invoke_without_command=True)
def simulate(
    context: typer.Context,
    onboard_port: Annotated[int, typer.Option(help="UDP port that the onboard link sends to.")] = 14540,
    onboard_bind: Annotated[
        int, typer.Option(help="UDP port that the onboard link binds; 0: a free one.")
    ] = 14580,
    gcs_port: Annotated[int, typer.Option(help="UDP port that the ground-station link sends to.")] = 14550,
    gcs_bind: Annotated[
        int, typer.Option(help="UDP port that the ground-station link binds; 0: a free one.")
    ] = 18570,
    host: Annotated[str, typer.Option(help="Address to bind and to send to.")] = "127.0.0.1",
    system_id: Annotated[int, typer.Option(help="MAVLink system id, 1 to 255.")] = 1,
    seed: Annotated[int, typer.Option(help="Seed of the wind, the gusts and the world.")] = 0,
    wind: Annotated[float, typer.Option(help="Steady wind in m/s; its direction depends on the seed.")] = 0.0,
    gusts: Annotated[
        float | None,
        typer.Option(
            help="Gusts in m/s, standard deviation per axis; 0: none; default: 0.4 and 15 % of --wind."
        ),
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="Render a camera into this shared memory; read it as shm://NAME.")
    ] = None,
    camera_rate: CameraRate = None,
    scene: SceneName = None,
    obstacle_sensor: Annotated[
        bool,
        typer.Option(
            "--obstacle-sensor", help="Add a 360-degree range sensor for collision prevention (CP_DIST)."
        ),
    ] = False,
    camera_output: CameraOutputs = None,
    camera_truth: CameraTruth = None,
    truth: Annotated[
        Path | None, typer.Option(help="Write the true state to this file, one JSON object per line, 20 Hz.")
    ] = None,
    record: Annotated[
        Path | None, typer.Option(help="Record each link's traffic into this folder, as LINK-SYSTEM.tlog.")
    ] = None,
    ready_after: Annotated[
        float, typer.Option(help="Seconds after boot until the vehicle can be armed.")
    ] = 3.0,
    autopilot: Annotated[
        str, typer.Option(help="Autopilot firmware to emulate: px4 or ardupilot (Copter).")
    ] = PX4,
    px4: Annotated[
        str | None, typer.Option(help=f"PX4 release to emulate: {', '.join(RELEASES)}; default: {NEWEST}.")
    ] = None,
    speed: Annotated[float, typer.Option(help="Simulated seconds per real second.")] = 1.0,
    noise: Annotated[
        str,
        typer.Option(
            help="Errors of sensors and estimates: on, as on a real vehicle; off; or a scale, 0 to 10."
        ),
    ] = "on",
    vehicles: Annotated[
        int, typer.Option(help="Number of vehicles; system ids and ports count up from those given.")
    ] = 1,
    spacing: Annotated[
        float | None, typer.Option(help="Metres between the vehicles of a fleet, on a grid; default: 5.")
    ] = None,
    camera_vehicle: Annotated[
        int | None, typer.Option(help="Vehicle of the fleet that has the camera; default: the first.")
    ] = None,
    cameras: Annotated[
        int | None,
        typer.Option(help="Number of vehicles with a camera, from that one on; the second's is NAME-2."),
    ] = None,
    param: Annotated[
        list[str] | None, typer.Option(help="Set a parameter of the autopilot, NAME=VALUE; repeatable.")
    ] = None,
    gimbal: Annotated[bool, typer.Option("--gimbal", help="Add a two-axis gimbal.")] = False,
    signing_key: Annotated[
        str | None,
        typer.Option(
            help="Sign and require signatures; the key is 64 hexadecimal digits, or a file with the 32 bytes."
        ),
    ] = None,
    fault: Annotated[
        list[str] | None, typer.Option(help="Inject a fault, e.g. 'link_delay 0.2 at=20 for=5'; repeatable.")
    ] = None,
    console: Annotated[
        bool | None, typer.Option(help="Read faults from standard input; by default if that is a terminal.")
    ] = None,
    control: Annotated[
        str | None, typer.Option(help="Accept faults over zenoh too, at this endpoint: tcp/127.0.0.1:7447.")
    ] = None,
    parent_pid: Annotated[
        int | None, typer.Option(help="End when the process with this id ends (Linux).")
    ] = None,
    ready_file: Annotated[
        Path | None, typer.Option(help="File for pid and ports as JSON, written once the vehicle runs.")
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", help="Also log the links.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Fly a PX4-like multirotor on UDP until interrupted (Ctrl-C)."""
    if context.invoked_subcommand is not None:
        _refuse_options_before(context, context.invoked_subcommand)
        return
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING, format="%(levelname)s %(name)s: %(message)s"
    )
    for name, port in (
        ("onboard-port", onboard_port),
        ("onboard-bind", onboard_bind),
        ("gcs-port", gcs_port),
        ("gcs-bind", gcs_bind),
    ):
        _check(name, port, 0 if name.endswith("bind") else 1, 65535)
    _check("system-id", system_id, 1, 255)
    _check("wind", wind, 0.0, MAX_WIND_MPS)
    if gusts is not None:
        _check("gusts", gusts, 0.0, MAX_GUSTS_MPS)
    if camera_rate is not None:
        _check("camera-rate", camera_rate, 1.0, 120.0)
    if "pipe:-" in (camera_output or []):
        sys.stdout = sys.stderr  # standard output carries only the images
    _check("ready-after", ready_after, 0.0, 600.0)
    _check("speed", speed, 0.05, 20.0)
    if spacing is not None:
        _check("spacing", spacing, 2.0 * RADIUS_M, 1000.0)  # closer than that they would overlap at the start
    try:
        noise_scale = float({"on": "1", "off": "0"}.get(noise, noise))
    except ValueError:
        _fail(f"--noise {noise!r}: expected on, off or a scale")
    _check("noise", noise_scale, 0.0, 10.0)
    parameters = _parameters(param or [])
    try:
        key = None if signing_key is None else key_of(signing_key)
    except ValueError as error:
        _fail(f"--signing-key: {error}")
    if autopilot not in AUTOPILOTS:
        _fail(f"--autopilot {autopilot!r}: expected {' or '.join(AUTOPILOTS)}")
    if key is not None and autopilot == PX4:
        parameters.setdefault("MAV_SIGN_CFG", ALWAYS)
    options = SimulationOptions(
        host=host,
        onboard_port=onboard_port,
        onboard_bind=onboard_bind,
        gcs_port=gcs_port,
        gcs_bind=gcs_bind,
        system_id=system_id,
        seed=seed,
        wind_mps=wind,
        gusts_mps=gusts,
        camera=camera,
        camera_rate_hz=camera_rate,
        camera_outputs=tuple(camera_output or ()),
        camera_truth=camera_truth,
        scene=scene,
        obstacle_sensor=obstacle_sensor,
        truth=truth,
        record=record,
        ready_after_s=ready_after,
        autopilot=autopilot,
        px4=px4,
        speed=speed,
        noise=noise_scale,
        parameters=parameters,
        gimbal=gimbal,
        signing_key=key,
        faults=tuple(fault or ()),
        console=console,
        control=control,
    )
    if not options.shows_world:
        _refuse_without_camera(
            {"camera-rate": camera_rate, "camera-vehicle": camera_vehicle, "cameras": cameras}
        )
    if obstacle_sensor and scene is None:
        _fail("--obstacle-sensor: there is nothing to measure; add --scene FILE, or leave it out")
    if spacing is not None and vehicles == 1:
        _fail(f"--spacing {spacing:g}: there is one vehicle; add --vehicles N, or leave it out")
    try:
        members = instance_options(
            options,
            vehicles,
            DEFAULT_SPACING_M if spacing is None else spacing,
            1 if camera_vehicle is None else camera_vehicle,
            1 if cameras is None else cameras,
        )
        fleet = Fleet(members, on_event=_print_line)
    except PortInUseError as error:
        _fail(str(error))
    except UnknownParameterError as error:
        _fail(str(error.args[0]))
    except (OSError, ValueError) as error:
        _fail(str(error))
    with fleet:
        _run(fleet, ready_file, parent_pid)


def _stop_after(parent: int) -> None:
    """Send SIGTERM to this process when another one has ended. Runs in a thread."""
    try:
        descriptor = os.pidfd_open(parent)
    except ProcessLookupError:  # it has ended already
        pass
    else:
        waiting = select.poll()
        waiting.register(descriptor, select.POLLIN)
        waiting.poll()
    os.kill(os.getpid(), signal.SIGTERM)


def _run(fleet: Fleet, ready_file: Path | None, parent_pid: int | None) -> None:
    def stop(number: int, frame: FrameType | None) -> None:
        fleet.stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    if parent_pid is not None:
        threading.Thread(target=_stop_after, args=(parent_pid,), daemon=True).start()
    reports = [
        {
            "system_id": one.options.system_id,
            **{f"{name}_bind": end.port for name, end in one.endpoints.items()},
        }
        for one in fleet
    ]
    if ready_file is not None:
        report: dict[str, Any] = {
            "pid": os.getpid(),
            **{name: reports[0][name] for name in ("onboard_bind", "gcs_bind")},
        }
        if len(reports) > 1:
            report["vehicles"] = reports
        partial = ready_file.with_name(ready_file.name + ".partial")
        try:
            partial.write_text(json.dumps(report) + "\n", encoding="utf-8")
            partial.replace(ready_file)  # a reader never sees a partial file
        except OSError as error:
            _fail(f"--ready-file: {error}")
    for one, bound in zip(fleet, reports, strict=True):
        options = one.options
        _print_line(
            f"ready: system {options.system_id}, "
            f"onboard {options.host}:{bound['onboard_bind']} -> {options.onboard_port}, "
            f"ground station {options.host}:{bound['gcs_bind']} -> {options.gcs_port}"
        )
    if len(reports) > 1:
        _print_line(f"ready: {len(reports)} vehicles")
    # These objects are permanent: a collection of them would delay every vehicle by some steps.
    gc.collect()
    gc.freeze()
    fleet.run()
    _print_line("stopped")


def main() -> None:
    """The entry point; a usage error is one line on standard error, with exit code 2."""
    try:
        code = app(prog_name="mavlink-sim", standalone_mode=False)
    except _USAGE_ERROR as error:
        print(f"mavlink-sim: {error.format_message()}", file=sys.stderr)
        code = 2
    sys.exit(code or 0)
