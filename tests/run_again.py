"""A test that failed while the computer stood still is run again: what it saw says nothing about the program.

In a standstill every rule about silence and age does its work: setpoints expire, links are lost, flights end.
That is right, and fails the test that flew in real time. Such a test is run again, twice at most, and told as
RERUN with what failed; every other failure stands. See `tests/standstill.py`.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from tests.standstill import Watch, longest_standstill_s, visit_all_processors

RUNS_AGAIN = 2
# Where a run notes its standstills; its workers, and a pytest that a test starts, read them there.
NOTES = "COMPANION_TEST_STANDSTILLS"
BEGAN_NS = pytest.StashKey[int]()


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """The first pytest keeps watch."""
    if hasattr(config, "workerinput"):
        # What kills a worker is no standstill: the controller, which would start its test anew whatever our
        # condition says, is not told that it may be run again.
        config.failures_db.set_test_reruns = lambda nodeid, reruns: None  # type: ignore[attr-defined]
    if NOTES in os.environ or config.option.collectonly:
        return
    folder = tempfile.TemporaryDirectory(prefix="standstills-")
    config.add_cleanup(folder.cleanup)
    watch = Watch(Path(folder.name) / "notes")
    config.add_cleanup(watch.close)
    os.environ[NOTES] = str(watch.notes)
    config.add_cleanup(partial(os.environ.__delitem__, NOTES))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.option.usepdb:  # somebody looks at the failure, and it cannot be run again
        return
    for item in items:
        item.add_marker(pytest.mark.flaky(reruns=RUNS_AGAIN, condition=partial(stood_still, item)))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    item.stash[BEGAN_NS] = time.monotonic_ns()
    return (yield)


def stood_still(item: pytest.Item, error: BaseException | None) -> bool:
    """Whether a processor did since this item's run began. It is asked about what passed too: no error."""
    if error is None:
        return False
    visit_all_processors()
    return longest_standstill_s(Path(os.environ[NOTES]), item.stash[BEGAN_NS]) > 0.0


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    again = terminalreporter.stats.get("rerun", [])
    if again:
        longest_s = longest_standstill_s(Path(os.environ[NOTES]), since_ns=0)
        terminalreporter.write_line(
            f"{len(again)} run again, for a processor that stood still, at most {longest_s:.1f} s"
        )
