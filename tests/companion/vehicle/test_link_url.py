from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.vehicle.driver import LinkError
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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a link url"),
        ("14540", "not a link url"),
        ("/dev/ttyAMA0", "not a link url"),
        ("udp://:14540", "udpin:// .*udpout://"),
        ("udpin:127.0.0.1:14540", "not a link url"),
        ("udpin://14540", "udpin://HOST:PORT"),
        ("udpin://127.0.0.1", "udpin://HOST:PORT"),
        ("udpin://127.0.0.1:0", r"port .*1\.\.65535, got 0"),
        ("udpin://127.0.0.1:65536", r"port .*1\.\.65535, got 65536"),
        ("udpin://127.0.0.1:14540;rm", "udpin://HOST:PORT"),
        ("tcp://a b:1", "tcp://HOST:PORT"),
        ("serial://ttyAMA0:57600", "serial:///dev/NAME:BAUD"),
        ("serial:///dev/ttyAMA0", "serial:///dev/NAME:BAUD"),
        ("serial:///dev/ttyAMA0:0", "0 is not supported"),
        ("serial:///dev/ttyAMA0:12345", "12345 .*not supported; supported: .*57600"),
        ("none://", "not a link url"),
        ("http://127.0.0.1:80", "not a link url"),
    ],
)
def test_other_texts_are_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(LinkUrlError, match=message) as caught:
        parse_link_url(text)
    assert isinstance(caught.value, ValueError)
    assert isinstance(caught.value, LinkError)
    assert "\n" not in str(caught.value)


@given(st.text())
def test_parser_survives_any_text(text: str) -> None:
    try:
        url = parse_link_url(text)
    except LinkUrlError:
        return
    assert parse_link_url(str(url)) == url
