"""Who may use the page."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import pytest

from companion.dashboard.access import COOKIE, HEADER, Access, DashboardError, read_token
from companion.settings.key_files import is_loopback
from companion.settings.reading import ConfigurationError, load_settings

TOKEN = "0123456789abcdef0123456789abcdef"
LOCAL = Access("127.0.0.1")
OPEN = Access("0.0.0.0", TOKEN)
HOST = "127.0.0.1:8088"


def status(access: Access, method: str, path: str, headers: dict[str, str]) -> int:
    """The status of the error; 200 if there is none."""
    error = access.check(method, path, headers)
    return 200 if error is None else error.status


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8088", "localhost:8088", "localhost:9000", "127.0.0.1", "[::1]:8088"]
)
def test_addresses_of_this_computer_are_accepted(host: str) -> None:
    assert status(LOCAL, "GET", "/events", {"host": host}) == 200


@pytest.mark.parametrize(
    "host", ["", "evil.example:8088", "127.0.0.1.evil.example", "192.168.1.5:8088", "localhost.evil"]
)
def test_other_host_is_refused_on_loopback(host: str) -> None:
    for path in ("/", "/events", "/image", "/page.js"):
        assert status(LOCAL, "GET", path, {"host": host}) == 403


def test_beyond_loopback_addresses_and_own_name_are_accepted() -> None:
    for host in ("192.168.1.5:8088", "[fd00::1]:8088", f"{socket.gethostname()}.local:8088"):
        assert status(OPEN, "GET", "/", {"host": host}) == 200
    assert status(OPEN, "GET", "/", {"host": "evil.example:8088"}) == 403


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:9999", f"ftp://{HOST}"])
def test_other_origin_is_refused(origin: str) -> None:
    headers = {"host": HOST, "origin": origin, HEADER: "1"}
    assert status(LOCAL, "POST", "/command", headers) == 403
    assert status(LOCAL, "GET", "/events", headers) == 403


def test_names_of_a_proxy_are_accepted_as_host_and_origin() -> None:
    proxied = Access("127.0.0.1", TOKEN, hosts=("Drone.example.org", "lab.example:8443"))
    for host, origin, expected in (
        ("drone.example.org", "https://drone.example.org", 200),
        ("drone.example.org", "http://drone.example.org", 200),
        ("drone.example.org:9000", "http://drone.example.org:9000", 200),
        (HOST, "https://drone.example.org", 200),  # the proxy sends its own Host
        (HOST, "https://lab.example:8443", 200),
        (HOST, f"http://{HOST}", 200),
        (HOST, "https://drone.example.org:9000", 403),
        (HOST, "https://lab.example", 403),
        ("drone.example.org", "https://evil.example", 403),
        ("drone.example.org", "null", 403),
        ("evil.example", "https://drone.example.org", 403),
        ("drone.example.org.evil.example", None, 403),
        ("sub.drone.example.org", None, 403),
        ("", None, 403),
    ):
        headers = {"host": host, HEADER: "1"} | ({} if origin is None else {"origin": origin})
        assert status(proxied, "POST", "/command", headers) == expected, (host, origin)


@pytest.mark.parametrize(
    "host", ["https://drone.example.org", "drone.example.org/page", "*.example", "", "a b"]
)
def test_what_is_no_host_is_refused_in_the_settings(host: str) -> None:
    with pytest.raises(ConfigurationError, match=r"dashboard\.hosts: must be .* such as drone\.example\.org"):
        load_settings(None, {"dashboard.hosts": json.dumps([host])})


def test_hosts_may_have_a_port_or_be_addresses() -> None:
    hosts = ("drone.example.org", "lab:8443", "192.168.1.5", "[fd00::1]:8443")
    assert load_settings(None, {"dashboard.hosts": ",".join(hosts)}).dashboard.hosts == hosts


def test_proxy_needs_a_token() -> None:
    with pytest.raises(DashboardError, match=r"dashboard\.hosts .*\.token_file"):
        Access("127.0.0.1", hosts=("drone.example.org",))


def test_post_needs_the_header_that_other_pages_cannot_send() -> None:
    own = {"host": HOST, "origin": f"http://{HOST}", "sec-fetch-site": "same-origin"}
    assert status(LOCAL, "POST", "/command", own) == 403
    assert status(LOCAL, "POST", "/command", {**own, HEADER: "1"}) == 200


def test_another_page_may_only_link_to_the_page() -> None:
    other = {"host": HOST, "sec-fetch-site": "cross-site"}
    assert status(LOCAL, "GET", "/", {**other, "sec-fetch-mode": "navigate"}) == 200
    assert status(LOCAL, "GET", "/", {**other, "sec-fetch-mode": "no-cors"}) == 403
    assert status(LOCAL, "GET", "/image", {**other, "sec-fetch-mode": "navigate"}) == 403


def test_token_is_needed_beyond_loopback() -> None:
    for host in ("0.0.0.0", "192.168.1.5", "drone.local", "::"):
        with pytest.raises(DashboardError, match=rf"{host} .*\.token_file"):
            Access(host)
    assert is_loopback("127.0.0.1")
    assert is_loopback("localhost")


def test_token_is_given_as_bearer_or_cookie() -> None:
    assert LOCAL.admits({})
    for headers, admitted in (
        ({}, False),
        ({"authorization": f"Bearer {TOKEN}"}, True),
        ({"authorization": f"bearer  {TOKEN}"}, True),
        ({"authorization": f"Bearer {TOKEN}x"}, False),
        ({"authorization": f"Basic {TOKEN}"}, False),
        ({"authorization": "Bearer schl\xfcssel"}, False),
        ({"cookie": f"other=1; {COOKIE}={OPEN.cookie}"}, True),
        ({"cookie": f"{COOKIE}={TOKEN}"}, False),
        ({"cookie": f"{COOKIE}={Access('0.0.0.0', 'x' * 32).cookie}"}, False),
        ({"cookie": "=;;=,"}, False),
    ):
        assert OPEN.admits(headers) is admitted, headers


def test_token_file(tmp_path: Path) -> None:
    path = tmp_path / "token"
    for content, mode, named in (
        (TOKEN, 0o644, "chmod 600"),
        ("short", 0o600, "at least 16"),
        ("two words that are long enough", 0o600, "without spaces"),
        ("schlüssel" * 4, 0o600, "ASCII"),
        ("x" * 5000, 0o600, "one line"),
        ("", 0o600, "at least 16"),
    ):
        path.write_text(content)
        path.chmod(mode)
        with pytest.raises(DashboardError, match=named) as refused:
            read_token(path)
        assert len(content) < 16 or content not in str(refused.value)
    path.write_text(f"{TOKEN}\n")
    assert read_token(path) == TOKEN
    with pytest.raises(DashboardError, match="/none: cannot "):
        read_token(tmp_path / "none")
