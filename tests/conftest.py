"""What holds for all tests."""

import gc
import os
import zlib

import pytest
from hypothesis import settings

# How long an example takes says more of the machine than of the code. The same examples every time, so that a
# failure is of the change; `--hypothesis-profile=explore` tries new ones.
settings.register_profile("steady", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None)
settings.load_profile("steady")

pytest_plugins = ["tests.run_again"]

# Tests run side by side: a thread pool of torch or OpenCV in each of them would only wait for the others'.
os.environ.setdefault("OMP_NUM_THREADS", "1")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Scatter the files: those that wait for flights in real time stand next to each other by their names.

    Workers that run side by side take what is neighbouring; so while some wait, others compute. The order is
    the same every time, and within a file it stays.
    """
    items.sort(key=lambda item: zlib.crc32(item.path.relative_to(item.config.rootpath).as_posix().encode()))


def pytest_collection_finish() -> None:
    """What was imported stays: the garbage collector need not look through a million objects again and again.

    That was an eighth of the tests' time.
    """
    gc.collect()
    gc.freeze()
