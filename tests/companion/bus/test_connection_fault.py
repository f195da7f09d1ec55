"""Why a node that is there refuses a client, with real zenoh, TLS and users."""

from __future__ import annotations

import asyncio
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from companion.bus.client import NoAnswerError, client_settings, open_client
from companion.bus.connection_fault import connection_fault
from companion.bus.session import zenoh_config
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port
from tests.companion.bus.test_zenoh_security import make_certificates
from tests.companion.command_line import companion_here
from tests.companion.dashboard.serving import EventStream, serving

pytestmark = [pytest.mark.realtime, pytest.mark.needs("openssl")]

SERVICE = {
    "root_ca_certificate": "ca.pem",
    "listen_private_key": "vehicle1.key",
    "listen_certificate": "vehicle1.pem",
}
MUTUAL = {**SERVICE, "enable_mtls": True}
OPERATOR = {
    "root_ca_certificate": "ca.pem",
    "enable_mtls": True,
    "connect_private_key": "operator.key",
    "connect_certificate": "operator.pem",
}
UNKNOWN = {
    **OPERATOR,
    "connect_private_key": "other/operator.key",
    "connect_certificate": "other/operator.pem",
}
USERS = {"user": "vehicle1", "password": "x", "dictionary_file": "users"}


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The certificates of the page, and in `other` those of another authority."""
    folder = tmp_path_factory.mktemp("certificates")
    make_certificates(folder)
    (folder / "other").mkdir()
    make_certificates(folder / "other")
    (folder / "users").write_text("alpha:secret\n")
    return folder


@pytest.fixture(autouse=True)
def _in_folder(certificates: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(certificates)


def config_file(name: str, *, tls: Any = None, usrpwd: Any = None) -> str:
    transport = {"link": {"tls": tls or {}}, "auth": {"usrpwd": usrpwd or {}}}
    path = Path(f"{name}-{os.getpid()}.json5")
    path.write_text(json.dumps({"transport": transport}))
    return str(path)


@contextmanager
def node(protocol: str, **parts: Any) -> Iterator[str]:
    """A node of zenoh; yields its HOST:PORT."""
    address = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    section = ZenohSection(listen=(f"{protocol}/{address}",), config_file=config_file("service", **parts))
    session = zenoh.open(zenoh_config(section))
    try:
        yield address
    finally:
        session.close()  # type: ignore[no-untyped-call]


def client_of(endpoint: str, **parts: Any) -> ZenohSection:
    return client_settings(ZenohSection(config_file=config_file("client", **parts)), (endpoint,))


def tls(service: Any, client: Any, *named: str, host: str = "127.0.0.1", id: str) -> Any:
    return pytest.param(("tls", {"tls": service}), (f"tls/{host}", {"tls": client}), named, id=id)


def users(client: Any, *named: str, id: str) -> Any:
    return pytest.param(("tcp", {"usrpwd": USERS}), ("tcp/127.0.0.1", {"usrpwd": client}), named, id=id)


@pytest.mark.parametrize(
    ("service", "client", "named"),
    [
        tls(
            SERVICE,
            {"root_ca_certificate": "other/ca.pem"},
            "root_ca_certificate (other/ca.pem)",
            id="other authority",
        ),
        tls(
            SERVICE,
            {},
            "root_ca_certificate (not set) in transport/link/tls of zenoh.config_file",
            id="no authority",
        ),
        tls(
            MUTUAL,
            {"root_ca_certificate": "ca.pem"},
            "enable_mtls, connect_certificate",
            id="no client certificate",
        ),
        tls(
            MUTUAL,
            UNKNOWN,
            "other/operator.pem",
            "ALERT",
            "connect_certificate",
            id="foreign certificate",
        ),
        tls(SERVICE, OPERATOR, "'localhost'", "subjectAltName", host="localhost", id="other name"),
        tls(
            SERVICE, {**OPERATOR, "root_ca_certificate": "gone.pem"}, "gone.pem", "No such file", id="no file"
        ),
        pytest.param(
            ("tls", {"tls": SERVICE}),
            ("tcp/127.0.0.1", {}),
            ("needs TLS", "tls/127.0.0.1:", "root_ca_certificate"),
            id="client without TLS",
        ),
        users(
            {"user": "alpha", "password": "wrong"}, "'alpha'", "transport/auth/usrpwd", id="wrong password"
        ),
        users({"user": "beta", "password": "secret"}, "'beta'", "transport/auth/usrpwd", id="unknown user"),
        users({}, "no user is set", "transport/auth/usrpwd of zenoh.config_file", id="no user"),
    ],
)
def test_error_names_endpoint_reason_and_setting(
    service: tuple[str, Any], client: tuple[str, Any], named: tuple[str, ...]
) -> None:
    with node(service[0], **service[1]) as address:
        endpoint = f"{client[0]}:{address.rpartition(':')[2]}"
        with (
            pytest.raises(NoAnswerError) as refused,
            open_client(client_of(endpoint, **client[1]), timeout_s=0.0),
        ):
            pass
    text = str(refused.value)
    assert text.startswith(f"no connection to {endpoint}: ")
    assert not [name for name in named if name not in text], text
    assert "\n" not in text
    assert "is `companion run`" not in text
    assert "secret" not in text


def test_endpoint_without_tls_is_named() -> None:
    with node("tcp") as address:  # zenoh itself waits 10 s for it
        fault = connection_fault(zenoh_config(client_of(f"tls/{address}", tls=OPERATOR)))
    assert fault is not None
    assert fault.startswith(f"no connection to tls/{address}: ")
    assert f"tcp/{address}" in fault


def test_accepted_clients_connect() -> None:
    with node("tls", tls=MUTUAL) as address, open_client(client_of(f"tls/{address}", tls=OPERATOR)):
        pass
    known = {"user": "alpha", "password": "secret"}
    with node("tcp", usrpwd=USERS) as address, open_client(client_of(f"tcp/{address}", usrpwd=known)):
        pass


def test_where_nothing_listens_it_asks_for_the_service() -> None:
    endpoint = f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    settings = client_of(endpoint, tls=OPERATOR)
    assert connection_fault(zenoh_config(settings)) is None
    with pytest.raises(NoAnswerError, match="is `companion run`"), open_client(settings, timeout_s=0.0):
        pass


@pytest.mark.parametrize("command", [("send", "hold"), ("echo", "status"), ("ask", "stop")])
def test_commands_print_the_reason_in_one_line(command: tuple[str, ...], certificates: Path) -> None:
    with node("tls", tls=SERVICE) as address:
        done = companion_here(*command, "--connect", f"tcp/{address}", cwd=certificates)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"companion: no connection to tcp/{address}: ")


async def test_page_shows_the_reason() -> None:
    with node("tls", tls=SERVICE) as address:
        async with serving(f"tcp/{address}") as port, asyncio.timeout(30):
            stream = await EventStream.open(port)
            problem = ""
            while not problem.startswith(f"no connection to tcp/{address}: "):
                news = await stream.next()
                assert news is not None
                problem = news["problem"]
            stream.close()
