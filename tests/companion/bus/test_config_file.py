"""`zenoh.config_file`: its keys win over defaults, and clash with settings that were given."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from companion.bus.client import client_settings
from companion.bus.session import BusError, zenoh_config
from companion.settings import ZenohSection


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "zenoh.json5"
    tls = '{link: {tls: {root_ca_certificate: "ca.pem"}}}'
    path.write_text(f'{{listen: {{endpoints: ["tcp/127.0.0.1:7999"]}}, transport: {tls}}}')
    return path


def value(settings: ZenohSection, key: str) -> object:
    return json.loads(zenoh_config(settings).get_json(key))


def test_keys_of_the_file_replace_defaults(file: Path) -> None:
    settings = ZenohSection(config_file=str(file))
    assert value(settings, "listen/endpoints") == ["tcp/127.0.0.1:7999"]
    assert value(settings, "transport/link/tls/root_ca_certificate") == "ca.pem"
    # What the file leaves out is as without it.
    for key in ("mode", "connect/endpoints", "scouting/multicast/enabled", "timestamping/enabled"):
        assert value(settings, key) == value(ZenohSection(), key)


def test_queues_of_express_messages_are_ours_unless_the_file_has_them(tmp_path: Path) -> None:
    path, sizes = tmp_path / "zenoh.json5", "transport/link/tx/queue/size"
    path.write_text("{transport: {link: {tx: {queue: {size: {real_time: 4}}}}}}")
    found = value(ZenohSection(), f"{sizes}/real_time"), value(ZenohSection(), f"{sizes}/data_high")
    assert found == (16, 16)
    settings = ZenohSection(config_file=str(path))
    assert (value(settings, f"{sizes}/real_time"), value(settings, f"{sizes}/data_high")) == (4, 16)


def test_given_setting_that_differs_is_an_error(file: Path) -> None:
    given = ZenohSection(listen=("tcp/127.0.0.1:7447",), config_file=str(file))
    with pytest.raises(BusError, match=r"zenoh\.listen .*7447.*endpoints .*7999") as error:
        zenoh_config(given)
    assert str(file) in str(error.value)
    same = ZenohSection(listen=("tcp/127.0.0.1:7999",), config_file=str(file))
    assert value(same, "listen/endpoints") == ["tcp/127.0.0.1:7999"]


def test_tools_connect_as_clients_with_the_same_file(file: Path) -> None:
    client = client_settings(ZenohSection(config_file=str(file)), ("tcp/127.0.0.1:7999",))
    assert value(client, "mode") == "client"
    assert value(client, "listen/endpoints") == []
    assert value(client, "connect/endpoints") == ["tcp/127.0.0.1:7999"]
    assert value(client, "transport/link/tls/root_ca_certificate") == "ca.pem"


@pytest.mark.parametrize("text", ["{moode: 1}", "{", None], ids=["unknown key", "syntax", "missing"])
def test_bad_file_is_an_error_that_names_it(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "bad.json5"
    if text is not None:
        path.write_text(text)
    with pytest.raises(BusError, match=r"config_file .*bad\.") as error:
        zenoh_config(ZenohSection(config_file=str(path)))
    assert "\n" not in str(error.value)
