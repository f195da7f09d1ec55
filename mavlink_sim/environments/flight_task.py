"""What the tasks in flight share: the model, random conditions, and a sensor: a camera that sees one object.

The object's position is measured at 20 Hz with the errors of a detector, arrives late, and is missing in some
frames and outside the image. Between measurements the last known position is kept and its age grows. Tasks
with another sensor override `measure` and `visible`.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.environments import drawing
from mavlink_sim.environments.autopilot_model import AutopilotModel
from mavlink_sim.environments.fast_model import FastModel
from mavlink_sim.environments.spaces import MAX_AGE_S, VELOCITY_ACTION, Array, high
from mavlink_sim.environments.task import STEP_S, Task
from mavlink_sim.vehicles.vehicle import BACKGROUND_GUSTS_MPS, GUST_SHARE_OF_WIND

MODELS: dict[str, type[FastModel | AutopilotModel]] = {"fast": FastModel, "autopilot": AutopilotModel}
# The companion limits changes of a demanded velocity to this (its default).
MAX_ACCELERATION_M_S2 = 3.0
# The companion's default camera.
TAN_ACROSS = math.tan(math.radians(80.0) / 2.0)
TAN_ALONG = 0.75 * TAN_ACROSS
BEARING_NOISE_RAD = 0.01
_DELAYS = 16

Range = tuple[float, float]


# Each episode draws its conditions uniformly from a range; equal ends fix one. Default range, limits:
CONDITIONS: dict[str, tuple[Range, Range]] = {
    "wind_m_s": ((0.0, 3.0), (0.0, 15.0)),  # steady, from any direction; gusts grow with it
    "latency_s": ((0.05, 0.2), (0.0, (_DELAYS - 1) * STEP_S)),  # from a frame to its measurement, whole steps
    "noise": ((0.0, 0.05), (0.0, 1.0)),  # standard deviation of a measured distance, as a fraction of it
    "mass": ((0.9, 1.2), (0.5, 1.5)),  # relative to the airframe's 1 kg
    "misses": ((0.0, 0.3), (0.0, 1.0)),  # fraction of frames without a measurement
}


def _range(name: str, value: Any) -> Range:
    """Raises: ValueError: not two ends in order within the limits."""
    if name not in CONDITIONS:
        raise ValueError(f"{name}: expected one of model, {', '.join(CONDITIONS)}")
    least, most = CONDITIONS[name][1]
    try:
        first, last = (float(number) for number in value)
    except (TypeError, ValueError):
        first, last = math.nan, math.nan
    if not least <= first <= last <= most:
        raise ValueError(f"{name}: expected (low, high) within {least:g} to {most:g}, got {value!r}")
    return first, last


class FlightTask(Task):
    """A vehicle that flies velocities and sees one object.

    Args:
        count: episodes side by side.
        model: "fast", the arrays of `FastModel`, or "autopilot", a whole simulated vehicle for each.
        conditions: ranges of `CONDITIONS`, by name.

    Attributes:
        rows: numbers in a measurement. defaults: default ranges that differ from `CONDITIONS`.
        height_m: range of heights at the start. lowest_m: below it an episode ends.
        target: (3, count) NED, the true position of the object. seen: (rows, count) the newest measurement.
        age_s: (count,) its age. change: (count,) the squared change of the action, each entry by its range.
    """

    action = VELOCITY_ACTION
    max_steps = 600
    rows = 3
    defaults: ClassVar[dict[str, Range]] = {}
    height_m: Range = (1.5, 3.5)
    lowest_m = 0.5
    camera_pitch_rad = math.radians(-10.0)

    def __init__(self, count: int, model: str = "fast", **conditions: Any) -> None:
        super().__init__(count)
        if model not in MODELS:
            raise ValueError(f"model {model!r}: expected one of {', '.join(MODELS)}")
        usual = {name: default for name, (default, _) in CONDITIONS.items()}
        asked = {name: _range(name, value) for name, value in conditions.items()}
        self.conditions = usual | self.defaults | asked
        self.model = MODELS[model](count)
        self.target, self._setpoint = np.zeros((3, count)), np.zeros((3, count))
        self.seen = np.zeros((self.rows, count))
        self.age_s, self.noise, self._misses = (np.zeros(count) for _ in range(3))
        self._delay = np.zeros(count, np.intp)
        self._index = 0
        self._measured = np.zeros((_DELAYS, self.rows, count))
        self._valid = np.zeros((_DELAYS, count), bool)
        self._columns = np.arange(count)
        self._full = high(self.action)[:, None]
        self._last_action = np.zeros((len(self.action), count))
        self.change = np.zeros(count)

    @abstractmethod
    def place(self, which: NDArray[np.intp], yaw_rad: Array, rng: np.random.Generator) -> None:
        """Set `target` for new episodes whose vehicles are in position."""

    @abstractmethod
    def judge(self) -> tuple[Array, NDArray[np.bool_]]:
        """(count,) rewards of the last step, and whether each episode has ended."""

    def begin(self, which: NDArray[np.intp], rng: np.random.Generator) -> None:
        size = len(which)
        drawn = {name: rng.uniform(*ends, size) for name, ends in self.conditions.items()}
        model = self.model
        wind, direction = drawn["wind_m_s"], rng.uniform(0.0, math.tau, size)
        model.wind[:, which] = np.stack([wind * np.cos(direction), wind * np.sin(direction), np.zeros(size)])
        model.gusts_m_s[which] = BACKGROUND_GUSTS_MPS + GUST_SHARE_OF_WIND * wind
        model.mass[which] = drawn["mass"]
        self.noise[which], self._misses[which] = drawn["noise"], drawn["misses"]
        self._delay[which] = np.rint(drawn["latency_s"] / STEP_S)
        yaw_rad = rng.uniform(-math.pi, math.pi, size)
        position = np.zeros((3, size))
        position[2] = -rng.uniform(*self.height_m, size)
        model.begin(which, position, yaw_rad, rng)
        self.place(which, yaw_rad, rng)
        self._setpoint[:, which] = 0.0
        self._last_action[:, which] = 0.0
        self._valid[:, which] = False
        self.age_s[which] = self._delay[which] * STEP_S
        self.seen[:, which] = self.measure(rng)[:, which]

    def step(self, action: Array, rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
        self.fly(action, rng)
        self._see(rng)
        self.change = (((action - self._last_action) / self._full) ** 2).sum(0)
        self._last_action = action.copy()
        reward, ended = self.judge()
        return reward, ended | self.model.failed

    def fly(self, action: Array, rng: np.random.Generator) -> None:
        """Move the vehicles for STEP_S."""
        model = self.model
        forward, right, up, turn = action
        cosine, sine = np.cos(model.yaw_rad), np.sin(model.yaw_rad)
        wanted = np.stack([forward * cosine - right * sine, forward * sine + right * cosine, -up])
        change = wanted - self._setpoint
        length = np.sqrt((change * change).sum(0))
        self._setpoint += change * np.minimum(1.0, MAX_ACCELERATION_M_S2 * STEP_S / np.maximum(length, 1e-9))
        model.fly(self._setpoint, turn, rng)

    def _see(self, rng: np.random.Generator) -> None:
        """Take a frame, and receive the measurement of an earlier one."""
        self._index = (self._index + 1) % _DELAYS
        self._measured[self._index] = self.measure(rng)
        self._valid[self._index] = self.visible() & (rng.random(self.count) >= self._misses)
        slot = (self._index - self._delay) % _DELAYS
        arrived = self._valid[slot, self._columns]
        newest = self._measured[slot, :, self._columns].T
        self.seen = np.where(arrived, newest, self.seen)
        self.age_s = np.where(arrived, self._delay * STEP_S, self.age_s + STEP_S)

    def measure(self, rng: np.random.Generator) -> Array:
        """(3, count) NED, the object's position as measured now."""
        line = self.target - self.model.position
        distance = np.sqrt((line * line).sum(0))
        along, *across = rng.standard_normal((4, self.count))
        error = line * (self.noise * along) + np.stack(across) * (distance * BEARING_NOISE_RAD)
        measured: Array = self.model.estimated_position + line + error
        return measured

    def visible(self) -> NDArray[np.bool_]:
        """(count,) whether the object is in the image of the camera, which tilts with the vehicle."""
        x, y, z = (self.model.rotation * (self.target - self.model.position)[:, None]).sum(0)
        cosine, sine = math.cos(self.camera_pitch_rad), math.sin(self.camera_pitch_rad)
        depth, down = x * cosine - z * sine, x * sine + z * cosine
        inside = (np.abs(y) < depth * TAN_ACROSS) & (np.abs(down) < depth * TAN_ALONG) & (depth > 0.1)
        return np.asarray(inside, np.bool_)

    def level(self, ned: Array) -> Array:
        """(3, count) a NED vector in the BODY LEVEL frame by the vehicle's own heading."""
        cosine, sine = np.cos(self.model.yaw_rad), np.sin(self.model.yaw_rad)
        return np.stack([cosine * ned[0] + sine * ned[1], cosine * ned[1] - sine * ned[0], -ned[2]])

    def sight(self) -> list[Array]:
        """The rows of what is seen: the object's position, the velocity, the age."""
        return [
            *self.level(self.seen - self.model.estimated_position),
            *self.level(self.model.estimated_velocity),
            self.age_s,
        ]

    @property
    def distance_m(self) -> Array:
        """(count,) true distance to the object."""
        return np.asarray(np.linalg.norm(self.target - self.model.position, axis=0))

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(count,) the newest measurement is too old, or the vehicle too low."""
        return np.asarray((self.age_s > MAX_AGE_S) | (self.model.position[2] > -self.lowest_m), np.bool_)

    def sketch(self, canvas: drawing.Canvas) -> None:
        """Draw what is around the first vehicle."""
        canvas.circle(self.target[:, 0], 0.4, drawing.TARGET, -1)
        canvas.circle(self.seen[:, 0], 0.4, drawing.SEEN)

    def draw(self) -> NDArray[np.uint8]:
        place, target = self.model.position[:, 0], self.target[:, 0]
        canvas = drawing.Canvas(2.4 * max(8.0, *np.abs(target - place)), place)
        self.sketch(canvas)
        nose, right, _ = self.model.rotation[:, :, 0].T
        canvas.line(place - right, place + right, drawing.VEHICLE)
        canvas.line(place, place + 1.5 * nose, drawing.VEHICLE)
        canvas.circle(place, 0.3, drawing.VEHICLE, -1)
        return canvas.image
