"""Looks for cameras that deliver images: of Video4Linux, on a CSI connector, depth cameras.

Each is opened for a moment, one after the other: cameras of one USB bus share its bandwidth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from companion.doctor.camera_device import is_free
from companion.doctor.examine import camera_trial, in_parallel
from companion.doctor.facts import CameraTrial, Facts
from companion.doctor.processes import holding_file
from companion.doctor.serial_line import permission_problem
from companion.settings.perception import SourceSection
from companion.setup.tried import Report, Tried
from vision.redaction import redacted
from vision.sources.csi import csi_cameras
from vision.sources.depth_cameras import depth_camera_addresses
from vision.sources.v4l2 import VideoDevice, video_devices

MOST_S = 10.0
"""Of one camera. It is open for 1.2 s after its first frame."""
# Nodes of a CSI camera: raw images of its sensor, which only the board's program makes into images.
_CSI_DRIVERS = ("unicam", "rp1-cfe", "tegra-video", "bcm2835-isp")
_REALSENSE = "RealSense"

Trial = Callable[[SourceSection], CameraTrial]


@dataclass(frozen=True, slots=True)
class Candidate:
    """What may be a camera.

    Attributes:
        uri: as `source.uri`. name: the maker's. device: its node; None: it has no single one.
        formats: its pixel formats, for people.
    """

    uri: str
    name: str
    device: Path | None = None
    formats: str = ""


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera that has delivered frames."""

    candidate: Candidate
    trial: CameraTrial

    @property
    def uri(self) -> str:
        """As `source.uri`."""
        return self.candidate.uri

    @property
    def rate_hz(self) -> float:
        """The measured rate, Hz."""
        return self.trial.frames / self.trial.seconds if self.trial.seconds else 0.0

    def __str__(self) -> str:
        formats = f", {self.candidate.formats}" if self.candidate.formats else ""
        size = f"{self.trial.width}x{self.trial.height}"
        return f"{self.candidate.name}: {size}, {self.rate_hz:.1f} frames/s{formats}"


def camera_candidates(facts: Facts) -> tuple[list[Candidate], list[Tried]]:
    """Return what may be a camera of this computer, and the nodes that are none."""
    return candidates_of(video_devices(facts.machine.dev), depth_camera_addresses())


def candidates_of(
    devices: Iterable[VideoDevice], depth_cameras: Iterable[str]
) -> tuple[list[Candidate], list[Tried]]:
    """Return what may be a camera, depth cameras and CSI cameras first, and the nodes that are none."""
    devices = tuple(devices)
    csi = csi_cameras(devices)
    depth = list(depth_cameras)
    found = [Candidate(uri, "depth camera") for uri in depth]
    found += [Candidate(f"csi://{each.number}", each.sensor) for each in csi]
    others: list[Tried] = []
    single = sum(each.kind == "camera" for each in devices) == 1
    for each in devices:
        if each.error:
            others.append(Tried(str(each.path), each.error))
        elif each.kind == "camera" and not (
            (csi and each.driver in _CSI_DRIVERS)
            or (_REALSENSE in each.card and any(uri.startswith("realsense") for uri in depth))
        ):
            # The only one is there under its number too. Of several, the numbers may be exchanged.
            path = each.path if single or each.stable_path is None else each.stable_path
            formats = ", ".join(dict.fromkeys(one.fourcc.strip() for one in each.formats))
            found.append(Candidate(str(path), each.card or path.name, each.path, formats))
    return found, others


def find_cameras(
    candidates: Iterable[Candidate], facts: Facts, report: Report, *, trial: Trial = camera_trial
) -> list[Camera]:
    """Open each candidate for a moment; those of other programs are left alone.

    Returns:
        Those that deliver frames, in the order given.
    """
    found = []
    for candidate in candidates:
        if (refused := _not_opened(candidate, facts)) is not None:
            report(refused)
            continue
        tried = _within(candidate, facts.settings.source, trial)
        if tried.problem:
            report(Tried(candidate.uri, redacted(f"{candidate.name}: {tried.problem}"), "check its cable"))
            continue
        camera = Camera(candidate, tried)
        found.append(camera)
        report(Tried(candidate.uri, str(camera)))
    return found


def _not_opened(candidate: Candidate, facts: Facts) -> Tried | None:
    device = candidate.device
    if device is None or is_free(device, facts):
        return None
    if (problem := permission_problem(device, facts.machine.user)) is not None:
        return Tried(candidate.uri, f"not opened: {problem[0]}", problem[1])
    for each in holding_file(device, facts.machine.proc):
        return Tried(candidate.uri, f"not opened: it is open in {each}", each.freeing)
    return None


def _within(candidate: Candidate, present: SourceSection, trial: Trial) -> CameraTrial:
    """Try a camera as the service would open it. A driver may never return."""
    source = SourceSection(uri=candidate.uri)
    if present.uri == candidate.uri:
        source = present
    results: list[CameraTrial] = []
    in_parallel([lambda: results.append(trial(source))], MOST_S)
    return results[0] if results else CameraTrial(problem=f"no answer within {MOST_S:g} s")
