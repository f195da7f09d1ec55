"""No secret of an address is in a text that leaves the program, whatever is around the address."""

from __future__ import annotations

import json
import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.redaction import redacted, without_password
from vision.sources import SourceError, SourceSettings, open_source
from vision.sources.opening import check_address

# Long enough not to be in the rest of an address by chance; capitals are not in it.
inner = st.text(string.ascii_uppercase + string.digits, min_size=4, max_size=12)


def secrets(marks: str) -> st.SearchStrategy[tuple[str, ...]]:
    """Parts of a secret, between which marks stand."""
    return st.lists(inner, min_size=1, max_size=3).flatmap(
        lambda parts: st.sampled_from(marks).map(lambda mark: (mark, *parts))
    )


KEYS = ["password", "pwd", "passwd", "pass", "token", "access_token", "api_key", "key", "secret"]
KEYS += ["auth", "signature", "sig", "X-Amz-Signature", "Password", "loginpas"]
FORMS = (
    "rtsp://admin:{}@10.0.0.5:554/stream",
    "rtsps://:{}@camera/1",
    "http://me:{}@camera/v.mjpg?size=640",
    "tcp/me:{}@10.0.0.7:7447",
    "tls/me:{}@router.example:7447#ca=/etc/ca.pem",
    "mqtt://me:{}@broker",
)
QUERIES = (
    "http://camera:8080/v.mjpg?user=admin&{key}={}",
    "http://camera/v.mjpg?{key}={}&user=admin",
    "rtsp://camera/user=admin_{key}={}_channel=1.sdp",
    "rtsp://camera/user=admin&{key}={}&channel=1",
    "https://camera/v#{key}={}",
    "https://server/v1?api-version=2&{key}={}",
)
TEXTS = (
    "{}",
    "lost: {}: no data for 5 s; reopening",
    "source {} ({}), and then http://host/x",
    "'{}' is not there, {}.",
    "Traceback\n  File x\nValueError: {}\n",
)


def texts_of(uri: str) -> list[str]:
    plain = [text.replace("{}", uri) for text in TEXTS]
    return [*plain, json.dumps({"text": plain[1], "uris": [uri, uri]}), repr(plain[3])]


@given(secrets("#/?@:!$'()*+,;=&%\\[]_-."), st.sampled_from(FORMS))
def test_passwords_of_users_are_in_no_text(secret: tuple[str, ...], form: str) -> None:
    mark, *parts = secret
    for text in texts_of(form.format(mark.join(parts))):
        assert not any(part in redacted(text) for part in parts)
    assert form.partition("@")[2].split("?")[0] in redacted(form.format(mark.join(parts)))


@given(secrets("/?:!$'()*+,;=%.-@"), st.sampled_from(QUERIES), st.sampled_from(KEYS))
def test_secrets_of_parameters_are_in_no_text(secret: tuple[str, ...], form: str, key: str) -> None:
    mark, *parts = secret
    uri = form.replace("{key}", key).replace("{}", mark.join(parts))
    for text in texts_of(uri):
        assert not any(part in redacted(text) for part in parts)


@given(secrets(' "<>`{}|^\n#/?@'), st.sampled_from(FORMS[:3]))
def test_a_whole_address_hides_any_password(secret: tuple[str, ...], form: str) -> None:
    mark, *parts = secret
    shown = without_password(form.format(mark.join(parts)))
    assert not any(part in shown for part in parts)


@given(st.sampled_from([*FORMS, *(form.replace("{key}", "token") for form in QUERIES)]))
def test_what_is_redacted_stays_as_it_is(form: str) -> None:
    once = redacted(form.format("HIDDEN"))
    assert redacted(once) == once


@pytest.mark.parametrize(
    "text",
    [
        "serial:///dev/serial/by-id/usb-3D_Robotics:key=1@2:57600",
        "/data/token=3/user:me@home/flight.mcap",
        "file:///data/a:b@c.mp4",
        "photos/key=5.jpg: skipped",
        "udpin://0.0.0.0:14540: the autopilot now sends from 10.0.0.2:14550",
        "udp://:5600?format=rtp-h264&payload=96",
        "rtsp://user@camera/stream?channel=1&subtype=0",
        "shm://companion-1-vehicle1",
        "ros://camera/image_raw?depth=/camera/depth/image_raw&info=/camera/camera_info",
        "tcp/127.0.0.1:7447",
        "put them into the address: rtsp://USER:PASSWORD@10.0.0.5…",
        "vehicle.signing_key_file=/etc/companion/key",
    ],
)
def test_what_is_no_secret_is_not_changed(text: str) -> None:
    assert redacted(text) == text
    assert without_password(text) == text


@pytest.mark.parametrize("check", [check_address, open_source])
@pytest.mark.parametrize(
    ("uri", "remedy"),
    [
        ("rtsp://admin:HU#TER@127.0.0.1/x", "# as %23"),
        ("rtsp://admin:HU/TER@127.0.0.1/x", "/ as %2F"),
        ("rtsp://admin:HU?TER@127.0.0.1/x", "? as %3F"),
        ("http://admin:12#TER@127.0.0.1/x", "# as %23"),
        ("rtsp://admin:HUTER@127.0.0.1:nine/x", "PORT"),
        ("rtsp://admin:***@127.0.0.1/x", "removed"),
        ("rtsp://admin:HUTER@[::1/x", "HOST"),
    ],
)
def test_an_address_that_means_another_names_the_remedy(uri: str, remedy: str, check: object) -> None:
    assert callable(check)
    with pytest.raises(SourceError) as refused:
        check(uri, SourceSettings())
    text = str(refused.value)
    assert remedy in text
    assert text.startswith("rtsp://admin:***@" if uri.startswith("rtsp") else "http://admin:***@")
    assert "TER" not in text
    assert "\n" not in text


@pytest.mark.parametrize("check", [check_address, open_source])
@pytest.mark.parametrize("start", ["", "rtsp:", "rtsp:/", "http:/"])
@pytest.mark.parametrize("secret", ["HUTER", "HU/TER", "HU@TER", "HU#TER"])
def test_an_address_without_slashes_is_no_file_name(start: str, secret: str, check: object) -> None:
    assert callable(check)
    with pytest.raises(SourceError) as refused:
        check(f"{start}admin:{secret}@127.0.0.1:554/x", SourceSettings())
    text = str(refused.value)
    assert text.startswith("***@127.0.0.1:554/x: ")
    assert "rtsp://USER" in text
    assert "TER" not in text
