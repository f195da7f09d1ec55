"""Discovery of Home Assistant: what it makes of our topics.

One message announces the device and all its entities (`device` discovery, since 2024.12):
https://www.home-assistant.io/integrations/mqtt/#device-discovery-payload
"""

from __future__ import annotations

from typing import Any

EVENT_KINDS = ("new", "update", "lost", "end")


def discovery_topic(prefix: str, vehicle: str) -> str:
    """Return the topic of the announcement."""
    return f"{prefix}/device/companion_{_id(vehicle)}/config"


def discovery(vehicle: str, base: str, cameras: tuple[str | None, ...], version: str) -> dict[str, Any]:
    """Return the announcement of a vehicle.

    Args:
        base: of its topics. cameras: None is the first one.
    """
    state = f"{base}/state"

    def entity(platform: str, key: str, name: str, **more: Any) -> dict[str, Any]:
        return {"platform": platform, "unique_id": f"companion_{_id(vehicle)}_{key}", "name": name, **more}

    def value(platform: str, key: str, name: str, **more: Any) -> dict[str, Any]:
        template = f"{{{{ value_json.{key} }}}}"
        if platform == "binary_sensor":
            template = f"{{{{ 'ON' if value_json.{key} else 'OFF' }}}}"
        return entity(platform, key, name, state_topic=state, value_template=template, **more)

    def measure(key: str, name: str, unit: str, **more: Any) -> dict[str, Any]:
        return value("sensor", key, name, unit_of_measurement=unit, state_class="measurement", **more)

    entities = {
        "problem": value("binary_sensor", "problem", "Problem", device_class="problem"),
        "connected": value("binary_sensor", "connected", "Autopilot", device_class="connectivity"),
        "armed": value("binary_sensor", "armed", "Armed"),
        "mode": value("sensor", "mode", "Mode"),
        "behaviour": value("sensor", "behaviour", "Behaviour"),
        "battery": measure("battery_percent", "Battery", "%", device_class="battery"),
        "altitude": measure("altitude_m", "Altitude", "m", device_class="distance"),
        "objects": measure("objects", "Objects", "objects"),
        "place": entity("device_tracker", "place", "Place", json_attributes_topic=f"{base}/place"),
        "event": entity(
            "event",
            "event",
            "Object",
            state_topic=f"{base}/objects",
            event_types=list(EVENT_KINDS),
            # An event needs its type under this name, and has the rest as attributes.
            value_template="{{ {'event_type': value_json.event, **value_json} | tojson }}",
        ),
    }
    for camera in cameras:
        path = snapshot_path(camera)
        name = "Snapshot" if camera is None else f"Snapshot {camera}"
        entities[path.replace("/", "_")] = entity(
            "camera", path.replace("/", "_"), name, topic=f"{base}/{path}"
        )
    return {
        "device": {"identifiers": [f"companion_{_id(vehicle)}"], "name": vehicle, "model": "companion"},
        "origin": {"name": "companion", "sw_version": version},
        "availability_topic": f"{base}/available",
        "components": entities,
    }


def snapshot_path(camera: str | None) -> str:
    """Return the topic of a camera's snapshots, after the base."""
    return "snapshot" if camera is None else f"cameras/{camera}/snapshot"


def _id(vehicle: str) -> str:
    return vehicle.replace(".", "_")
