"""All sections together, and the rules across several of them."""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field, ModelWrapValidatorHandler, ValidationInfo, model_validator

from companion.settings.bus import ZenohSection
from companion.settings.guidance import GuidanceSection
from companion.settings.language import LanguageSection
from companion.settings.operator import (
    DashboardSection,
    FoxgloveSection,
    GroundStationSection,
    LogSection,
    MetricsSection,
    MqttSection,
    PluginsSection,
    RecordingSection,
    Ros2Section,
)
from companion.settings.perception import (
    CameraSection,
    DetectorSection,
    MarkersSection,
    PreviewSection,
    SourceSection,
    TrackerSection,
    VideoSection,
    check_calibration_file,
)
from companion.settings.section import Section
from companion.settings.texts import CameraName
from companion.settings.vehicle import VehicleSection

# MAV_COMP_ID_CAMERA to MAV_COMP_ID_CAMERA6.
MOST_STATION_CAMERAS = 6


class CameraSections(Section):
    """A further camera or model, in its own process, published as cameras/NAME."""

    source: SourceSection = SourceSection()
    camera: CameraSection = CameraSection()
    detector: DetectorSection = DetectorSection()
    tracker: TrackerSection = TrackerSection()
    markers: MarkersSection = MarkersSection()
    recording: VideoSection = VideoSection()

    @model_validator(mode="wrap")
    @classmethod
    def _calibration_fits(cls, values: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        sections = handler(values)
        check_calibration_file(values, sections.source)
        return sections


class Settings(Section):
    """All settings.

    >>> from companion import Settings
    >>> Settings.model_validate({"detector": {"image_size": 320}}).detector.image_size
    320
    """

    vehicle: VehicleSection = VehicleSection()
    source: SourceSection = SourceSection()
    camera: CameraSection = CameraSection()
    detector: DetectorSection = DetectorSection()
    tracker: TrackerSection = TrackerSection()
    markers: MarkersSection = MarkersSection()
    guidance: GuidanceSection = GuidanceSection()
    zenoh: ZenohSection = ZenohSection()
    recording: RecordingSection = RecordingSection()
    preview: PreviewSection = PreviewSection()
    dashboard: DashboardSection = DashboardSection()
    language: LanguageSection = LanguageSection()
    foxglove: FoxgloveSection = FoxgloveSection()
    ros2: Ros2Section = Ros2Section()
    mqtt: MqttSection = MqttSection()
    ground_station: GroundStationSection = GroundStationSection()
    metrics: MetricsSection = MetricsSection()
    log: LogSection = LogSection()
    plugins: PluginsSection = PluginsSection()
    cameras: dict[CameraName, CameraSections] = Field(default_factory=dict)

    @model_validator(mode="wrap")
    @classmethod
    def _calibration_fits(
        cls, values: Any, handler: ModelWrapValidatorHandler[Self], info: ValidationInfo
    ) -> Self:
        settings = handler(values)
        check_calibration_file(values, settings.source, (info.context or {}).get("read_uri"))
        return settings

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Self:
        """Read what `model_dump(mode="json")` has written, where a tuple is a list.

        Raises:
            ValueError: not valid, for example written by another version.
        """
        return cls.model_validate(values, strict=False)

    @model_validator(mode="after")
    def _cameras_fit_together(self) -> Self:
        if self.guidance.camera is not None and self.guidance.camera not in self.cameras:
            known = ", ".join(self.cameras) or "none"
            raise ValueError(f"guidance.camera: no camera {self.guidance.camera!r} (cameras: {known})")
        openers: dict[str, str] = {}
        sharers: dict[str, str] = {}
        for key, source in self.sources().items():
            uri = f"/dev/video{int(source.uri)}" if source.uri.isdecimal() else source.uri
            if uri in openers and _opens_once(uri):
                raise ValueError(
                    f"{key}.uri and {openers[uri]}.uri are both {uri}, which can be "
                    f'opened once: give one of them share = "NAME" and the other uri = "shm://NAME"'
                )
            openers[uri] = key
            if source.share is None:
                continue
            if uri == f"shm://{source.share}":
                raise ValueError(f"{key}.share: {source.share!r} is the source of its own frames")
            if source.share in sharers:
                raise ValueError(f"{key}.share and {sharers[source.share]}.share are both {source.share!r}")
            sharers[source.share] = key
        return self

    @model_validator(mode="after")
    def _recordings_fit(self) -> Self:
        if self.recording.max_total_mb < self.recording.max_file_mb:
            raise ValueError(
                "recording.max_total_mb must be at least recording.max_file_mb, got "
                f"{self.recording.max_total_mb} and {self.recording.max_file_mb}"
            )
        return self

    @model_validator(mode="after")
    def _ground_station_fits(self) -> Self:
        station, vehicle = self.ground_station.url, self.vehicle.url
        if station is None:
            return self
        if len(self.sources()) > MOST_STATION_CAMERAS:
            raise ValueError(
                f"ground_station.url: MAVLink has component ids for {MOST_STATION_CAMERAS} cameras, got "
                f"{len(self.sources())}: remove cameras, or unset ground_station.url"
            )
        if station == vehicle and station.startswith(("udpin://", "serial://")):
            raise ValueError(
                f"ground_station.url and vehicle.url are both {station}, which can be opened once: give each "
                "a port of its own"
            )
        return self

    @model_validator(mode="after")
    def _videos_are_distinct(self) -> Self:
        videos = [self.recording.video, *(sections.recording.video for sections in self.cameras.values())]
        named = [video for video in videos if video is not None]
        if len(set(named)) < len(named):
            raise ValueError(f"every camera needs a different recording.video, got {', '.join(named)}")
        return self

    @model_validator(mode="after")
    def _tracks_outlive_the_frame_interval(self) -> Self:
        cameras: dict[str, Settings | CameraSections] = {"": self}
        cameras |= {f"cameras.{name}.": sections for name, sections in self.cameras.items()}
        for prefix, sections in cameras.items():
            rate_hz, max_age_s = sections.detector.rate_hz, sections.tracker.max_age_s
            if sections.tracker.enabled and rate_hz is not None and 1 / rate_hz >= max_age_s:
                raise ValueError(
                    f"{prefix}tracker.max_age_s must be longer than one period of {prefix}detector.rate_hz "
                    f"({1 / rate_hz:.3g} s), got {max_age_s:g}: every track would end before the next frame"
                )
        return self

    def sources(self) -> dict[str, SourceSection]:
        """Return key of the section → source of that camera, the first camera first."""
        return {"source": self.source} | {
            f"cameras.{name}.source": sections.source for name, sections in self.cameras.items()
        }

    def of_camera(self, name: str | None) -> Settings:
        """Return the settings of one camera's worker, with that camera's own sections. None: the first."""
        if name is None:
            return self.model_copy(update={"cameras": {}})
        sections = self.cameras[name]
        own = {section: getattr(sections, section) for section in CameraSections.model_fields}
        # What is recorded beside its video is one setting for all cameras.
        own["recording"] = self.recording.model_copy(update=dict(sections.recording))
        return self.model_copy(update={"cameras": {}, **own})


def _opens_once(uri: str) -> bool:
    return uri == "-" or uri.startswith("/dev/")
