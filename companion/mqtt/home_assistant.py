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

    def sensor(key: str, name: str, platform: str = "sensor", **more: Any) -> dict[str, Any]:
        template = f"{{{{ value_json.{key} }}}}"
        return entity(platform, key, name, state_topic=state, value_template=template, **more)

    def flag(key: str, name: str, **more: Any) -> dict[str, Any]:
        return sensor(key, name, "binary_sensor", payload_on="True", payload_off="False", **more)

    def measure(key: str, name: str, unit: str, **more: Any) -> dict[str, Any]:
        return sensor(key, name, unit_of_measurement=unit, state_class="measurement", **more)

    entities = {
        "problem": flag("problem", "Problem", device_class="problem"),
        "connected": flag("connected", "Autopilot", device_class="connectivity"),
        "armed": flag("armed", "Armed"),
        "mode": sensor("mode", "Mode"),
        "behaviour": sensor("behaviour", "Behaviour"),
        "battery": measure("battery_percent", "Battery", "%", device_class="battery"),
        "altitude": measure("altitude_m", "Altitude", "m", device_class="distance"),
        "objects": measure("objects", "Objects", "objects"),
        "place": entity("device_tracker", "place", "Place", json_attributes_topic=f"{base}/place"),
        # Without a template: it takes `event_type`, and has the rest as attributes.
        "event": entity("event", "event", "Object", state_topic=f"{base}/objects", event_types=EVENT_KINDS),
    }
    for camera in cameras:
        path, name = snapshot_path(camera), "Snapshot" if camera is None else f"Snapshot {camera}"
        key = path.replace("/", "_")
        entities[key] = entity("camera", key, name, topic=f"{base}/{path}")
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
