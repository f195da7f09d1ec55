"""What holds for all tests."""

import gc
import os
import zlib
from collections.abc import Iterator

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


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """What is imported stays: the garbage collector need not look through a million objects again and again.

    Neither while they are imported (a tenth of the time that takes) nor in the tests (an eighth).
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()
