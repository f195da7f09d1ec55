"""Failures that may pass: another start, with the same settings, may succeed."""

from __future__ import annotations

EXIT_PASSING = 75  # EX_TEMPFAIL of sysexits.h


class PassingError(Exception):
    """Something is not there yet, or is used by another program. The message is one line.

    Errors have it as a further base. A program that one of them ends has the exit code EXIT_PASSING.
    """


class AddressTakenError(PassingError):
    """An address of ours cannot be served now."""
