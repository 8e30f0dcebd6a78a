"""Getting weight files: the only part of Swimm3R that uses the network, and only when asked to.

A download resumes, is checked for size and SHA-256, and renamed into place, so that a file is whole or absent.
"""

import http.client
import json
import logging
import os
import shutil
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.client import HTTPResponse
from pathlib import Path
from typing import IO

from swimm3r.errors import StorageError, WeightsError
from swimm3r.progress import Progress, silent
from swimm3r.weights.manifest import MANIFEST, Weights, entry
from swimm3r.weights.store import check_size, compare, directories, directory, missing, note

log = logging.getLogger(__name__)

_ANSWER_SECONDS = 4.5  # all servers together; a message after five seconds is better than a minute of retries
_STALL_SECONDS = 30.0
_RESUMES = 5  # broken connections in a row that bring nothing new
_CHUNK = 1 << 20


def fetch(
    name: str, accept_license: bool = False, progress: Progress = silent, manifest: tuple[Weights, ...] = MANIFEST
) -> Path:
    """The weights' path, downloaded if they are not here; goes on where an interrupted download stopped.

    Raises WeightsError without the license's acceptance where it is non-commercial, within five seconds where no server
    answers, and for a file that arrives damaged; StorageError where it does not fit.
    """
    weights = entry(name, manifest)
    target = directory() / weights.filename
    for folder in directories():
        if (folder / weights.filename).is_file():
            check_size(folder / weights.filename, weights)
            return folder / weights.filename
    if weights.non_commercial and not accept_license:
        raise WeightsError(
            f"the weights {name!r} may not be used commercially: {weights.license}",
            cause="their authors set these terms, and only you can accept them",
            hint=f"read {weights.license_url}, then swimm3r weights get {name} --accept-license",
        )
    with _writable(target.parent), _locked(target.with_name(target.name + ".lock")):
        if not target.is_file():  # else another process was faster
            part = target.with_name(target.name + ".part")
            _download(weights, target, part, progress)
            checked = compare(weights, part)
            part.replace(target)
            _origin(part).unlink(missing_ok=True)
            if checked.against == "nothing":
                note(target, checked.sha256)
                log.warning("%s: no checksum is published; trusted on first use: sha256 %s", target, checked.sha256)
    return target


def _download(weights: Weights, target: Path, part: Path, progress: Progress) -> None:
    """Fills `part` up to the file's whole length, over as many connections as it takes."""
    deadline = time.monotonic() + _ANSWER_SECONDS
    failures: list[str] = []
    for url in weights.urls:
        came, idle = False, 0
        while idle < _RESUMES:
            before = _size(part)
            seconds = _ANSWER_SECONDS if came else max(0.1, deadline - time.monotonic())
            try:
                if _receive(url, part, weights, progress, seconds):
                    return
                reason = "the connection broke"
            except urllib.error.HTTPError as error:
                failures.append(f"{url}: the server answers {error.code} {error.reason}")
                break
            except (urllib.error.URLError, TimeoutError, ConnectionError, http.client.HTTPException) as error:
                reason = str(getattr(error, "reason", error)) or type(error).__name__
            except OSError as error:
                raise _storage(target, error) from error
            idle = 0 if _size(part) > before else idle + 1
            came = came or idle == 0
            if not came or idle == _RESUMES:  # where nothing ever came there is no use in asking again
                failures.append(f"{url}: {reason}" + (f" at {_size(part):,} bytes" if _size(part) else ""))
                break
    raise missing(weights, f"{weights.filename} could not be downloaded", "; ".join(failures))


def _receive(url: str, part: Path, weights: Weights, progress: Progress, seconds: float) -> bool:
    """One connection's worth of the file appended to `part`; True when it is whole."""
    origin = _origin(part)
    have = _size(part) if origin.exists() else 0
    try:
        response = _answer(_request(url, origin, have), seconds)
    except urllib.error.HTTPError as error:
        if error.code != 416 or have == 0:
            raise
        if error.headers.get("Content-Range", "").endswith(f"/{have}"):
            return True  # the part was whole already
        part.unlink()
        return _receive(url, part, weights, progress, seconds)
    with response:
        resumed = response.status == 206 and response.headers.get("Content-Range", "").startswith(f"bytes {have}-")
        have = have if resumed else 0
        total = _total(url, response, have, weights)
        _check_room(part.parent, (total or int((weights.about_mb or 0) * 1e6)) - have)
        tag = response.headers.get("ETag") or response.headers.get("Last-Modified")
        origin.write_text(json.dumps({"url": url, "validator": None if (tag or "").startswith("W/") else tag}))
        with part.open("ab" if resumed else "wb") as file:
            ended = _copy(response, file, have, lambda done: progress(weights.filename, done, total or done))
    return ended if total is None else _size(part) == total


def _request(url: str, origin: Path, have: int) -> urllib.request.Request:
    """A request for what is missing of a file of which `have` bytes are there, of the version that `origin` names."""
    headers = {"User-Agent": "swimm3r", "Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
        validator = json.loads(origin.read_text()).get("validator")
        if validator:
            headers["If-Range"] = validator
    return urllib.request.Request(url, headers=headers)


def _total(url: str, response: HTTPResponse, have: int, weights: Weights) -> int | None:
    """Length of the whole file; None where nobody says. Raises WeightsError for another than the published one."""
    length = response.headers.get("Content-Length")
    total = have + int(length) if length is not None else weights.size
    if weights.size is not None and total != weights.size:
        raise WeightsError(
            f"{url} has {total:,} bytes, the published {weights.filename} has {weights.size:,}",
            cause="the server sends another version or an error page",
            hint=f"bring the file by hand and put it into {directory()}",
        )
    return total


def _origin(part: Path) -> Path:
    """Version of the file that a part belongs to."""
    return part.with_name(part.name + ".origin")


def _copy(response: HTTPResponse, file: IO[bytes], have: int, report: Callable[[int], None]) -> bool:
    """Write what comes, after the `have` bytes that are there; False where the connection broke."""
    report(have)
    while True:
        try:
            chunk = response.read1(_CHUNK)
        except (TimeoutError, ConnectionError, http.client.HTTPException):
            return False  # what came is kept
        if not chunk:
            return True
        file.write(chunk)
        have += len(chunk)
        report(have)


def _answer(request: urllib.request.Request, seconds: float) -> HTTPResponse:
    """The response's headers within so many seconds; a thread, because no timeout covers the name look-up."""
    if os.environ.get("HF_HUB_OFFLINE") == "1":
        raise urllib.error.URLError("HF_HUB_OFFLINE=1 forbids the network")
    result: list[HTTPResponse | BaseException] = []

    def ask() -> None:
        try:
            result.append(urllib.request.urlopen(request, timeout=_STALL_SECONDS))
        except Exception as error:  # noqa: BLE001  raised again below, in the caller's thread
            result.append(error)

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(seconds)
    if not result:
        raise TimeoutError(f"no answer within {seconds:.1f} s")
    if isinstance(result[0], BaseException):
        raise result[0]
    return result[0]


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _check_room(folder: Path, needed: int) -> None:
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise StorageError(
            f"{folder} has room for {free / 1e6:,.0f} MB, the weights need {needed / 1e6:,.0f} MB more",
            cause="the disk is nearly full",
            hint="make room, or set SWIMM3R_WEIGHTS_DIR to a folder on another disk",
        )


def _storage(path: Path, error: OSError) -> StorageError:
    return StorageError(
        f"{path} cannot be written: {error.strerror or error}",
        cause="the disk is full, or the folder may not be written to",
        hint="set SWIMM3R_WEIGHTS_DIR to a folder of yours with room",
    )


@contextmanager
def _writable(folder: Path) -> Iterator[None]:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()  # nameless, so that two at once do not meet
    except OSError as error:
        raise _storage(folder, error) from error
    yield


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """One process at a time; the operating system frees the lock of a process that died."""
    with path.open("w") as file:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_LOCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield
