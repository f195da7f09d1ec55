"""The options of a simulation in real time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mavlink_sim.vehicles.firmware import PX4


@dataclass(frozen=True)
class SimulationOptions:
    """What `mavlink-sim` can be told; the command line's options have the same names and defaults.

    Attributes:
        onboard_port, gcs_port: UDP ports the vehicle sends to at first.
        onboard_bind, gcs_bind: UDP ports it binds; 0 chooses free ones.
        wind_mps: steady wind; seed chooses its direction, the gusts and the world.
        gusts_mps: standard deviation of the gusts per axis; None for the usual ones, 0 for none.
        world_seed: chooses them instead, the same for all vehicles of a fleet; None: `seed`.
        camera: name of the shared-memory segment the camera's frames go to; None for no shared memory.
        camera_outputs: further addresses the frames go to (`video_outputs`).
        camera_truth: file for what is in each frame, one JSON object a line.
        scene: a scene file, or the name of an example (`scene_file.load_scene`), whose things are in the
            vehicle's way; None for the demo world, which is there to be looked at alone.
        obstacle_sensor: with a range sensor for collision prevention that looks around it; needs a scene.
        truth: file for the truth, one JSON object a line; None for none.
        record: folder for the traffic of each link, `<link>-<system id>.tlog`; None for none.
        ready_after_s: how long after boot the estimator allows arming.
        autopilot: whose profile it has, `firmware.AUTOPILOTS`.
        px4: the release of PX4 to be like, where they differ; None: the newest.
        speed: simulated seconds per real second.
        noise: whether sensors and estimates err as a real vehicle's do.
        start_ned_m: north and east of SIH's home, where it starts and its local frame begins.
        parameters: PX4 parameters that differ from the defaults.
        gimbal: with a two-axis gimbal (gimbal protocol version 2); the camera sits on it.
        signing_key: 32 bytes for MAVLink 2 signing on every link; MAV_SIGN_CFG says what is refused.
        faults: begun at the start or at their own time, in the grammar of `fault_grammar`.
        console: read faults from standard input; None: if that is a terminal.
        control: a zenoh endpoint to take faults on (`tcp/127.0.0.1:7447`); None for none.
    """

    host: str = "127.0.0.1"
    onboard_port: int = 14540
    onboard_bind: int = 14580
    gcs_port: int = 14550
    gcs_bind: int = 18570
    system_id: int = 1
    seed: int = 0
    world_seed: int | None = None
    wind_mps: float = 0.0
    gusts_mps: float | None = None
    camera: str | None = None
    camera_rate_hz: float | None = None
    camera_outputs: tuple[str, ...] = ()
    camera_truth: Path | None = None
    scene: str | None = None
    obstacle_sensor: bool = False
    truth: Path | None = None
    record: Path | None = None
    ready_after_s: float = 3.0
    autopilot: str = PX4
    px4: str | None = None
    speed: float = 1.0
    noise: bool = True
    start_ned_m: tuple[float, float] = (0.0, 0.0)
    parameters: dict[str, float] = field(default_factory=dict)
    gimbal: bool = False
    signing_key: bytes | None = field(default=None, repr=False)
    faults: tuple[str, ...] = ()
    console: bool | None = None
    control: str | None = None

    @property
    def shows_world(self) -> bool:
        """Whether there is a camera."""
        return self.camera is not None or bool(self.camera_outputs) or self.camera_truth is not None
