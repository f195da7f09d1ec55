"""The files of a vehicle for MAVLink FTP: parameters, component metadata with events, log folder.

As in PX4: parameters that differ from their defaults in BSON; metadata (https://mavlink.io/en/services/
component_information.html) as xz-compressed JSON under /etc/extras, found through COMPONENT_METADATA.
"""

from __future__ import annotations

import json
import lzma
import struct
from collections.abc import Callable, Iterable
from functools import cache, partial
from typing import Any

from mavlink_sim.px4.parameters import INT32, Parameter, Parameters, default_parameters, is_volatile
from mavlink_sim.releases import Release
from mavlink_sim.services.context import ServiceContext
from mavlink_sim.services.event_texts import events_metadata
from mavlink_sim.services.file_system import FileSystem
from mavlink_sim.services.file_transfer import checksum
from mavlink_sim.wire.messages import component_metadata

GENERAL = "etc/extras/component_general.json.xz"
PARAMETERS = "etc/extras/parameters.json.xz"
EVENTS = "etc/extras/all_events.json.xz"
# COMP_METADATA_TYPE
PARAMETER_TYPE = 1
EVENTS_TYPE = 4

_BSON_DOUBLE, _BSON_INT32 = 0x01, 0x10


def vehicle_files(parameters: Parameters, release: Release) -> FileSystem:
    """The files of a new vehicle; parameter files are generated from the current values."""
    files = FileSystem(joins_root=release.joins_ftp_paths)
    files.provide("parameters.bson", partial(_customised, parameters))
    files.provide("parameters_backup.bson", partial(_customised, parameters))
    files.provide(GENERAL, partial(_compressed_from, general_metadata))
    files.provide(PARAMETERS, partial(_compressed_from, parameter_metadata))
    files.provide(EVENTS, partial(_compressed_from, event_metadata))
    files.provide_directory("/log")
    return files


def _customised(parameters: Parameters) -> bytes:
    return bson(parameters.customised())


def _compressed_from(metadata: Callable[[], bytes]) -> bytes:
    return _compressed(metadata())


def bson(parameters: Iterable[Parameter]) -> bytes:
    """PX4's parameter file: one BSON document (bsonspec.org) of int32 and double elements."""
    body = bytearray()
    for parameter in parameters:
        name = parameter.name.encode() + b"\0"
        if parameter.kind == INT32:
            body += bytes([_BSON_INT32]) + name + struct.pack("<i", parameter.value)
        else:
            body += bytes([_BSON_DOUBLE]) + name + struct.pack("<d", parameter.value)
    return struct.pack("<i", len(body) + 5) + body + b"\0"


# ---- metadata


@cache
def parameter_metadata() -> bytes:
    """JSON by MAVLink's parameter schema: name, type, group and default of each."""
    listed = []
    for parameter in default_parameters():
        name = parameter.name
        entry: dict[str, Any] = {
            "name": name,
            "type": "Int32" if parameter.kind == INT32 else "Float",
            "default": parameter.value,
            "group": name.split("_")[0],
            "category": "System" if is_volatile(name) else "Standard",
            "shortDesc": name,
        }
        if is_volatile(name):
            entry["volatile"] = True
        listed.append(entry)
    return _json({"version": 1, "parameters": listed})


@cache
def event_metadata() -> bytes:
    """JSON by MAVLink's events schema: names and texts of the vehicle's events."""
    return _json(events_metadata())


@cache
def general_metadata() -> bytes:
    """JSON by MAVLink's general schema: the other metadata files and their checksums."""
    files: list[tuple[int, str, Callable[[], bytes]]] = [
        (PARAMETER_TYPE, PARAMETERS, parameter_metadata),
        (EVENTS_TYPE, EVENTS, event_metadata),
    ]
    types = [
        {"type": kind, "uri": f"mftp://{path}", "fileCrc": checksum(content())}
        for kind, path, content in files
    ]
    return _json({"version": 1, "metadataTypes": types})


def metadata_message(vehicle: ServiceContext) -> Any:
    """COMPONENT_METADATA: path and checksum of the general metadata."""
    return component_metadata(vehicle.boot_ms, checksum(general_metadata()), f"mftp://{GENERAL}")


def _json(value: dict[str, Any]) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode()


@cache
def _compressed(content: bytes) -> bytes:
    # CRC32 instead of xz's usual CRC64: the decoders of ground stations support no other
    return lzma.compress(content, check=lzma.CHECK_CRC32, preset=6)
