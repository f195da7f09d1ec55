"""Scene files: TOML in, a checked `Scene` out. `docs/scenes.md` describes every key.

Angles in the file are degrees, clockwise from north; positions are [north, east, down] in metres, where
`down` is negative above the ground and may be left out.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable
from importlib import resources
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.image_effects import ImageEffects
from mavlink_sim.camera.lens import Lens, Shutter
from mavlink_sim.camera.scene import CameraSettings, Path, Scene
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.textures import KINDS
from mavlink_sim.world.world import (
    OBJECT_NAMES,
    Ground,
    Light,
    Patch,
    Sky,
    Vector,
    World,
    WorldObject,
    demo_world,
)
from vision.camera_model import CameraModel, CameraMount, DistortionModel, check_distortion
from vision.class_names import class_named
from vision.file_kinds import explained
from vision.marker_dictionaries import dictionary_named
from vision.text_file import read_text


class SceneError(ValueError):
    """A scene file cannot be used; the text names the file and, one per line, its problems."""


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def _one_of(names: Iterable[str]) -> AfterValidator:
    known = tuple(names)

    def check(name: str) -> str:
        try:
            return class_named(name, known)
        except ValueError as error:
            raise ValueError(f"must be one of {', '.join(known)} ({error})") from None

    return AfterValidator(check)


Kind = Annotated[str, _one_of(KINDS)]
ClassName = Annotated[str, _one_of(name for name in OBJECT_NAMES if name != "plate")]
Number = Annotated[float, Field(strict=False)]
Coordinates = Annotated[
    list[Annotated[Number, Field(ge=-10_000, le=10_000)]], Field(min_length=2, max_length=3)
]
Share = Annotated[Number, Field(ge=0, le=1)]
Degrees = Annotated[Number, Field(ge=-360, le=360)]
Positive = Annotated[Number, Field(gt=0, le=100_000)]
Colour = Annotated[list[Annotated[Number, Field(ge=0, le=255)]], Field(min_length=3, max_length=3)]
Gain = Annotated[list[Annotated[Number, Field(gt=0, le=4)]], Field(min_length=3, max_length=3)]
Size = Annotated[list[Annotated[Number, Field(ge=0.001, le=500)]], Field(min_length=3, max_length=3)]
Seed = Annotated[int, Field(ge=0, le=2**31 - 1)]


class _Patch(_Table):
    kind: Kind
    place_m: Coordinates
    radius_m: Positive


class _Ground(_Table):
    kinds: Annotated[list[Kind], Field(min_length=1, max_length=4)] = ["grass"]
    seed: Seed = 0
    tile_texels: Literal[256, 512, 1024, 2048] = 1024
    texel_m: Annotated[Number, Field(ge=0.01, le=1)] = 0.1
    patches: list[_Patch] = []
    road_east_m: Number | None = None
    pad: bool = False
    gain: Gain = [1.0, 1.0, 1.0]


class _Light(_Table):
    sun_azimuth_deg: Degrees = 225.0
    sun_elevation_deg: Annotated[Number, Field(ge=5, le=90)] = 48.0
    sun: Annotated[Number, Field(ge=0, le=2)] = 0.68
    ambient: Annotated[Number, Field(ge=0, le=2)] = 0.5
    tint: Gain = [0.94, 1.0, 1.04]
    shadow: Share = 0.45


class _Sky(_Table):
    visibility_m: Annotated[Number, Field(ge=10, le=100_000)] = 900.0
    horizon: Colour = [226.0, 216.0, 202.0]
    zenith: Colour = [196.0, 138.0, 74.0]
    clouds: Share = 0.45
    seed: Seed = 0


class _Path(_Table):
    waypoints_m: Annotated[list[Coordinates], Field(min_length=2)]
    speed_mps: Annotated[Number, Field(gt=0, le=100)]
    repeat: Literal["loop", "back_and_forth", "once"] = "loop"
    start_s: Annotated[Number, Field(ge=0, le=1e6)] = 0.0
    yaw_deg: Degrees | None = None


class _Object(_Table):
    class_name: Annotated[ClassName, Field(alias="class")]
    place_m: Coordinates | None = None
    yaw_deg: Degrees = 0.0
    scale: Annotated[Number, Field(gt=0.05, le=20)] = 1.0
    appearance: Seed = 0
    size_m: Size | None = None
    path: _Path | None = None


class _Plate(_Table):
    dictionary: Annotated[str, AfterValidator(dictionary_named)] = "4X4_50"
    id: Annotated[int, Field(ge=0)]
    size_m: Annotated[Number, Field(ge=0.01, le=50)]
    place_m: Coordinates | None = None
    yaw_deg: Degrees = 0.0
    standing: bool = False
    path: _Path | None = None


class _Mount(_Table):
    forward_m: Number = 0.12
    right_m: Number = 0.0
    down_m: Number = 0.0
    roll_deg: Degrees = 0.0
    pitch_deg: Degrees = -20.0
    yaw_deg: Degrees = 0.0


class _Effects(_Table):
    blur_px: Annotated[Number, Field(ge=0, le=20)] = 0.0
    gain: Annotated[Number, Field(gt=0, le=8)] = 1.0
    white_balance: Gain = [1.0, 1.0, 1.0]
    contrast: Annotated[Number, Field(gt=0, le=4)] = 1.0
    gamma: Annotated[Number, Field(gt=0, le=4)] = 1.0
    grey: Share = 0.0
    noise: Annotated[Number, Field(ge=0, le=100)] = 2.0


_USUAL_DEPTH = DepthSensor()


class _Depth(_Table):
    baseline_m: Annotated[Number, Field(ge=0, le=2)] = _USUAL_DEPTH.baseline_m
    step_px: Annotated[Number, Field(ge=0, le=4)] = _USUAL_DEPTH.step_px
    noise_px: Annotated[Number, Field(ge=0, le=10)] = _USUAL_DEPTH.noise_px
    minimum_m: Annotated[Number, Field(ge=0, le=1000)] = _USUAL_DEPTH.minimum_m
    maximum_m: Annotated[Number, Field(gt=0, le=10_000)] = _USUAL_DEPTH.maximum_m
    dropout: Annotated[Number, Field(ge=0, lt=1)] = _USUAL_DEPTH.dropout


class _Camera(_Table):
    width: Annotated[int, Field(ge=16, le=4096)] = 640
    height: Annotated[int, Field(ge=16, le=4096)] = 480
    horizontal_fov_deg: Annotated[Number, Field(gt=1, lt=170)] | None = None
    focal_px: Annotated[list[Positive], Field(min_length=2, max_length=2)] | None = None
    centre_px: Annotated[list[Number], Field(min_length=2, max_length=2)] | None = None
    distortion: Annotated[list[Number], Field(max_length=8)] = []
    distortion_model: DistortionModel = "plumb_bob"
    rate_hz: Annotated[Number, Field(gt=0, le=1000)] = 30.0
    exposure_ms: Annotated[Number, Field(ge=0, le=500)] = 0.0
    rolling_shutter_ms: Annotated[Number, Field(ge=0, le=500)] = 0.0
    loss: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    latency_ms: Annotated[Number, Field(ge=0, le=5000)] = 0.0
    seed: Seed = 0
    mount: _Mount = _Mount()
    effects: _Effects = _Effects()
    depth: _Depth | None = None


class _File(_Table):
    name: Annotated[str, Field(min_length=1, max_length=100)] | None = None
    ground: _Ground = _Ground()
    light: _Light = _Light()
    sky: _Sky = _Sky()
    objects: list[_Object] = []
    plates: list[_Plate] = []
    camera: _Camera = _Camera()


def example_scenes() -> tuple[str, ...]:
    """Names of the scenes in the package; `load_scene` accepts them instead of a file."""
    folder = resources.files("mavlink_sim") / "scenes"
    return tuple(
        sorted(item.name.removesuffix(".toml") for item in folder.iterdir() if item.name.endswith(".toml"))
    )


def load_scene(file: str | FilePath) -> Scene:
    """The scene of a file, or one of `example_scenes` by its name.

    Raises:
        SceneError: there is no such file, it is not TOML, or it has invalid values; every problem is named.

    >>> from mavlink_sim import load_scene
    >>> load_scene("obstacle_course").name
    'obstacle course'
    """
    path = FilePath(file)
    if str(file) in example_scenes():
        text = (resources.files("mavlink_sim") / "scenes" / f"{file}.toml").read_text("utf-8")
        return parse_scene(text, str(file))
    try:
        text = read_text(path)
    except UnicodeDecodeError as error:
        raise SceneError(explained(path, f"{path}: {error}")) from error
    except OSError as error:
        known = ", ".join(example_scenes())
        raise SceneError(
            f"cannot read the scene file {path}: {error.strerror}; scenes in the package: {known}"
        ) from error
    try:
        return parse_scene(text, str(path))
    except SceneError as error:
        raise SceneError(explained(path, str(error))) from error


def scene_or_demo(file: str | FilePath | None, seed: int) -> Scene:
    """The scene of a file or an example's name; without one, the demo world of a seed. Raises SceneError."""
    return Scene(demo_world(seed), name="demo") if file is None else load_scene(file)


def parse_scene(text: str, origin: str = "scene") -> Scene:
    """The scene of a text; `origin` names it in messages. Raises SceneError."""
    try:
        content = tomllib.loads(text)
    except RecursionError:
        raise SceneError(f"{origin}: nested too deeply") from None
    except ValueError as error:  # not TOML, or an integer of too many digits
        raise SceneError(f"{origin}: {str(error).partition(';')[0]}") from error
    try:
        file = _File.model_validate(content)
    except ValidationError as error:
        problems = dict.fromkeys(_explained(details) for details in error.errors())
        raise SceneError("\n".join(f"{origin}: {problem}" for problem in problems)) from None
    return _Builder(origin).scene(file)


class _Builder:
    """Builds the values of a checked file, and adds the key to their errors."""

    def __init__(self, origin: str) -> None:
        self._origin = origin
        self._paths: dict[int, Path] = {}
        self._objects: list[WorldObject] = []

    def scene(self, file: _File) -> Scene:
        for index, item in enumerate(file.objects):
            self._add(f"objects[{index}]", item, None)
        for index, plate in enumerate(file.plates):
            self._add(f"plates[{index}]", plate, self._print(f"plates[{index}]", plate))
        world = World(tuple(self._objects), _ground(file.ground), _light(file.light), _sky(file.sky))
        return Scene(world, self._paths, self._camera(file.camera), file.name or FilePath(self._origin).stem)

    def _fail(self, key: str, error: object) -> SceneError:
        return SceneError(f"{self._origin}: {key}: {error}")

    def _print(self, key: str, plate: _Plate) -> Print:
        try:
            return Print(plate.dictionary, plate.id, plate.size_m, plate.standing)
        except ValueError as error:
            raise self._fail(key, error) from error

    def _add(self, key: str, item: _Object | _Plate, printed: Print | None) -> None:
        identifier = len(self._objects)
        if (item.place_m is None) == (item.path is None):
            got = "both" if item.path is not None else "neither"
            raise self._fail(key, f"must have either place_m = [north, east] or a path, got {got}")
        position: Vector = (0.0, 0.0, 0.0) if item.place_m is None else _position(item.place_m)
        yaw = math.radians(item.yaw_deg)
        try:
            if item.path is not None:
                path = Path(
                    tuple(_position(waypoint) for waypoint in item.path.waypoints_m),
                    item.path.speed_mps,
                    item.path.repeat,
                    item.path.start_s,
                    None if item.path.yaw_deg is None else math.radians(item.path.yaw_deg),
                )
                self._paths[identifier] = path
                position, yaw = path.pose_at(0.0)
            if isinstance(item, _Plate):
                scene_object = WorldObject(identifier, "plate", position, yaw, printed=printed)
            else:
                size = None if item.size_m is None else (item.size_m[0], item.size_m[1], item.size_m[2])
                scene_object = WorldObject(
                    identifier, item.class_name, position, yaw, item.scale, item.appearance, size
                )
        except ValueError as error:
            raise self._fail(key, error) from error
        self._objects.append(scene_object)

    def _camera(self, table: _Camera) -> CameraSettings:
        if table.horizontal_fov_deg is not None and table.focal_px is not None:
            raise self._fail("camera", "must have horizontal_fov_deg or focal_px, got both")
        if table.centre_px is not None and table.focal_px is None:
            raise self._fail("camera.centre_px", "needs camera.focal_px beside it")
        try:
            check_distortion(table.distortion_model, tuple(table.distortion))
        except ValueError as error:
            raise self._fail("camera", error) from error
        shutter = None
        if table.exposure_ms > 0.0 or table.rolling_shutter_ms > 0.0:
            shutter = Shutter(table.exposure_ms / 1e3, table.rolling_shutter_ms / 1e3)
        model = _camera_model(table)
        if not model.rectilinear:
            try:
                Lens(model, shutter)
            except ValueError as error:
                raise self._fail("camera.distortion", error) from error
        depth = table.depth
        if depth is not None and not depth.minimum_m < depth.maximum_m:
            raise self._fail(
                "camera.depth", f"minimum_m {depth.minimum_m} must be below maximum_m {depth.maximum_m}"
            )
        mount, effects = table.mount, table.effects
        return CameraSettings(
            model,
            CameraMount(
                mount.forward_m,
                mount.right_m,
                mount.down_m,
                math.radians(mount.roll_deg),
                math.radians(mount.pitch_deg),
                math.radians(mount.yaw_deg),
            ),
            table.rate_hz,
            shutter,
            ImageEffects(
                blur_sigma_px=effects.blur_px,
                exposure=effects.gain,
                white_balance=_triple(effects.white_balance),
                contrast=effects.contrast,
                gamma=effects.gamma,
                grey=effects.grey,
                noise_sigma=effects.noise,
            ),
            None if depth is None else DepthSensor(**depth.model_dump()),
            loss=table.loss,
            latency_s=table.latency_ms / 1e3,
            seed=table.seed,
        )


def _camera_model(table: _Camera) -> CameraModel:
    if table.focal_px is None:
        fov = math.radians(table.horizontal_fov_deg if table.horizontal_fov_deg is not None else 70.0)
        plain = CameraModel.from_horizontal_fov(table.width, table.height, fov)
        focal, centre = [plain.fx, plain.fy], [plain.cx, plain.cy]
    else:
        focal = table.focal_px
        centre = table.centre_px or [(table.width - 1) / 2, (table.height - 1) / 2]
    return CameraModel(
        table.width,
        table.height,
        *(focal[0], focal[1], centre[0], centre[1]),
        tuple(table.distortion),
        table.distortion_model,
    )


def _ground(table: _Ground) -> Ground:
    patches = tuple(
        Patch(patch.kind, patch.place_m[0], patch.place_m[1], patch.radius_m) for patch in table.patches
    )
    return Ground(
        tuple(table.kinds),
        table.seed,
        table.tile_texels,
        table.texel_m,
        patches=patches,
        road_east_m=table.road_east_m,
        pad=table.pad,
        gain=_triple(table.gain),
    )


def _light(table: _Light) -> Light:
    return Light(
        math.radians(table.sun_azimuth_deg),
        math.radians(table.sun_elevation_deg),
        table.sun,
        table.ambient,
        _triple(table.tint),
        table.shadow,
    )


def _sky(table: _Sky) -> Sky:
    return Sky(table.visibility_m, _triple(table.horizon), _triple(table.zenith), table.clouds, table.seed)


def _triple(values: list[float]) -> Vector:
    return (float(values[0]), float(values[1]), float(values[2]))


def _position(values: list[float]) -> Vector:
    return (float(values[0]), float(values[1]), float(values[2]) if len(values) == 3 else 0.0)


def _explained(details: ErrorDetails) -> str:
    """The text of one problem: the key, what was expected, what was found."""
    key = ""
    for part in details["loc"]:
        key += f"[{part}]" if isinstance(part, int) else f".{part}" if key else str(part)
    if details["type"] == "extra_forbidden":
        known = _keys_at(details["loc"][:-1])
        near = difflib.get_close_matches(str(details["loc"][-1]), known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
        return f"unknown key {key}; {hint}"
    if details["type"] == "missing":
        return f"{key}: is missing"
    got = repr(details["input"])
    got = got if len(got) <= 80 else got[:77] + "…"
    message = details["msg"].removeprefix("Value error, ")
    message = message[:1].lower() + message[1:]
    return f"{key}: {message.replace('input should', 'must')}, got {got}"


def _keys_at(location: tuple[int | str, ...]) -> list[str]:
    """The allowed keys of a table of the file."""
    table: Any = _File
    for part in location:
        if isinstance(part, str):
            field = next(field for name, field in table.model_fields.items() if part in (name, field.alias))
            table = _table_in(field.annotation)
    return [field.alias or name for name, field in table.model_fields.items()]


def _table_in(annotation: Any) -> Any:
    """The table class within an annotation such as `list[_Object]` or `_Path | None`."""
    if isinstance(annotation, type) and issubclass(annotation, _Table):
        return annotation
    for inside in getattr(annotation, "__args__", ()):
        found = _table_in(inside)
        if found is not None:
            return found
    return None
