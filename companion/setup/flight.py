"""Whether a running service may be restarted: not while its vehicle is armed."""

from __future__ import annotations

from companion.doctor.service_query import find_service
from companion.settings import Settings
from companion.settings.layers import SYSTEM_FILE, SettingsFiles, settings_files
from companion.settings.reading import ConfigurationError, load_layers
from companion.setup.files import below
from companion.setup.systemctl import Host, SetupError


def settings_of_unit(host: Host, unit: str) -> Settings:
    """Return the settings that a unit starts with. Raises ConfigurationError."""
    if host.user:
        return load_layers(settings_files(), environment={}).settings
    instance = unit.partition("@")[2].removesuffix(".service")
    system = below(host.root, SYSTEM_FILE)
    files = [system] if system.is_file() else []
    files += [system.with_name(f"{instance}.toml")] if instance else []
    environment = {"COMPANION_VEHICLE_NAME": instance} if instance else {}
    return load_layers(SettingsFiles(tuple(files)), environment=environment).settings


def check_not_flying(host: Host) -> None:
    """Raise SetupError if a running service says that its vehicle is armed, or does not say."""
    for unit in host.units():
        if host.is_running(unit) and (why := _why_not(host, unit)):
            raise SetupError(f"{unit} would be stopped, and {why}: land and disarm, or add --force")


def _why_not(host: Host, unit: str) -> str:
    try:
        settings = settings_of_unit(host, unit)
    except (ConfigurationError, OSError):
        return "whether its vehicle is armed is not known: its settings cannot be read"
    found = find_service(settings.zenoh, settings.vehicle.name)
    if found.service is None or found.service.status is None:
        said = "it is silent" if found.instead is None else found.instead.found
        return f"whether its vehicle is armed is not known: {said}"
    return "its vehicle is armed" if found.service.status["vehicle"]["armed"] else ""
