"""Download of a model from a local server: interrupted, resumed, refused, forged, unreachable."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from typer.testing import CliRunner

from companion.cli import app
from companion.cli.download import model_after_pull
from companion.cli.flags import EXIT_BAD_INPUT
from companion.host.passing import EXIT_PASSING
from vision.catalog import CAMERA_MODEL, KNOWN, KnownModel, known_by_digest
from vision.model_download import PullError, at_address, pull
from vision.weights import DEFAULT_EXPORT
from vision.yolo.checkpoint_pair import file_sha256

IMAGE = str(Path(__file__).parents[3] / "docs/images/demo.png")
CONTENT = bytes(range(256)) * 2000
DIGEST = hashlib.sha256(CONTENT).hexdigest()


@dataclass
class Server:
    """State of the server; `breaks` are the bytes after which each next response stops."""

    url: str = ""
    content: bytes = CONTENT
    ranges: bool = True
    breaks: list[int] = field(default_factory=list)
    requests: list[str | None] = field(default_factory=list)


@pytest.fixture
def server() -> Iterator[Server]:
    state = Server()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            byte_range = self.headers.get("Range")
            state.requests.append(byte_range)
            if not self.path.endswith("/model.pt"):
                self.send_error(404)
                return
            start = int(byte_range.removeprefix("bytes=").rstrip("-")) if byte_range and state.ranges else 0
            if start >= len(state.content):
                self.send_error(416)
                return
            rest = state.content[start:]
            self.send_response(206 if start else 200)
            if start:
                size = len(state.content)
                self.send_header("Content-Range", f"bytes {start}-{size - 1}/{size}")
            self.send_header("Content-Length", str(len(rest)))
            self.end_headers()
            if state.breaks:
                rest = rest[: state.breaks.pop(0)]
                self.close_connection = True
            self.wfile.write(rest)

        def log_message(self, *_: object) -> None:
            pass

    listening = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=listening.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    state.url = f"http://127.0.0.1:{listening.server_port}/model.pt"
    yield state
    listening.shutdown()
    listening.server_close()
    thread.join()


def official(server: Server, *, size: int = len(CONTENT)) -> KnownModel:
    return KnownModel("model", server.url, size, DIGEST, "AGPL-3.0", "a test")


def test_model_is_downloaded_once(tmp_path: Path, server: Server) -> None:
    progress: list[tuple[int, int | None]] = []
    pulled = pull(
        official(server), tmp_path / "new", progress=lambda done, total: progress.append((done, total))
    )
    assert pulled.path.read_bytes() == CONTENT
    assert pulled.sha256 == DIGEST
    assert pulled.fetched
    assert progress[0] == (0, len(CONTENT))
    assert progress[-1] == (len(CONTENT), len(CONTENT))
    again = pull(official(server), tmp_path / "new")
    assert not again.fetched
    assert len(server.requests) == 1
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["model.pt"]


def test_interrupted_connection_is_resumed(tmp_path: Path, server: Server) -> None:
    server.breaks = [100_000, 1, 200_000]
    assert pull(official(server), tmp_path).path.read_bytes() == CONTENT
    assert server.requests == [None, "bytes=100000-", "bytes=100001-", "bytes=300001-"]


def test_interrupted_download_resumes_in_next_run(tmp_path: Path, server: Server) -> None:
    server.breaks = [100_000, 0]
    with pytest.raises(PullError, match="100000 of 512000 bytes"):
        pull(official(server), tmp_path)
    assert (tmp_path / "model.pt.partial").stat().st_size == 100_000
    assert pull(official(server), tmp_path).fetched
    assert server.requests[-1] == "bytes=100000-"


def test_server_without_ranges_sends_whole_file(tmp_path: Path, server: Server) -> None:
    server.ranges, server.breaks = False, [100_000]
    assert pull(official(server), tmp_path).path.read_bytes() == CONTENT


def test_file_with_wrong_digest_is_deleted(tmp_path: Path, server: Server) -> None:
    server.content = bytes(len(CONTENT))
    with pytest.raises(PullError, match=f"expected {DIGEST}"):
        pull(official(server), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_file_of_wrong_size_is_not_downloaded(tmp_path: Path, server: Server) -> None:
    server.content = CONTENT + b"more"
    with pytest.raises(PullError, match="512004 bytes, expected 512000"):
        pull(official(server), tmp_path)


def test_partial_of_another_file_is_replaced(tmp_path: Path, server: Server) -> None:
    (tmp_path / "model.pt.partial").write_bytes(bytes(600_000))
    assert pull(official(server), tmp_path).path.read_bytes() == CONTENT


@pytest.mark.parametrize("kind", ["symlink", "dangling", "hard link", "folder link"])
def test_link_in_the_models_folder_is_not_followed(tmp_path: Path, server: Server, kind: str) -> None:
    folder, victim = tmp_path / "models", tmp_path / "victim"
    folder.mkdir()
    model = official(server)
    partial = folder / f"{model.file}.partial"
    if kind != "dangling":
        victim.write_bytes(b"mine")
    (partial.hardlink_to if kind == "hard link" else partial.symlink_to)(victim)
    if kind == "folder link":
        (folder / model.file).symlink_to(tmp_path / "nowhere")
    pulled = pull(model, folder)
    assert pulled.path.read_bytes() == CONTENT
    assert not pulled.path.is_symlink()
    assert not partial.exists()
    assert not (tmp_path / "nowhere").exists()
    assert (victim.read_bytes() if victim.exists() else None) == (None if kind == "dangling" else b"mine")


def test_missing_file_gives_manual_instructions(tmp_path: Path, server: Server) -> None:
    with pytest.raises(PullError, match=f"404.*{tmp_path}/model.pt.*{DIGEST}.*512000"):
        pull(at_address(official(server), server.url.replace("model.pt", "gone.pt")), tmp_path)


def test_unreachable_server_gives_manual_instructions(tmp_path: Path, server: Server) -> None:
    # A closed port.
    unreachable = at_address(official(server), "http://127.0.0.1:9/model.pt")
    with pytest.raises(PullError, match=rf"127\.0\.0\.1.*{tmp_path}/model.pt.*{DIGEST}"):
        pull(unreachable, tmp_path)


def test_manually_copied_file_is_verified(tmp_path: Path, server: Server) -> None:
    (tmp_path / "model.pt").write_bytes(CONTENT)
    assert not pull(official(server), tmp_path).fetched
    (tmp_path / "model.pt").write_bytes(b"forged")
    with pytest.raises(PullError, match=f"expected {DIGEST}: .*Move "):
        pull(official(server), tmp_path)


@pytest.mark.parametrize("url", ["file:///etc/passwd", "ftp://127.0.0.1/model.pt"])
def test_only_http_and_https_are_allowed(tmp_path: Path, server: Server, url: str) -> None:
    with pytest.raises(PullError, match=f"{url}: .*https address"):
        pull(at_address(official(server), url), tmp_path)


def test_failed_pull_is_one_line_with_instructions(tmp_path: Path) -> None:
    result = CliRunner().invoke(
        app,
        ["models", "pull", "yolov8n", "--folder", str(tmp_path), "--url", "http://127.0.0.1:9/yolov8n.pt"],
    )
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert "127.0.0.1" in line
    assert KNOWN["yolov8n"].sha256 in line
    result = CliRunner().invoke(app, ["models", "pull", "yolov8q"])
    assert result.exit_code == 2
    assert "yolov8n" in result.stderr


def test_every_model_has_unique_digest_and_official_url() -> None:
    assert len({model.sha256 for model in KNOWN.values()}) == len(KNOWN) == 28
    releases = {
        "AGPL-3.0": "https://github.com/ultralytics/assets/releases/download/v8.4.0",
        "Apache-2.0": "https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0",
    }
    for model in KNOWN.values():
        assert model.url == f"{releases[model.licence]}/{model.file}"
        assert model.file == f"{model.name}{'.onnx' if model.licence == 'Apache-2.0' else '.pt'}"
        assert len(bytes.fromhex(model.sha256)) == 32
        assert model.size_bytes > 3_000_000
    assert known_by_digest(KNOWN["yolo11n"].sha256) is KNOWN["yolo11n"]


def test_pull_of_a_command_downloads_once_and_uses_the_model(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COMPANION_MODELS_FOLDER", str(tmp_path))
    server.content = DEFAULT_EXPORT.read_bytes()
    known = replace(KNOWN[CAMERA_MODEL], size_bytes=len(server.content), sha256=file_sha256(DEFAULT_EXPORT))
    monkeypatch.setitem(KNOWN, CAMERA_MODEL, at_address(known, server.url))
    noted: list[bool] = []  # of the licence
    for _ in range(2):
        result = CliRunner().invoke(app, ["detect", IMAGE, "--pull", "--json"])
        assert result.exit_code == 0, result.output
        (line,) = result.stdout.splitlines()
        assert json.loads(line)["detections"]
        noted.append("Megvii" in result.stderr)
    assert (server.requests, noted) == ([None], [True, False])
    assert [path.name for path in tmp_path.iterdir()] == [f"{CAMERA_MODEL}.onnx"]


@pytest.mark.parametrize(
    ("model", "sources", "used", "downloaded"),
    [
        ("default", ["shm://front"], "default", []),
        ("default", ["shm://front", "/dev/video0"], CAMERA_MODEL, [CAMERA_MODEL]),
        ("yolo11n", ["shm://front"], "yolo11n", ["yolo11n"]),
        ("yolo11n", ["video.mp4"], "yolo11n", ["yolo11n"]),
        (str(DEFAULT_EXPORT), ["video.mp4"], str(DEFAULT_EXPORT), []),
    ],
)
def test_pull_chooses_the_model_by_the_sources(
    model: str,
    sources: list[str],
    used: str,
    downloaded: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COMPANION_MODELS_FOLDER", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "video.mp4").touch()
    pulled: list[str] = []
    monkeypatch.setattr("companion.cli.download.pull_named", lambda name, **_: pulled.append(name))
    assert (model_after_pull(model, sources), pulled) == (used, downloaded)


def test_pull_without_network_may_succeed_at_another_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COMPANION_MODELS_FOLDER", str(tmp_path))
    monkeypatch.setitem(KNOWN, CAMERA_MODEL, at_address(KNOWN[CAMERA_MODEL], "http://127.0.0.1:1/model.pt"))
    for command in (["detect", IMAGE], ["view", IMAGE], ["run", "--source", IMAGE]):
        assert CliRunner().invoke(app, [*command, "--pull"]).exit_code == EXIT_PASSING
    assert CliRunner().invoke(app, ["models", "pull", CAMERA_MODEL]).exit_code == EXIT_BAD_INPUT


@pytest.mark.parametrize("command", [["detect"], ["view"], ["run", "--source"]])
def test_nothing_is_pulled_for_a_file_that_is_not_there(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, server: Server
) -> None:
    monkeypatch.setenv("COMPANION_MODELS_FOLDER", str(tmp_path))
    monkeypatch.setitem(KNOWN, CAMERA_MODEL, at_address(KNOWN[CAMERA_MODEL], server.url))
    result = CliRunner().invoke(app, [*command, str(tmp_path / "vidoe.mp4"), "--pull"])
    assert (result.exit_code, server.requests) == (EXIT_BAD_INPUT, [])
    assert "vidoe.mp4" in result.stderr
