"""What the service looks through: a camera with its model each, a process each, published under its own name.

The first view is the one of the sections `source`, `camera` and `detector`; it has no name. One view steers.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable

from companion.guidance.target import Target
from companion.guidance.targets import HistoryError, StateHistory, targets_from_detections
from companion.perception import PerceptionKeeper, PerceptionState
from companion.perception_messages import Preview
from companion.settings import Settings
from vision.pipeline import PerceptionResult

logger = logging.getLogger(__name__)

# A view is unwell when its newest result is older than this, and than its own rate allows.
_SEEING_S = 1.0


class View:
    """One perception worker, and what it saw last.

    Attributes:
        name: None for the first.
        settings: with this view's own sections.
        newest: the newest result; None before the first.
        targets: where the newest result's objects are, after `place`.
        unplaced: why they have no place; empty if they have.
    """

    def __init__(
        self,
        settings: Settings,
        name: str | None,
        *,
        on_result: Callable[[View, PerceptionResult], None],
        on_preview: Callable[[View, Preview], None],
        on_event: Callable[[str, str], None],
    ) -> None:
        self.name = name
        self.settings = settings
        self.newest: PerceptionResult | None = None
        self.targets: tuple[Target, ...] = ()
        self.unplaced = ""
        self._on_result = on_result
        self._on_event = on_event
        self.keeper = PerceptionKeeper(
            settings,
            on_result=self._take,
            on_event=self._tell,
            on_preview=lambda preview: on_preview(self, preview),
        )

    @property
    def class_names(self) -> tuple[str, ...] | None:
        """What the detector knows; None while there is none to ask."""
        return self.keeper.status.class_names or None

    def age_s(self, now_ns: int) -> float | None:
        """Of the newest result, from its capture; None before the first."""
        return None if self.newest is None else (now_ns - self.newest.captured_ns) / 1e9

    def seeing(self, now_ns: int) -> bool:
        """Results come as they should, or none are to be expected."""
        if not self.settings.detector.enabled or self.keeper.status.state is PerceptionState.FINISHED:
            return True
        age_s, rate_hz = self.age_s(now_ns), self.settings.detector.rate_hz
        allowed_s = max(_SEEING_S, self.settings.guidance.perception_max_age_s)
        return age_s is not None and age_s <= allowed_s + (1 / rate_hz if rate_hz else 0.0)

    def place(self, result: PerceptionResult, history: StateHistory) -> None:
        """Work out where what a result shows is."""
        try:
            self.targets = targets_from_detections(
                result.detections.records(),
                result.captured_ns,
                self.settings.camera.model(result.width, result.height),
                self.settings.camera.mount(),
                history,
            )
            self.unplaced = ""
        except HistoryError as error:
            # Without the attitude of that moment a box has no direction: seen and published, not steered by.
            self.targets, self.unplaced = (), str(error)

    def _take(self, result: PerceptionResult) -> None:
        self.newest = result
        try:
            self._on_result(self, result)
        except Exception as error:
            # Perception itself is well: it must not be ended for a fault on this side.
            logger.exception("a detection message could not be used")
            self.targets, self.unplaced = (), f"{type(error).__name__}: {error}"

    def _tell(self, level: str, text: str) -> None:
        self._on_event(level, text if self.name is None else f"view {self.name}: {text}")


def open_views(
    settings: Settings,
    *,
    on_result: Callable[[View, PerceptionResult], None],
    on_preview: Callable[[View, Preview], None],
    on_event: Callable[[str, str], None],
) -> tuple[View, ...]:
    """Every view there is, the first one first. None is started yet."""
    names = (None, *settings.views)
    threads = threads_each(len(names))
    views = []
    for name in names:
        own = settings.of_view(name)
        if own.detector.threads is None:
            detector = own.detector.model_copy(update={"threads": threads})
            own = own.model_copy(update={"detector": detector})
        views.append(View(own, name, on_result=on_result, on_preview=on_preview, on_event=on_event))
    return tuple(views)


def threads_each(views: int) -> int:
    """All processors but one, shared out: the service, and whoever talks to it, must not wait for them."""
    return max(1, (len(os.sched_getaffinity(0)) - 1) // views)
