"""The former spellings of commands and options: whoever writes one gets the new one, whole, in one line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Former:
    """A command as it was written, and as it is written now.

    Attributes:
        old, new: without `companion`, or of another program whole; placeholders are in capitals. An option in
            `old` must be there.
        options: former options of it, with their values → what is written now; empty: nothing.
        only_options: the command itself is written as before.
    """

    old: str
    new: str
    options: dict[str, str] = field(default_factory=dict)
    only_options: bool = False

    @property
    def words(self) -> list[str]:
        """The command."""
        return [word for word in self.old.split() if re.fullmatch(r"[a-z-]+", word) and word[0] != "-"]

    def line(self, options: Sequence[str] = ()) -> str:
        """The line that gives the new spelling, with these of the former options."""
        old = " ".join([self.old, *options])
        new = " ".join([self.new, *(self.options[option] for option in options)])
        program = "" if new.startswith("python ") else "companion "
        return f"companion {old} is now {program}{' '.join(new.split())}"


_OF_A_SOURCE = {
    "--width N": "--source-width N",
    "--height N": "--source-height N",
    "--pixel-format FORMAT": "--source-pixel-format FORMAT",
}
_OF_DETECT = {**_OF_A_SOURCE, "--rate HZ": "--source-rate-hz HZ"}
_MARKERS = "detect SOURCE --model none --markers"

# The first that matches is said.
FORMER = (
    Former("detect SOURCE", "detect SOURCE", _OF_DETECT, only_options=True),
    Former("preview SOURCE", "detect SOURCE --model none"),
    Former("depth --detect SOURCE", "detect SOURCE --depth"),
    Former("depth SOURCE", "detect SOURCE --model none --depth"),
    Former(
        "cloud SOURCE FILE",
        "detect SOURCE --model none --cloud FILE",
        {
            "--frame FRAME": "--cloud-frame FRAME",
            "--view IMAGE": "--cloud-view IMAGE",
            "--text": "--cloud-text",
        },
    ),
    Former("markers print IDS", "markers IDS"),
    Former(
        "markers detect SOURCE",
        _MARKERS,
        {**_OF_A_SOURCE, "--dictionary NAME": "NAME", "--size METRES": "--markers-size-m METRES"},
    ),
    Former("markers --json SOURCE", f"{_MARKERS} --json"),
    Former("markers --save FOLDER SOURCE", f"{_MARKERS} --save FOLDER"),
    Former("markers --limit N SOURCE", f"{_MARKERS} --limit N"),
    Former("dashboard", "view", {"--listen HOST:PORT": "--dashboard-listen HOST:PORT"}),
    Former("mission --check FILE", "send --file FILE --check"),
    Former("mission FILE", "send --file FILE"),
    Former("commands", "describe commands"),
    Former("topics", "describe topics"),
    Former("config", "describe settings"),
    Former("cameras", "describe cameras"),
    Former("record DIR", "log record DIR"),
    Former("replay FILE", "log replay FILE"),
    Former("sightings FILE", "log show FILE --objects geojson", {"--geojson": "", "--kml": "--objects kml"}),
    Former("log list FOLDER", "log show FOLDER"),
    Former("log recover FILE OUTPUT", "log convert FILE OUTPUT.mcap"),
    Former("log tlog FILE OUTPUT", "log convert FILE OUTPUT.tlog"),
    Former("collect FOLDER FILE", "learn collect FOLDER FILE"),
    Former("evaluate DATASET", "learn evaluate DATASET"),
    Former("train-policy TASK", "learn train --policy TASK"),
    Former("train", "learn train"),
    Former("models list", "models show"),
    Former("models info FILE", "models show FILE"),
    Former("models verify FILE EXPORT", "models show FILE --compare EXPORT"),
    Former(
        "calibrate extrinsics COLOUR INFRARED",
        "calibrate lens COLOUR --depth-source INFRARED",
        {
            "--colour-calibration FILE": "--calibration FILE",
            "--infrared-calibration FILE": "--depth-calibration FILE",
        },
    ),
    Former("bench bus", "python -m benchmarks.bus"),
)


def former_line(arguments: Sequence[str]) -> str | None:
    """The line for a former spelling in the arguments of `companion`; None: there is none."""
    given = {argument.partition("=")[0] for argument in arguments if argument.startswith("--")}
    for former in FORMER:
        words, needed = former.words, {word for word in former.old.split() if word.startswith("--")}
        options = [option for option in former.options if option.split()[0] in given]
        if (
            list(arguments[: len(words)]) == words
            and needed <= given
            and (options or not former.only_options)
        ):
            return former.line(options)
    return None
