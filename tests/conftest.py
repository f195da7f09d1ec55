"""What holds for all tests."""

import os

from hypothesis import settings

# How long an example takes says more of the machine than of the code. The same examples every time, so that a
# failure is of the change; `--hypothesis-profile=explore` tries new ones.
settings.register_profile("steady", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None)
settings.load_profile("steady")

# Tests run side by side: a thread pool of torch or OpenCV in each of them would only wait for the others'.
os.environ.setdefault("OMP_NUM_THREADS", "1")
