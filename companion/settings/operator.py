"""The settings of what people and their monitoring are told."""

from __future__ import annotations

from typing import Annotated, Literal

from companion.settings.section import Section
from companion.settings.texts import HOST_AND_PORT


class MetricsSection(Section):
    """Numbers for a monitoring system."""

    listen: Annotated[str | None, HOST_AND_PORT] = None
    """HOST:PORT that serves /metrics in Prometheus' format (extra `metrics`); unset: nothing listens"""


class LogSection(Section):
    """What is said on standard error."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    """the least severe lines that are printed"""


class PluginsSection(Section):
    """Behaviours, detectors and sources of others. Nothing is loaded that is not named here."""

    modules: tuple[str, ...] = ()
    """modules on the Python path, or names of installed plug-ins (entry points `companion.plugins`)"""
