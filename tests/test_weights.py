"""Weights: found where they should be, downloaded whole or not at all, never silently of another kind."""

import hashlib
import http.server
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from swimm3r import weights
from swimm3r.errors import StorageError, UsageError, WeightsError
from swimm3r.weights import Weights, download

BODY = bytes(range(256)) * 4096  # 1 MiB


@dataclass
class Server:
    """A file server on this computer that can misbehave."""

    port: int = 0
    body: bytes = BODY
    tag: str = '"v1"'
    ranges: bool = True
    break_after: list[int] = field(default_factory=list)  # bytes of the next answers before the connection breaks
    requests: list[dict[str, str]] = field(default_factory=list)
    silent_seconds: float = 0.0
    chunked: bool = False  # no length is stated

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/file.bin"


@pytest.fixture
def server() -> Iterator[Server]:
    state = Server()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            state.requests.append(dict(self.headers))
            time.sleep(state.silent_seconds)
            start = 0
            wanted = self.headers.get("Range")
            if wanted and state.ranges and self.headers.get("If-Range", state.tag) == state.tag:
                start = int(wanted.removeprefix("bytes=").removesuffix("-"))
            if start and start >= len(state.body):
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{len(state.body)}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            self.send_response(206 if start else 200)
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(state.body) - 1}/{len(state.body)}")
            length = ("Transfer-Encoding", "chunked") if state.chunked else ("Content-Length", len(state.body) - start)
            self.send_header(length[0], str(length[1]))
            self.send_header("ETag", state.tag)
            self.end_headers()
            rest = state.body[start:]
            if state.chunked:
                self.wfile.write(f"{len(rest):x}\r\n".encode())
            if state.break_after:
                self.wfile.write(rest[: state.break_after.pop(0)])
                return
            self.wfile.write(rest)
            if state.chunked:
                self.wfile.write(b"\r\n0\r\n\r\n")

        def log_message(self, format: str, *args: object) -> None:
            pass

    running = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    state.port = running.server_port
    thread = threading.Thread(target=running.serve_forever, daemon=True)
    thread.start()
    yield state
    running.shutdown()
    running.server_close()


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("SWIMM3R_WEIGHTS_DIR", raising=False)
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    monkeypatch.setenv("SWIMM3R_CACHE", str(tmp_path / "cache"))
    for proxy in ("http_proxy", "https_proxy", "all_proxy"):
        monkeypatch.delenv(proxy, raising=False)
        monkeypatch.delenv(proxy.upper(), raising=False)
    return tmp_path / "cache" / "weights"


def manifest(url: str, **changes) -> tuple[Weights, ...]:
    plain = Weights(
        name="net",
        purpose="a test",
        filename="net.bin",
        urls=(url,),
        size=len(BODY),
        about_mb=1.05,
        sha256=hashlib.sha256(BODY).hexdigest(),
        license="free",
        license_url="http://example.invalid",
        non_commercial=False,
    )
    return (replace(plain, **changes),)


def test_download_arrives_whole_with_progress(server: Server, home: Path):
    seen = []
    path = weights.fetch("net", progress=lambda *call: seen.append(call), manifest=manifest(server.url))
    assert path == home / "net.bin"
    assert path.read_bytes() == BODY
    assert seen[-1] == ("net.bin", len(BODY), len(BODY))
    assert sorted(os.listdir(home)) == ["net.bin", "net.bin.lock"]


def test_download_is_made_once(server: Server, home: Path):
    for _ in range(2):
        weights.fetch("net", manifest=manifest(server.url))
    assert len(server.requests) == 1


def test_broken_connection_goes_on_where_it_stopped(server: Server, home: Path):
    server.break_after = [300_000, 200_000]
    path = weights.fetch("net", manifest=manifest(server.url))
    assert path.read_bytes() == BODY
    starts = [r.get("Range") for r in server.requests]
    assert starts == [None, "bytes=300000-", "bytes=500000-"]


def test_a_file_of_unknown_length_is_whole_only_where_the_server_ends_it(server: Server, home: Path):
    """As proxies send files on, in chunks: nothing but the last chunk says that one is whole."""
    server.chunked, server.break_after = True, [300_000]
    unknown = manifest(server.url, size=None, sha256=None)
    path = weights.fetch("net", manifest=unknown)
    assert path.read_bytes() == BODY
    assert [r.get("Range") for r in server.requests] == [None, "bytes=300000-"]


def test_interrupted_download_is_resumed_by_the_next_call(server: Server, home: Path):
    def interrupt(what: str, done: int, total: int) -> None:
        if done > 200_000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        weights.fetch("net", progress=interrupt, manifest=manifest(server.url))
    assert not (home / "net.bin").exists()
    have = (home / "net.bin.part").stat().st_size
    assert have > 0
    weights.fetch("net", manifest=manifest(server.url))
    assert server.requests[1]["Range"] == f"bytes={have}-"
    assert (home / "net.bin").read_bytes() == BODY


def test_part_of_another_version_is_not_continued(server: Server, home: Path):
    def interrupt(what: str, done: int, total: int) -> None:
        if done > 200_000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        weights.fetch("net", progress=interrupt, manifest=manifest(server.url, sha256=None))
    server.body, server.tag = BODY[::-1], '"v2"'
    assert weights.fetch("net", manifest=manifest(server.url, sha256=None)).read_bytes() == BODY[::-1]


def test_server_without_ranges_starts_over(server: Server, home: Path):
    server.ranges = False
    server.break_after = [300_000]
    assert weights.fetch("net", manifest=manifest(server.url)).read_bytes() == BODY


def test_part_that_was_already_whole_is_taken(server: Server, home: Path, monkeypatch: pytest.MonkeyPatch):
    whole = manifest(server.url)
    monkeypatch.setattr(download, "compare", lambda *a: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        weights.fetch("net", manifest=whole)
    monkeypatch.undo()
    monkeypatch.setenv("SWIMM3R_CACHE", str(home.parent))
    assert weights.fetch("net", manifest=whole).read_bytes() == BODY
    assert server.requests[1]["Range"] == f"bytes={len(BODY)}-"


def test_damaged_download_never_gets_its_name(server: Server, home: Path):
    server.body = BODY[:-1] + b"x"
    with pytest.raises(WeightsError, match="is not the published file: sha256"):
        weights.fetch("net", manifest=manifest(server.url))
    assert not (home / "net.bin").exists()
    assert not (home / "net.bin.part").exists()


def test_error_page_is_not_taken_for_weights(server: Server, home: Path):
    server.body = b"<html>not found</html>"
    with pytest.raises(WeightsError, match=r"the published net\.bin has 1,048,576"):
        weights.fetch("net", manifest=manifest(server.url))


def test_second_server_is_asked_when_the_first_has_nothing(server: Server, home: Path):
    closed = "http://127.0.0.1:9/net.bin"
    path = weights.fetch("net", manifest=manifest(server.url, urls=(closed, server.url)))
    assert path.read_bytes() == BODY


def test_offline_failure_is_quick_and_says_what_to_bring(home: Path):
    started = time.monotonic()
    with pytest.raises(WeightsError) as caught:
        weights.fetch("net", manifest=manifest("http://no-such-host.invalid/net.bin"))
    assert time.monotonic() - started < 5
    assert caught.value.exit_code == 4
    for part in ("net.bin", "1.05 MB", "http://no-such-host.invalid/net.bin", str(home)):
        assert part in str(caught.value)


def test_silent_server_is_given_up_within_five_seconds_even_when_resuming(
    server: Server, home: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(download, "_ANSWER_SECONDS", 0.5)
    server.silent_seconds = 3.0
    home.mkdir(parents=True)
    (home / "net.bin.part").write_bytes(BODY[:1000])
    (home / "net.bin.part.origin").write_text('{"validator": null}')
    started = time.monotonic()
    with pytest.raises(WeightsError, match=r"no answer within 0\.5 s at 1,000 bytes"):
        weights.fetch("net", manifest=manifest(server.url))
    assert time.monotonic() - started < 1.5


def test_forbidden_network_is_not_used(server: Server, home: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(WeightsError, match="forbids the network"):
        weights.fetch("net", manifest=manifest(server.url))
    assert server.requests == []


def test_non_commercial_weights_need_their_license_accepted(server: Server, home: Path):
    limited = manifest(server.url, non_commercial=True, license="CC BY-NC 4.0")
    with pytest.raises(WeightsError, match=r"CC BY-NC 4\.0") as caught:
        weights.fetch("net", manifest=limited)
    assert "--accept-license" in caught.value.hint
    assert server.requests == []
    assert weights.fetch("net", accept_license=True, manifest=limited).is_file()


def test_weights_without_a_published_checksum_are_trusted_on_first_use(
    server: Server, home: Path, caplog: pytest.LogCaptureFixture
):
    unknown = manifest(server.url, sha256=None)
    path = weights.fetch("net", manifest=unknown)
    assert "trusted on first use" in caplog.text
    assert weights.verify("net", manifest=unknown).against == "first use"
    path.write_bytes(BODY[::-1])
    with pytest.raises(WeightsError, match="is not the first use file"):
        weights.verify("net", manifest=unknown)


def test_checksum_may_be_known_by_its_first_digits(server: Server, home: Path):
    digest = hashlib.sha256(BODY).hexdigest()
    weights.fetch("net", manifest=manifest(server.url, sha256=digest[:8]))
    checked = weights.verify("net", manifest=manifest(server.url, sha256=digest[:8]))
    assert (checked.against, checked.sha256, checked.size) == ("published", digest, len(BODY))


def test_search_goes_from_the_explicit_path_to_the_folder_to_the_cache(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    known = manifest("http://127.0.0.1:9/", size=3)
    assert weights.find("net", manifest=known) is None
    home.mkdir(parents=True)
    (home / "net.bin").write_bytes(b"abc")
    assert weights.find("net", manifest=known) == home / "net.bin"
    folder = tmp_path / "mine"
    folder.mkdir()
    monkeypatch.setenv("SWIMM3R_WEIGHTS_DIR", str(folder))
    assert weights.find("net", manifest=known) == home / "net.bin"
    (folder / "net.bin").write_bytes(b"abc")
    assert weights.find("net", manifest=known) == folder / "net.bin"
    own = tmp_path / "own.pth"
    own.write_bytes(b"fine-tuned")
    assert weights.find("net", own, known) == own
    with pytest.raises(WeightsError, match="there are no weights at"):
        weights.find("net", tmp_path / "missing.pth", known)


def test_same_weights_in_another_format_serve(home: Path):
    both = (
        *manifest("http://127.0.0.1:9/", size=3),
        *manifest("http://127.0.0.1:9/", name="net-safetensors", filename="n.safetensors", size=3, serves_as="net"),
    )
    home.mkdir(parents=True)
    (home / "n.safetensors").write_bytes(b"abc")
    assert weights.require("net", manifest=both) == home / "n.safetensors"


def test_truncated_copy_is_noticed_before_it_is_used(home: Path):
    home.mkdir(parents=True)
    (home / "net.bin").write_bytes(BODY[:100])
    with pytest.raises(WeightsError, match="has 100 bytes, expected 1,048,576") as caught:
        weights.find("net", manifest=manifest("http://127.0.0.1:9/"))
    assert caught.value.exit_code == 4


def test_missing_weights_are_asked_for_without_any_network(home: Path):
    started = time.monotonic()
    with pytest.raises(WeightsError) as caught:
        weights.require("mast3r")
    assert time.monotonic() - started < 0.5
    hint = caught.value.hint
    assert "swimm3r weights get mast3r --accept-license" in hint
    assert "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth" in hint
    assert "2755 MB" in hint
    assert str(home) in hint


def test_unknown_name_is_a_usage_error():
    with pytest.raises(UsageError, match="no weights called 'mastr'"):
        weights.require("mastr")


def test_full_disk_is_a_storage_error(server: Server, home: Path, monkeypatch: pytest.MonkeyPatch):
    usage = type("Usage", (), {"free": 1000})()
    monkeypatch.setattr(download.shutil, "disk_usage", lambda folder: usage)
    with pytest.raises(StorageError, match="has room for 0 MB"):
        weights.fetch("net", manifest=manifest(server.url))


def test_folder_that_cannot_be_made_is_a_storage_error(server: Server, home: Path, monkeypatch: pytest.MonkeyPatch):
    home.parent.mkdir(parents=True)
    home.write_text("a file where the folder should be")
    with pytest.raises(StorageError, match="cannot be written") as caught:
        weights.fetch("net", manifest=manifest(server.url))
    assert caught.value.exit_code == 7


def test_two_at_once_download_once(server: Server, home: Path):
    server.silent_seconds = 0.3
    found = []
    threads = [
        threading.Thread(target=lambda: found.append(weights.fetch("net", manifest=manifest(server.url))))
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [home / "net.bin"] * 3
    assert len(server.requests) == 1


def test_manifest_tells_everything_a_user_must_know():
    names = [w.name for w in weights.MANIFEST]
    assert len(set(names)) == len(names)
    for w in weights.MANIFEST:
        assert w.urls
        assert all(url.startswith("https://") for url in w.urls)
        assert w.license
        assert w.license_url.startswith("https://")
        assert w.non_commercial == ("NC" in w.license)
        assert w.sha256 is None or len(w.sha256) in (8, 64)
        assert w.serves_as is None or w.serves_as in names
