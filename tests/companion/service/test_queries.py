"""Replies to the queries besides `command`."""

from __future__ import annotations

import asyncio
import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from companion.bus.bodies.service import ModelsBody, PortParametersBody
from companion.bus.schema import schema_of
from companion.guidance.command import COMMANDS
from companion.perception.messages import Preview, Ready
from companion.service import Service, queries
from companion.service.queries import without_secrets
from companion.settings.reading import load_settings
from companion.vehicle.driver import Driver
from companion.vehicle.state import VehicleState
from tests.companion.bus.message_check import check_message, closed

SECRET = "rtsp://admin:hunter2@10.0.0.5/stream?token=4711"


def service_of(**flags: str) -> Service:
    return Service(load_settings(os.devnull, {key.replace("__", "."): flags[key] for key in flags}, {}))


async def reply(service: Service, path: str) -> Any:
    return await service._queries.handlers(service.cameras)[path]()


async def test_config_has_every_setting_and_no_secret(tmp_path: Path) -> None:
    key_file = tmp_path / "signing.key"
    key_file.touch(mode=0o600)
    key_file.write_text("a passphrase")
    service = service_of(source__uri=SECRET, vehicle__signing_key_file=str(key_file))
    config = await reply(service, "config")
    text = json.dumps(config)
    assert config["source"]["uri"] == "rtsp://***@10.0.0.5/stream?***"
    assert config["vehicle"]["signing_key_file"] == "***"
    assert "hunter2" not in text
    assert "4711" not in text
    assert "signing.key" not in text
    assert config["guidance"] == service.settings.guidance.model_dump(mode="json")


def test_only_credentials_are_replaced() -> None:
    plain = {"listen": ["tcp/127.0.0.1:7447"], "url": "udpin://127.0.0.1:14540", "signing_key_file": None}
    assert without_secrets(plain) == plain
    assert without_secrets(["http://user@host/"]) == ["http://***@host/"]


async def test_status_is_that_of_the_topic() -> None:
    check_message("status", await reply(service_of(), "status"))


async def test_commands_are_the_grammar() -> None:
    schema = await reply(service_of(), "commands")
    assert schema["$defs"].keys() == COMMANDS.keys()
    assert schema["$defs"]["takeoff"]["properties"]


async def test_models_in_use_have_digest_and_classes() -> None:
    service = service_of()
    validator = Draft202012Validator(closed(schema_of(ModelsBody)))
    before = await reply(service, "models")
    validator.validate(before)
    assert before["loaded"] == []
    ready = Ready("a.mp4", "yolo11n", ("car",), "float32", "torch", model_sha256="ab" * 32)
    service.perception._ready = ready
    after = await reply(service, "models")
    validator.validate(after)
    (model,) = after["loaded"]
    assert (model["camera"], model["model"], model["model_sha256"]) == (None, "yolo11n", "ab" * 32)
    assert (model["class_names"], model["running"]) == (["car"], False)


async def test_image_is_the_next_one_and_wanted_until_then() -> None:
    service = service_of()
    (camera,) = service.cameras
    assert not service._queries.image_wanted(camera)
    asked = [asyncio.create_task(reply(service, "image")) for _ in range(2)]
    await asyncio.sleep(0)
    assert service._queries.image_wanted(camera)
    service._publisher.publish_preview(camera, Preview(7, 1_000, b"jpeg"))
    assert await asyncio.gather(*asked) == [b"jpeg", b"jpeg"]
    assert not service._queries.image_wanted(camera)


async def test_image_of_a_stopped_camera_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.service.queries.IMAGE_TIMEOUT_S", 0.05)
    service = service_of()
    with pytest.raises(TimeoutError, match="stopped"):
        await reply(service, "image")
    assert not service._queries.image_wanted(service.cameras[0])


async def test_ports_are_read_once_for_each_connection_on_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    service = service_of()
    validator = Draft202012Validator(closed(schema_of(PortParametersBody)))
    readings: list[int] = []

    async def read(driver: Driver) -> dict[str, float]:
        readings.append(driver.link_count)
        return {"MAV_1_CONFIG": 102.0}

    monkeypatch.setattr(queries, "read_port_parameters", read)
    silent = await reply(service, "port_parameters")
    validator.validate(silent)
    assert silent["not_read"]

    driver = SimpleNamespace(
        state=VehicleState(heartbeat_ns=1, autopilot="PX4", armed=True),
        link_count=1,
        watch=SimpleNamespace(now_ns=lambda: 2),
    )
    monkeypatch.setattr(service._queries, "_driver", driver)
    assert (await reply(service, "port_parameters"))["not_read"]
    assert not readings

    driver.state = replace(driver.state, armed=False)
    both = await asyncio.gather(reply(service, "port_parameters"), reply(service, "port_parameters"))
    assert both[0] == both[1] == {"parameters": {"MAV_1_CONFIG": 102.0}, "not_read": ""}
    driver.state = replace(driver.state, armed=True)
    assert await reply(service, "port_parameters") == both[0]
    driver.state, driver.link_count = replace(driver.state, armed=False), 2
    validator.validate(await reply(service, "port_parameters"))
    assert readings == [1, 2]
