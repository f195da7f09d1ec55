"""Link urls: `udpin://HOST:PORT`, `udpout://HOST:PORT`, `tcp://HOST:PORT`, `serial:///dev/X:BAUD`, `none`."""

from __future__ import annotations

import re
import termios
from dataclasses import dataclass
from enum import StrEnum

from companion.settings.vehicle import NO_VEHICLE
from companion.vehicle.driver import LinkError

EXAMPLES = (
    "udpin://0.0.0.0:14540, udpout://10.0.0.2:14540, tcp://127.0.0.1:5760 or serial:///dev/ttyAMA0:921600"
)

_NETWORK = re.compile(
    r"(?P<scheme>udpin|udpout|tcp)://(?P<host>\[[0-9A-Fa-f:.%]+\]|[^/:\[\]\s]+):(?P<port>\d{1,5})/?"
)
_SERIAL = re.compile(r"serial://(?P<device>/[^\s:]+(?::[^\s:]+)*?):(?P<baud>\d{1,8})")


class LinkUrlError(LinkError, ValueError):
    """The text is not a link url. Both a ValueError (of a setting) and a LinkError (of a connection)."""


class LinkScheme(StrEnum):
    """The transport of a link."""

    UDP_IN = "udpin"  # listen; send to the source of the autopilot's heartbeats
    UDP_OUT = "udpout"  # send to a known address
    TCP = "tcp"  # connect to a listener
    SERIAL = "serial"  # 8N1, no flow control
    NONE = "none"  # there is no vehicle


@dataclass(frozen=True, slots=True)
class LinkUrl:
    """A parsed link url. `address` is host and port, or device path and baud rate."""

    scheme: LinkScheme
    address: tuple[str, int]

    def __str__(self) -> str:
        host, number = self.address
        if self.scheme is LinkScheme.NONE:
            return NO_VEHICLE
        if ":" in host and self.scheme is not LinkScheme.SERIAL:
            host = f"[{host}]"
        return f"{self.scheme}://{host}:{number}"


def parse_link_url(text: str) -> LinkUrl:
    """Parse a link url.

    Raises:
        LinkUrlError: the text has none of these forms; the message has the reason and examples.
    """
    if text == NO_VEHICLE:
        return LinkUrl(LinkScheme.NONE, ("", 0))
    if match := _NETWORK.fullmatch(text):
        port = int(match["port"])
        if not 1 <= port <= 65535:
            raise LinkUrlError(f"link {text!r}: the port must be 1..65535, got {port}")
        return LinkUrl(LinkScheme(match["scheme"]), (match["host"].strip("[]"), port))
    if match := _SERIAL.fullmatch(text):
        if not hasattr(termios, f"B{match['baud']}") or int(match["baud"]) == 0:
            rates = sorted(int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit())
            raise LinkUrlError(
                f"link {text!r}: baud rate {match['baud']} is not supported; supported: {rates[1:]}"
            )
        return LinkUrl(LinkScheme.SERIAL, (match["device"], int(match["baud"])))
    scheme, separator, _ = text.partition("://")
    if separator and scheme in set(LinkScheme) - {LinkScheme.NONE}:
        form = "serial:///dev/NAME:BAUD" if scheme == LinkScheme.SERIAL else f"{scheme}://HOST:PORT"
        raise LinkUrlError(f"link {text!r}: expected {form}; examples: {EXAMPLES}")
    if scheme == "udp" and separator:
        raise LinkUrlError(
            f"link {text!r}: use udpin:// to listen or udpout:// to send; examples: {EXAMPLES}"
        )
    raise LinkUrlError(f"link {text!r}: not a link url; examples: {EXAMPLES}")
