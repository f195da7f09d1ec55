"""Why a node that is there refuses a connection: zenoh's own error says only that it could not connect.

The TLS handshake is repeated with Python's `ssl` and the files of zenoh's configuration.
"""

from __future__ import annotations

import json
import socket
import ssl
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import zenoh

_PROBE_S = 1.0
_TLS = "transport/link/tls"
_USER = "transport/auth/usrpwd"
# X509_V_ERR_… of OpenSSL.
_WRONG_TIME = (9, 10)
_WRONG_NAME = (62, 64)


class _Endpoint(NamedTuple):
    text: str
    protocol: str
    address: str
    host: str
    port: int


def connection_fault(config: zenoh.Config) -> str | None:
    """Return one line on why the first endpoint of `connect` that answers refuses; None: none answers.

    Args:
        config: of the client that could not connect.
    """
    endpoints = json.loads(config.get_json("connect/endpoints"))
    tls, user = json.loads(config.get_json(_TLS)), json.loads(config.get_json(_USER))
    for text in endpoints if isinstance(endpoints, list) else []:
        endpoint = _parsed(text)
        if endpoint is not None and (fault := _fault(endpoint, tls, user["user"])) is not None:
            return f"no connection to {endpoint.text}: {fault}"
    return None


def _parsed(text: Any) -> _Endpoint | None:
    """None: not an address of TCP or TLS, or one with a configuration of its own."""
    if not isinstance(text, str) or "#" in text:
        return None
    protocol, _, address = text.partition("?")[0].partition("/")
    host, _, port = address.rpartition(":")
    if protocol not in ("tcp", "tls") or not port.isdecimal() or int(port) > 65535:
        return None
    return _Endpoint(text, protocol, address, host.strip("[]"), int(port))


def _fault(endpoint: _Endpoint, tls: Mapping[str, Any], user: str | None) -> str | None:
    try:
        with socket.create_connection((endpoint.host, endpoint.port), timeout=_PROBE_S) as connection:
            if endpoint.protocol == "tls":
                fault = _tls_fault(connection, endpoint, tls)
                if fault is not None:
                    return fault
            elif _speaks_tls(connection):
                return (
                    f"it needs TLS: set --connect to tls/{endpoint.address}, and root_ca_certificate in "
                    f"{_TLS} of zenoh.config_file"
                )
    except OSError:
        return None
    who = "no user is set" if user is None else f"user {user!r} or the password may be wrong"
    return (
        f"it opens no zenoh session. If it wants a user and a password: {who}, check {_USER} of "
        "zenoh.config_file. Else it may be another program, or a service that hangs"
    )


def _tls_fault(connection: socket.socket, endpoint: _Endpoint, tls: Mapping[str, Any]) -> str | None:
    """Return why the TLS handshake as zenoh makes it fails; None: it does not, or is not understood."""
    where, no_tls = f"{_TLS} of zenoh.config_file", f"it has no TLS: set --connect to tcp/{endpoint.address}"
    if any(tls.get(f"{key}_base64") for key in ("root_ca_certificate", "connect_certificate")):
        return None
    authority, sent = tls["root_ca_certificate"], None
    context = ssl.create_default_context()
    try:
        if authority is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
            context.load_verify_locations(authority)
        context.check_hostname = tls["verify_name_on_connect"] is not False
        if tls["enable_mtls"] and tls["connect_certificate"] and tls["connect_private_key"]:
            sent = tls["connect_certificate"]
            # An encrypted key would be asked for on the terminal.
            context.load_cert_chain(sent, tls["connect_private_key"], password="")
    except (OSError, ValueError) as error:  # ssl.SSLError is one
        files = [authority, tls["connect_certificate"], tls["connect_private_key"]]
        named = ", ".join(file for file in files if file)
        return f"a file of {where} cannot be used ({named}): {error}"
    try:
        with (
            context.wrap_socket(connection, server_hostname=endpoint.host) as secured,
            suppress(TimeoutError),
        ):
            secured.recv(1)  # the answer to the client's certificate comes after the handshake of TLS 1.3
    except ssl.SSLCertVerificationError as error:
        if error.verify_code in _WRONG_NAME:
            return (
                f"its certificate is for other names ({error.verify_message}): set --connect to a name or "
                "address in the certificate's subjectAltName"
            )
        if error.verify_code in _WRONG_TIME:
            return (
                f"its certificate is not valid now ({error.verify_message}): check both clocks, or renew it"
            )
        return (
            f"its certificate is not trusted ({error.verify_message}): check root_ca_certificate "
            f"({authority or 'not set'}) in {where}"
        )
    except ssl.SSLError as error:
        if "ALERT" not in (error.reason or ""):
            return no_tls
        if sent is None:
            return (
                "it requires a client certificate, and none is set: enable_mtls, connect_certificate and "
                f"connect_private_key in {where}"
            )
        return f"it refuses the certificate {sent} ({error.reason}): check connect_certificate in {where}"
    except (TimeoutError, ConnectionError):
        return no_tls
    return None


def _speaks_tls(connection: socket.socket) -> bool:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        context.wrap_socket(connection).close()
    except ssl.SSLError as error:
        return "ALERT" in (error.reason or "")
    except OSError:
        return False
    return True
