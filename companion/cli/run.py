"""The command line of `companion run`: the service, until a signal ends it."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

import typer

from companion.cli.download import Pull, model_after_pull
from companion.cli.flags import EXIT_FAILED, is_terminal, plain_errors, warn_rendered_only
from companion.host.journal import log_to_standard_error
from companion.host.tasks import spawn
from vision.gc_pause import gc_paused

if TYPE_CHECKING:
    from companion.service import Service
    from companion.settings import Settings

# On a terminal, what is missing is said this often.
_REMIND_S = 5.0


def run(settings: Settings, pull: Pull = False) -> None:
    """Run the service.

    It starts with what is there: autopilot and camera are used as soon as they come. Exit code 2: wrong
    settings; 75: another start may succeed.
    """
    run_service(after_pull(settings) if pull else settings)


def after_pull(settings: Settings) -> Settings:
    """Return the settings with the model of `--pull`, which is downloaded if it is not there."""
    from companion.settings.perception import NO_SOURCE

    sources = [settings.of_camera(name).source.uri for name in (None, *settings.cameras)]
    detector = settings.detector.model_copy(
        update={
            "model": model_after_pull(settings.detector.model, [uri for uri in sources if uri != NO_SOURCE])
        }
    )
    return settings.model_copy(update={"detector": detector})


def run_service(settings: Settings, on_page: Callable[[str], None] = lambda _: None) -> None:
    """Run the service, as `run`. `on_page` is called with the page's line that has its address."""
    with gc_paused():
        from companion.bus.config import BusError
        from companion.cli.config_check import check_settings
        from companion.language.process import AskProcess
        from companion.operator.line_output import use_for_standard_error
        from companion.operator.metrics import MetricsError
        from companion.perception.supervisor import PerceptionStartError
        from companion.service import Service
        from companion.settings.plugins import PluginError
        from companion.settings.reading import ConfigurationError, unknown_variables
        from companion.vehicle.driver import LinkError

    # A stalled reader of standard error must not block the service. Before any handler uses the stream.
    output = use_for_standard_error()
    log_to_standard_error(settings.log.level.upper(), "%(levelname)s %(name)s: %(message)s")
    for line in unknown_variables(os.environ).values():
        logging.getLogger("companion").warning("%s", line)
    wrong = (ConfigurationError, LinkError, PerceptionStartError, BusError, MetricsError, PluginError)
    with plain_errors(*wrong):
        check_settings(settings)  # what is missing is reported by its part
        service = Service(
            settings,
            console=True,
            ask=AskProcess(settings),
            dropped_lines=lambda: 0 if output is None else output.dropped,
        )
        asyncio.run(_run_until_signal(settings, service, on_page))


def _freeze_loaded_objects() -> None:
    """Exclude all loaded objects from garbage collection.

    A full collection of everything imported takes 15 ms, which would delay a setpoint.
    """
    gc.collect()
    gc.freeze()


async def _run_until_signal(settings: Settings, service: Service, on_page: Callable[[str], None]) -> None:
    from companion.service.ending import on_ending

    ready = asyncio.Event()

    def on_ready() -> None:
        ready.set()
        _freeze_loaded_objects()

    running = asyncio.ensure_future(service.run(on_ready))
    # Before the service is ready there is nothing to shut down.
    watch = on_ending(lambda: service.stop() if service.ready else running.cancel())
    beside = [
        watch,
        spawn(_run_dashboard(settings, ready, on_page), "dashboard"),
        spawn(_warn_of_models(service), "warning of models"),
    ]
    if is_terminal(sys.stderr):
        beside.append(spawn(_remind(service), "reminder"))
    try:
        await running
    except asyncio.CancelledError:
        raise typer.Exit(EXIT_FAILED) from None
    finally:
        for task in beside:
            task.cancel()
        await asyncio.gather(*beside, return_exceptions=True)


async def _remind(service: Service) -> None:
    """Say what is missing, until cancelled."""
    while True:
        await asyncio.sleep(_REMIND_S)
        if text := service.parts.missing_text():
            logging.getLogger("companion").info("%s", text)


async def _warn_of_models(service: Service) -> None:
    """Warn of models of rendered scenes once the cameras are up."""
    await service.parts.complete(autopilot=False)
    # Shared frames of one of our cameras are those of its source.
    sources = [camera.settings.source for camera in service.cameras]
    shared = {f"shm://{source.share}": source.uri for source in sources}
    warn_rendered_only(
        (shared.get(source.uri, source.uri), loaded.model)
        for camera, source in zip(service.cameras, sources, strict=True)
        if (loaded := camera.supervisor.ready) is not None and loaded.rendered_only
    )


async def _run_dashboard(settings: Settings, ready: asyncio.Event, on_page: Callable[[str], None]) -> None:
    """Run the page once the service is ready, until cancelled."""
    from companion.dashboard.process import dashboard_process

    def say(line: str) -> None:
        logger = logging.getLogger("companion")
        if "http://" not in line:
            logger.warning("%s", line)
            return
        logger.info("%s", line)
        on_page(line)

    await ready.wait()
    async with dashboard_process(settings, say):
        await asyncio.Event().wait()
