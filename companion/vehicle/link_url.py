"""Where the autopilot is: `udpin://HOST:PORT`, `udpout://HOST:PORT`, `tcp://HOST:PORT`, `serial:///dev/X:BAUD`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum

from companion.vehicle.driver import LinkError

EXAMPLES = (
    "udpin://0.0.0.0:14540, udpout://10.0.0.2:14540, tcp://127.0.0.1:5760 or serial:///dev/ttyAMA0:921600"
)

_NETWORK = re.compile(
    r"(?P<scheme>udpin|udpout|tcp)://(?P<host>\[[0-9A-Fa-f:.%]+\]|[^/:\[\]\s]+):(?P<port>\d{1,5})/?"
)
_SERIAL = re.compile(r"serial://(?P<device>/[^\s:]+(?::[^\s:]+)*?):(?P<baud>\d{1,8})")


class LinkUrlError(LinkError, ValueError):
    """The text is no link url. Both a ValueError (of a setting) and a LinkError (of a connection)."""


class LinkScheme(StrEnum):
    """How the bytes travel."""

    UDP_IN = "udpin"  # listen; answer whoever sends the autopilot's heartbeats
    UDP_OUT = "udpout"  # send to a known address
    TCP = "tcp"  # connect to a listener
    SERIAL = "serial"  # 8N1, no flow control


@dataclass(frozen=True, slots=True)
class LinkUrl:
    """A parsed link url. `address` is host and port, or device path and baud rate."""

    scheme: LinkScheme
    address: tuple[str, int]

    def __str__(self) -> str:
        place, number = self.address
        if ":" in place and self.scheme is not LinkScheme.SERIAL:
            place = f"[{place}]"
        return f"{self.scheme}://{place}:{number}"


def parse_link_url(text: str) -> LinkUrl:
    """Read a link url.

    Raises:
        LinkUrlError: the text is none of the four shapes; the message names the fault and gives examples.
    """
    if match := _NETWORK.fullmatch(text):
        port = int(match["port"])
        if not 1 <= port <= 65535:
            raise LinkUrlError(f"link {text!r}: the port must be 1..65535, got {port}")
        return LinkUrl(LinkScheme(match["scheme"]), (match["host"].strip("[]"), port))
    if match := _SERIAL.fullmatch(text):
        if int(match["baud"]) == 0:
            raise LinkUrlError(f"link {text!r}: the baud rate must be above 0")
        return LinkUrl(LinkScheme.SERIAL, (match["device"], int(match["baud"])))
    scheme, separator, _ = text.partition("://")
    if separator and scheme in set(LinkScheme):
        shape = "serial:///dev/NAME:BAUD" if scheme == LinkScheme.SERIAL else f"{scheme}://HOST:PORT"
        raise LinkUrlError(f"link {text!r} is not of the shape {shape}; examples: {EXAMPLES}")
    if scheme == "udp" and separator:
        raise LinkUrlError(
            f"link {text!r}: say udpin:// to listen or udpout:// to send; examples: {EXAMPLES}"
        )
    raise LinkUrlError(f"link {text!r} is not a link url; examples: {EXAMPLES}")
