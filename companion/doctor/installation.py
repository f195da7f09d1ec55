"""Checks of the installation and of the settings: wrong ones, unknown variables, old packages."""

from __future__ import annotations

import platform
import re
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import PackageNotFoundError, requires, version

from companion.doctor.check import Check, fault, ok, unknown, warning
from companion.doctor.facts import CheckKind, Facts
from companion.settings.reading import unknown_variables
from vision.sources.camera import camera_device

PACKAGE = "mavlink-companion"
# `name>=1.2`, with what follows; extras' names in brackets before it.
_OF_DEVELOPERS = re.compile(r"extra == ['\"]dev['\"]")
_REQUIREMENT = re.compile(r"(?P<name>[A-Za-z0-9._-]+)(?:\[[^]]*\])?\s*>=\s*(?P<least>[0-9.]+)(?P<rest>.*)")


def _settings(facts: Facts) -> Iterator[Check]:
    if not facts.settings_known and facts.service is not None:
        found = "those of the running service cannot be read: it is of another version"
        yield warning("settings", found, "run the companion doctor of its own environment")
    for line in facts.wrong:
        yield fault("settings", line, "companion describe settings lists every setting with its range")
    missing = [line for line in facts.missing if not _has_own_check(line, facts)]
    for line in missing:
        yield warning("settings", line, "it may come later; the service starts without")
    if facts.settings_known and not facts.wrong and not missing:
        yield ok("settings", "nothing wrong")


def _files(facts: Facts) -> Iterator[Check]:
    for found, advice in facts.files.not_read:
        yield warning("settings files", found, advice)
    if facts.service is not None:
        return  # it was started with files of its own
    in_force = ", then ".join(map(str, facts.files.files))
    yield ok("settings files", f"in force: {in_force}" if in_force else "none, and defaults in force")


def _has_own_check(line: str, facts: Facts) -> bool:
    """Whether another check says more: of a serial device, or of a camera's."""
    key = line.partition(":")[0]
    devices = {
        f"{name}.uri" for name, source in facts.settings.sources().items() if camera_device(source.uri)
    }
    return key in {*devices, "vehicle.url"}


def _variables(facts: Facts) -> Iterator[Check]:
    for name, text in unknown_variables(facts.machine.environment).items():
        yield warning("environment", text, f"unset {name}, or correct its name")


def _packages(_facts: Facts) -> Iterator[Check]:
    try:
        lines = requires(PACKAGE) or []
    except PackageNotFoundError:
        yield unknown("packages", f"{PACKAGE} is not installed: it runs from a checkout")
        return
    yield from check_packages(lines, installed_version)


def installed_version(name: str) -> str | None:
    """Return the version of an installed package; None: it is not."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def check_packages(lines: Iterable[str], version_of: Callable[[str], str | None]) -> Iterator[Check]:
    """Compare installed versions with the lower bounds of requirements.

    Args:
        lines: requirements as in a package's metadata.
        version_of: returns None for a package that is missing.
    """
    old = False
    for line in lines:
        match = _REQUIREMENT.match(line)
        if match is None or _OF_DEVELOPERS.search(match["rest"]):  # an environment has setuptools without it
            continue
        name, least, of_extra = match["name"], match["least"], "extra ==" in match["rest"]
        there = version_of(name)
        if there is None:
            if not of_extra and "platform" not in match["rest"]:
                old = True
                yield fault("packages", f"{name} is not installed", f"pip install '{name}>={least}'")
        elif _numbers(there) < _numbers(least):
            old = True
            kind = warning if of_extra else fault
            found = f"{name} {there} is installed, {least} or newer is needed"
            yield kind("packages", found, f"pip install --upgrade '{name}>={least}'")
    if not old:
        yield ok("packages", f"new enough; Python {platform.python_version()}")


def _numbers(text: str) -> tuple[int, ...]:
    """Return the release of a version: `2.10.0+cpu` is 2, 10. Trailing zeros do not count."""
    match = re.match(r"[0-9]+(?:\.[0-9]+)*", text)
    numbers = [int(each) for each in match[0].split(".")] if match else []
    while numbers and not numbers[-1]:
        numbers.pop()
    return tuple(numbers)


CHECKS = (
    CheckKind("settings", "wrong settings; missing devices, models, folders, key files", _settings),
    CheckKind("settings files", "files that are not read, and which are in force", _files),
    CheckKind("environment", "`COMPANION_…` variables that are no setting", _variables),
    CheckKind("packages", "packages older than this version needs", _packages),
)
