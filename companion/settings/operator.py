"""The settings of dashboard, metrics, log and plug-ins."""

from __future__ import annotations

from typing import Annotated, Literal

from companion.settings.section import Section
from companion.settings.texts import HOST_AND_PORT, HOST_AND_PORT_OR_EMPTY


class DashboardSection(Section):
    """The web page of the vehicle."""

    listen: Annotated[str, HOST_AND_PORT_OR_EMPTY] = "127.0.0.1:8088"
    """HOST:PORT of the page; empty: none"""
    token_file: str | None = None
    """file with the token, readable by its owner only; required if other computers can reach `listen`"""


class MetricsSection(Section):
    """Metrics for a monitoring system."""

    listen: Annotated[str | None, HOST_AND_PORT] = None
    """HOST:PORT of the Prometheus endpoint /metrics (extra `metrics`); unset: disabled"""


class LogSection(Section):
    """The log on standard error."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    """minimum level of printed lines"""


class PluginsSection(Section):
    """Third-party behaviours, detectors and sources. Only the modules named here are loaded."""

    modules: tuple[str, ...] = ()
    """modules on the Python path, or names of installed plug-ins (entry points `companion.plugins`)"""
