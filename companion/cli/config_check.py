"""What the settings name is checked before anything is opened: plug-ins, key files, model, sources, folders.

A camera, the autopilot's serial line or a disk may come later, and the service starts without: a warning.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import zenoh

from companion.bus.config import BusError, read_config_file, zenoh_config
from companion.dashboard.access import Access, DashboardError, read_token
from companion.language.endpoints import LanguageError, read_api_key
from companion.settings import Settings
from companion.settings.key_files import KeyFileError, check_private
from companion.settings.perception import NO_SOURCE, SourceSection
from companion.settings.plugins import PluginError, load_plugins
from companion.settings.reading import ConfigurationError
from companion.vehicle.driver import LinkError
from companion.vehicle.link_url import LinkScheme, parse_link_url
from companion.vehicle.signing import read_key
from vision.extras import install_command
from vision.sources.opening import check_address
from vision.sources.source import SourceError, SourceUnavailableError

# Of zenoh's section transport/link/tls; the private ones are for their owner only.
_TLS_FILES = ("root_ca_certificate", "listen_certificate", "connect_certificate")
_TLS_KEYS = ("listen_private_key", "connect_private_key")
_FAULTS = (PluginError, LinkError, LanguageError, DashboardError, BusError, SourceError, ValueError)


def check_settings(settings: Settings) -> list[str]:
    """Check what the settings name, as this user and without loading a model or opening a device.

    Returns:
        What is missing now and may come later, and what a lens does not see, one line each.

    Raises:
        ConfigurationError: every setting that is wrong, one line each.
    """
    check = _Check()
    check.plugins(settings)
    check.extras(settings)
    check.vehicle(settings)
    check.page(settings)
    check.broker(settings)
    check.network(settings)
    if settings.language.key_file is not None:
        with check.fault():
            read_api_key(Path(settings.language.key_file))
    for prefix, name in {"": None, **{f"cameras.{name}.": name for name in settings.cameras}}.items():
        check.camera(prefix, settings.of_camera(name))
    if settings.recording.directory:
        check.folder("recording.directory", Path(settings.recording.directory))
    if check.faults:
        raise ConfigurationError(*check.faults)
    return check.missing


class _Check:
    """Collects the faults, and what is missing."""

    def __init__(self) -> None:
        self.faults: list[str] = []
        self.missing: list[str] = []

    @contextmanager
    def fault(self, key: str = "") -> Iterator[None]:
        """Collect the fault that is raised inside. `key`: named before it, unless it names itself."""
        try:
            yield
        except _FAULTS as error:
            self.faults.append(f"{key}: {error}" if key else str(error))

    def plugins(self, settings: Settings) -> None:
        """Import them: they register kinds of detectors and sources."""
        with self.fault():
            load_plugins(settings.plugins.modules)

    def extras(self, settings: Settings) -> None:
        """Check that the modules which settings need are installed. The service runs without its clients."""
        for key, module, needed, found in (
            ("vehicle.driver", "mavsdk", settings.vehicle.driver == "mavsdk", self.faults),
            ("metrics.listen", "prometheus_client", settings.metrics.listen is not None, self.faults),
            ("recording.directory", "mcap", bool(settings.recording.directory), self.missing),
            ("foxglove.listen", "foxglove", settings.foxglove.listen is not None, self.missing),
            ("mqtt.url", "aiomqtt", settings.mqtt.url is not None, self.missing),
            ("mqtt.webhooks", "httpx", bool(settings.mqtt.webhooks), self.missing),
        ):
            if needed and find_spec(module) is None:
                found.append(f"{key}: {module} is not installed: {install_command(module)}")

    def vehicle(self, settings: Settings) -> None:
        """Check the links' addresses, the serial device and the keys."""
        with self.fault("vehicle.url"):
            url = parse_link_url(settings.vehicle.url)
            device = url.address[0]
            if url.scheme is LinkScheme.SERIAL and not os.access(device, os.R_OK | os.W_OK):
                there = Path(device).exists()
                advice = "no permission; add the user to its group (often dialout)"
                self.missing.append(f"vehicle.url: {device}: {advice if there else 'no such device'}")
        station = settings.ground_station
        if station.url is not None:
            with self.fault("ground_station.url"):
                parse_link_url(station.url)
        if station.video_token_file is not None:
            with self.fault():
                read_token(station.video_token_file, "ground_station.video_token_file")
        if settings.vehicle.signing_key_file is not None:
            with self.fault("vehicle.signing_key_file"):
                read_key(settings.vehicle.signing_key_file)

    def page(self, settings: Settings) -> None:
        """Check the token, and that there is one where it is needed."""
        section = settings.dashboard
        if section.listen:
            with self.fault():
                token = None if section.token_file is None else read_token(section.token_file)
                Access(section.listen.rpartition(":")[0], token, hosts=section.hosts)

    def broker(self, settings: Settings) -> None:
        """Check the files that the broker of MQTT needs."""
        if settings.mqtt.url is not None and find_spec("aiomqtt") is not None:
            from companion.mqtt.broker import broker_of

            with self.fault():
                broker_of(settings.mqtt)

    def network(self, settings: Settings) -> None:
        """Check zenoh's configuration files and the files of TLS that they name."""
        with self.fault():
            self._tls_files(zenoh_config(settings.zenoh))
        if (child := settings.zenoh.child_config_file) is not None:
            with self.fault():
                self._tls_files(read_config_file("child_config_file", child))

    def _tls_files(self, config: zenoh.Config) -> None:
        named = json.loads(config.get_json("transport/link/tls"))
        for name in (*_TLS_FILES, *_TLS_KEYS):
            if not (file := named.get(name)):
                continue
            try:
                with open(file, "rb") as opened:
                    if name in _TLS_KEYS:
                        check_private(Path(file), os.fstat(opened.fileno()))
            except OSError as error:
                self.faults.append(f"zenoh {name} {file}: cannot be read: {error.strerror}")
            except KeyFileError as error:
                self.faults.append(f"zenoh {name} {error}")

    def camera(self, prefix: str, settings: Settings) -> None:
        """Check one camera's source, model and video."""
        source, detector = settings.source, settings.detector
        if source.uri == NO_SOURCE:
            return
        self._source(f"{prefix}source.uri", source.uri, source)
        if source.depth is not None:
            self._source(f"{prefix}source.depth", source.depth, source)
        if problem := settings.camera.lens_problem():
            self.missing.append(f"{prefix}camera: {problem}")
        if detector.enabled:
            from vision.detector import check_detector  # a twelfth of a service's imports

            with self.fault(f"{prefix}detector"):
                check_detector(detector.kind, detector.loading(detector.confidence))
        if settings.recording.video is not None:
            self.folder(f"{prefix}recording.video", Path(settings.recording.video).parent)

    def _source(self, key: str, uri: str, source: SourceSection) -> None:
        with self.fault(key):
            try:
                check_address(uri, replace(source.opening(), depth=None))
            except SourceUnavailableError as error:
                self.missing.append(f"{key}: {error}")

    def folder(self, key: str, path: Path) -> None:
        """Check that files can be made in a folder, or the folder itself."""
        path = path.absolute()
        existing = next(folder for folder in (path, *path.parents) if folder.exists())
        if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
            self.missing.append(f"{key}: {existing} is no folder that this user may write")
