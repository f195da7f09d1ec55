"""Loading what users add: modules that register commands, detectors and sources when they are imported.

The service imports them, and so does every perception worker, where sources and detectors are opened.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterable
from importlib.metadata import entry_points

logger = logging.getLogger(__name__)

ENTRY_POINTS = "companion.plugins"
"""The group of entry points in which an installed package may give its module a short name."""


class PluginError(RuntimeError):
    """A plug-in cannot be loaded. The message is one line for a person."""


def load_plugins(names: Iterable[str]) -> None:
    """Import the modules that a user named: each the name of an entry point in ENTRY_POINTS, or of a module.

    Raises:
        PluginError: there is no such module, or it cannot be imported; the traceback is in the log.
    """
    installed = {point.name: point.value for point in entry_points(group=ENTRY_POINTS)}
    for name in names:
        module = installed.get(name, name)
        try:
            importlib.import_module(module)
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
