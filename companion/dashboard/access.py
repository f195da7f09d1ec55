"""Who may use the page: the token, and the checks against requests that other web pages cause.

A browser sends requests to any address on behalf of any page. Therefore every request needs a `Host` of ours
(DNS rebinding) and, where the browser says which page it comes from (`Origin`, `Sec-Fetch-Site`), our own; a
POST also needs a header that other pages cannot set. The names of a proxy are ours if they are listed.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import NamedTuple

from companion.settings import key_files
from companion.settings.key_files import KeyFileError, is_loopback

HEADER = "x-companion-dashboard"
"""A POST needs it, with any value: a page of another origin cannot send it without a CORS permission."""
COOKIE = "companion_dashboard"


class DashboardError(RuntimeError):
    """The page cannot be served. The message is one line."""


class ErrorResponse(NamedTuple):
    """An HTTP status and one line of text."""

    status: int
    text: str


def read_token(path: str | Path, name: str = "dashboard.token_file") -> str:
    """Read the token, as `key_files.read_token` does. Raises DashboardError."""
    try:
        return key_files.read_token(path, name)
    except KeyFileError as error:
        raise DashboardError(str(error)) from error


@dataclass(frozen=True)
class Access:
    """The rules of one server.

    Attributes:
        host: the address that it listens on. token: None: none is needed.
        page: it serves a page to browsers; without one, a program's POST needs no `HEADER`.
        hosts: names of a proxy before it, NAME or NAME:PORT as in a browser's address. The port of a `Host`
            is not compared, that of an `Origin` is.

    Raises:
        DashboardError: other computers can reach it, by `host` or by a proxy, and there is no token.
    """

    host: str
    token: str | None = None
    page: bool = True
    hosts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.token is None and not is_loopback(self.host):
            raise DashboardError(
                f"dashboard.listen {self.host} is open to other computers: dashboard.token_file must be set"
            )
        if self.token is None and self.hosts:
            raise DashboardError(
                f"dashboard.hosts {', '.join(self.hosts)}: a proxy opens the page to other computers: "
                "dashboard.token_file must be set"
            )

    @property
    def cookie(self) -> str:
        """The cookie's value. It is derived from the token, so it outlives a restart and not a new token."""
        return hmac.new((self.token or "").encode(), COOKIE.encode(), hashlib.sha256).hexdigest()

    def token_is(self, text: str) -> bool:
        """Whether a text is the token."""
        return self.token is not None and _equal(text, self.token)

    def check(self, method: str, path: str, headers: Mapping[str, str]) -> ErrorResponse | None:
        """Check everything but the token; None: the request is accepted.

        Args:
            headers: names in lower case.
        """
        host = headers.get("host", "")
        if not self._host_is_ours(host):
            hint = ": dashboard.hosts accepts the names of a proxy" if self.page else ""
            return ErrorResponse(403, f"Host {host!r} is not an address of this server{hint}")
        origin = headers.get("origin")
        own = {f"{way}://{name}" for way in ("http", "https") for name in (host, *map(str.lower, self.hosts))}
        if origin is not None and origin not in own:
            return ErrorResponse(403, f"Origin {origin!r} is another page")
        # Following a link to the page is harmless: it cannot be framed, and the link's page cannot read it.
        followed_link = method == "GET" and path == "/" and headers.get("sec-fetch-mode") == "navigate"
        if not followed_link and headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return ErrorResponse(403, "requested by another page")
        if self.page and method not in ("GET", "HEAD") and HEADER not in headers:
            return ErrorResponse(403, f"the header {HEADER} is missing")
        return None

    def admits(self, headers: Mapping[str, str]) -> bool:
        """Whether a request has the token (`Authorization: Bearer …`) or the cookie, or needs none."""
        if self.token is None:
            return True
        scheme, _, given = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer" and self.token_is(given.strip()):
            return True
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
        except CookieError:
            return False
        return cookie is not None and _equal(cookie.value, self.cookie)

    def _host_is_ours(self, header: str) -> bool:
        """Whether a `Host` is an address, or a name that no one else can point at this computer."""
        name = _without_port(header).lower()
        if name == self.host or name == "localhost":
            return bool(name)
        if name in (_without_port(host).lower() for host in self.hosts):
            return True
        if is_loopback(self.host):
            return is_loopback(name.strip("[]"))
        own = socket.gethostname().lower()
        return _address(name.strip("[]")) is not None or name in (own, f"{own}.local")


def _without_port(host: str) -> str:
    name, _, port = host.rpartition(":")
    return name if port.isdecimal() else host


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _equal(one: str, other: str) -> bool:
    """Compare in constant time."""
    return hmac.compare_digest(one.encode("utf-8", "surrogatepass"), other.encode())
