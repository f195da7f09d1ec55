"""The command line of `companion ros2 node`."""

from __future__ import annotations

import asyncio
import os
import sys
from threading import Event
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import CLIENT_SETTINGS, EXIT_BAD_INPUT, plain_errors, refuse, settings_command
from companion.host.load import with_load

if TYPE_CHECKING:
    from companion.settings import Settings

ros2 = typer.Typer(help="ROS 2: a node beside the service.", no_args_is_help=True)


@settings_command(ros2, *CLIENT_SETTINGS, "ros2", "source.uri", "source.depth")
def node(
    settings: Settings,
    ros_arguments: Annotated[
        list[str] | None,
        typer.Argument(help="For ROS, after --: --ros-args -r cmd_vel:=/cmd_vel", show_default=False),
    ] = None,
    python: Annotated[
        str | None, typer.Option(help="Python with rclpy. Default: that of the sourced ROS.")
    ] = None,
) -> None:
    """Run a ROS 2 node that publishes what the service of vehicle.name sees, and receives commands.

    It needs a sourced ROS 2, Humble or later. For cameras with a source ros:// give it the settings file or
    --source of the service. Ctrl-C ends it.
    """
    from companion.bus.client import NoAnswerError
    from companion.bus.config import BusError
    from companion.ros2.process import Ros2Error, find_python, run_node
    from companion.service.ending import on_ending
    from vision.sources import SourceError

    def say(line: str) -> None:
        print(with_load(line), flush=True)

    async def run(found: str) -> None:
        ending = Event()
        _watch = on_ending(ending.set)
        await run_node(settings, found, ros_arguments or (), ending, say)

    if ros_arguments and ros_arguments[0] != "--ros-args":
        refuse(f"{ros_arguments[0]!r}: expected --ros-args after --")
    with plain_errors(NoAnswerError, BusError, Ros2Error, SourceError, code=EXIT_BAD_INPUT):
        asyncio.run(run(find_python(python)))
    sys.stdout.flush()
    os._exit(0)  # a thread of zenoh that calls back while Python ends would abort it
