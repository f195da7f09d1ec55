"""Loads plug-ins: modules that register commands, detectors and sources when they are imported.

The service imports them, and so does every perception worker, which opens sources and detectors.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterable
from importlib.metadata import entry_points

from vision.registry import RegistrationError

logger = logging.getLogger(__name__)

ENTRY_POINTS = "companion.plugins"
"""The entry point group in which an installed package can give its module a short name."""


class PluginError(RuntimeError):
    """A plug-in cannot be loaded. The message is one line."""


def load_plugins(names: Iterable[str]) -> None:
    """Import modules, each by its name or by the name of an entry point in ENTRY_POINTS.

    Raises:
        PluginError: no such module, or it registers something invalid, or it cannot be imported; then the
            traceback is in the log.
    """
    names = list(names)
    if not names:
        return  # nearly always: reading what is installed takes 4 ms
    installed = {point.name: point.value for point in entry_points(group=ENTRY_POINTS)}
    for name in names:
        module = installed.get(name, name)
        try:
            importlib.import_module(module)
        except RegistrationError as error:
            raise PluginError(f"plugins: {name!r}: {error}") from error
        except Exception as error:
            if isinstance(error, ModuleNotFoundError) and error.name == module:
                known = ", ".join(sorted(installed)) or "none"
                raise PluginError(
                    f"plugins: no module {module!r} on the Python path; installed plug-ins: {known}"
                ) from error
            logger.exception("plug-in %s cannot be imported", name)
            raise PluginError(
                f"plugins: {name!r} cannot be imported: {type(error).__name__}: {error}"
            ) from error
