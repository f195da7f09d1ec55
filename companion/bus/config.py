"""zenoh's configuration from the settings and, if they name one, a configuration file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import zenoh

from companion.host.passing import PassingError
from companion.settings import ZenohSection
from vision.file_kinds import open_file
from vision.redaction import redacted


class BusError(ConnectionError):
    """The zenoh session cannot be opened (a busy port, a bad endpoint, a bad configuration file)."""

    def __init__(self, text: str) -> None:
        super().__init__(redacted(text))


class EndpointTakenError(BusError, PassingError):
    """An endpoint to listen on is not available now: its port is in use, or its interface is not up yet."""


# Of one message to the service: zenoh drops a larger one before Python reads any part of it. A selector has
# no other limit; that of a payload is smaller, and then the sender of a command is answered.
LARGEST_RECEIVED_BYTES = 16 * 1024 * 1024
_MESSAGE_SIZE = "transport/link/rx/max_message_size"
# An express message takes a batch of its own, and one that finds none for 1 ms is dropped. Of the three that
# a frame brings at once, zenoh's two batches lost up to 5 % while a busy computer did not run its sender.
_BATCHES = 16
_EXPRESS_QUEUES = tuple(f"transport/link/tx/queue/size/{name}" for name in ("real_time", "data_high"))


def service_config(settings: ZenohSection) -> zenoh.Config:
    """Convert settings into the configuration of a service, which receives small messages alone.

    Raises:
        BusError: as `zenoh_config`.
    """
    config, default = zenoh_config(settings), zenoh.Config().get_json(_MESSAGE_SIZE)
    # A router passes on the images of others.
    if config.get_json(_MESSAGE_SIZE) == default and json.loads(config.get_json("mode")) != "router":
        config.insert_json5(_MESSAGE_SIZE, str(LARGEST_RECEIVED_BYTES))
    return config


def zenoh_config(settings: ZenohSection) -> zenoh.Config:
    """Convert settings into zenoh's configuration.

    A key of `config_file` replaces the default of a setting. A setting that was given must not differ from
    it.

    Raises:
        BusError: the file cannot be read, or differs from a given setting.
    """
    defaults, config = zenoh.Config(), zenoh.Config()
    if settings.config_file is not None:
        config = read_config_file("config_file", settings.config_file)
    ours: dict[str, tuple[str, Any]] = {
        "mode": ("mode", settings.mode),
        "connect": ("connect/endpoints", list(settings.connect)),
        "listen": ("listen/endpoints", list(settings.listen) if settings.mode == "peer" else []),
        "multicast_scouting": ("scouting/multicast/enabled", settings.multicast_scouting),
    }
    for name, (key, value) in ours.items():
        in_file = json.loads(config.get_json(key))
        if in_file == json.loads(defaults.get_json(key)) or (key.startswith("listen") and not value):
            config.insert_json5(key, json.dumps(value))
        elif in_file != value and name in settings.model_fields_set:
            raise BusError(
                f"zenoh.{name} is {json.dumps(value)}, but {settings.config_file} has {key} "
                f"{json.dumps(in_file)}: remove one of the two"
            )
    for key in _EXPRESS_QUEUES:
        if config.get_json(key) == defaults.get_json(key):
            config.insert_json5(key, str(_BATCHES))
    # Needed for the messages kept for late subscribers.
    config.insert_json5("timestamping/enabled", "true")
    if json.loads(config.get_json("mode")) == "peer":
        # A peer starts without its router and keeps retrying.
        config.insert_json5("connect/exit_on_failure", "false")
    return config


def read_config_file(setting: str, path: str) -> zenoh.Config:
    """Read a configuration file of zenoh, named by a setting. Raises BusError."""
    try:
        open_file(Path(path)).close()  # zenoh would wait for the writer of a pipe
        return zenoh.Config.from_file(path)
    except OSError as error:
        raise BusError(f"zenoh.{setting} {path}: cannot be read: {error.strerror}") from error
    except zenoh.ZError as error:
        raise BusError(f"zenoh.{setting} {path}: {first_line(error)}") from error


def first_line(error: BaseException) -> str:
    """Return the text of an error without the source location that zenoh appends."""
    return str(error).splitlines()[0].split(" at /")[0].strip() if str(error) else type(error).__name__
