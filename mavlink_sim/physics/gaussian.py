"""Normally distributed random numbers in a sixth of the time of `random.gauss`.

`NORMAL[random.getrandbits(12)]` draws one of 4096 equally likely quantiles of the standard normal
distribution: mean 0, standard deviation 1 to a thousandth, nothing beyond 3.7. Noise needs no more.
"""

from __future__ import annotations

from statistics import NormalDist

BITS = 12

_COUNT = 1 << BITS
NORMAL = tuple(NormalDist().inv_cdf((index + 0.5) / _COUNT) for index in range(_COUNT))
