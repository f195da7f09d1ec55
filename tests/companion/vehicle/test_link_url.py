from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.vehicle.link_url import LinkScheme, LinkUrl, LinkUrlError, parse_link_url


@pytest.mark.parametrize(
    ("text", "scheme", "address"),
    [
        ("udpin://0.0.0.0:14540", LinkScheme.UDP_IN, ("0.0.0.0", 14540)),
        ("udpin://127.0.0.1:1", LinkScheme.UDP_IN, ("127.0.0.1", 1)),
        ("udpout://vehicle.local:14580", LinkScheme.UDP_OUT, ("vehicle.local", 14580)),
        ("udpin://[::1]:14540", LinkScheme.UDP_IN, ("::1", 14540)),
        ("none", LinkScheme.NONE, ("", 0)),
        ("tcp://localhost:5760/", LinkScheme.TCP, ("localhost", 5760)),
        ("serial:///dev/ttyAMA0:921600", LinkScheme.SERIAL, ("/dev/ttyAMA0", 921600)),
        (
            "serial:///dev/serial/by-path/platform-usb-0:1:1.0:57600",
            LinkScheme.SERIAL,
            ("/dev/serial/by-path/platform-usb-0:1:1.0", 57600),
        ),
    ],
)
def test_every_form_round_trips(text: str, scheme: LinkScheme, address: tuple[str, int]) -> None:
    url = parse_link_url(text)
    assert url == LinkUrl(scheme, address)
    assert parse_link_url(str(url)) == url


@given(st.text())
def test_parser_survives_any_text(text: str) -> None:
    try:
        url = parse_link_url(text)
    except LinkUrlError:
        return
    assert parse_link_url(str(url)) == url
