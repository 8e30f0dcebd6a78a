"""Model weights: where they come from, where they lie, what their licence allows, whether they are whole.

A file is looked for at the path the user gave, then in $SWIMM3R_WEIGHTS_DIR, then in the cache ($SWIMM3R_CACHE, else
$XDG_CACHE_HOME/swimm3r). Only `fetch` uses the network: it resumes, checks size and SHA-256, and renames into place, so
that a file is whole or absent. Where the author publishes no checksum, the one of the first complete download is kept
beside the file and later compared with ("trust on first use"). Nothing here is bundled or re-distributed.
"""

import hashlib
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
from dataclasses import dataclass
from http.client import HTTPResponse
from pathlib import Path
from typing import IO, Literal

from swimm3r.errors import StorageError, UsageError, WeightsError
from swimm3r.progress import Progress, silent

log = logging.getLogger(__name__)

_ANSWER_SECONDS = 4.5  # all servers together; a message after five seconds is better than a minute of retries
_STALL_SECONDS = 30.0
_RESUMES = 5  # broken connections in a row that bring nothing new
_CHUNK = 1 << 20
_NAVER = "https://download.europe.naverlabs.com/ComputerVision"
_MAST3R = "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric"
_MAST3R_LICENCE = (
    "CC BY-NC-SA 4.0 and the terms of the training sets (CHECKPOINTS_NOTICE; Map-free allows no commercial use at all)"
)


@dataclass(frozen=True)
class Weights:
    """One published file."""

    name: str  # what the command line calls it
    purpose: str
    filename: str
    urls: tuple[str, ...]  # tried in turn
    size: int | None  # bytes; None where it is not published
    about_mb: float | None  # for messages, where the size is not exactly known
    sha256: str | None  # whole, or the first digits; None where it is not published
    licence: str
    licence_url: str
    non_commercial: bool
    serves_as: str | None = None  # another entry's name, of which this is the same in another format


MANIFEST = (
    Weights(
        name="mast3r",
        purpose="two-view pointmaps and descriptors, for --backend mast3r",
        filename=f"{_MAST3R}.pth",
        urls=(f"{_NAVER}/MASt3R/{_MAST3R}.pth",),
        size=2_754_910_614,
        about_mb=2755.0,
        sha256=None,
        licence=_MAST3R_LICENCE,
        licence_url="https://github.com/naver/mast3r/blob/main/CHECKPOINTS_NOTICE",
        non_commercial=True,
    ),
    Weights(
        name="mast3r-safetensors",
        purpose="the same weights as mast3r, which load without copying",
        filename=f"{_MAST3R}.safetensors",
        urls=(f"https://huggingface.co/naver/{_MAST3R}/resolve/main/model.safetensors",),
        size=None,
        about_mb=2755.0,
        sha256=None,
        licence=_MAST3R_LICENCE,
        licence_url="https://github.com/naver/mast3r/blob/main/CHECKPOINTS_NOTICE",
        non_commercial=True,
        serves_as="mast3r",
    ),
    Weights(
        name="mast3r-retrieval",
        purpose="whitening of MASt3R's encoder tokens, for loop closures",
        filename=f"{_MAST3R}_retrieval_trainingfree.pth",
        urls=(f"{_NAVER}/MASt3R/{_MAST3R}_retrieval_trainingfree.pth",),
        size=None,
        about_mb=8.4,
        sha256=None,
        licence=_MAST3R_LICENCE,
        licence_url="https://github.com/naver/mast3r/blob/main/CHECKPOINTS_NOTICE",
        non_commercial=True,
    ),
    Weights(
        name="mast3r-codebook",
        purpose="visual words for ASMK retrieval; belongs to mast3r-retrieval",
        filename=f"{_MAST3R}_retrieval_codebook.pkl",
        urls=(f"{_NAVER}/MASt3R/{_MAST3R}_retrieval_codebook.pkl",),
        size=None,
        about_mb=268.0,  # 65,536 words of 1,024 float32; not verified
        sha256=None,
        licence=_MAST3R_LICENCE,
        licence_url="https://github.com/naver/mast3r/blob/main/CHECKPOINTS_NOTICE",
        non_commercial=True,
    ),
    Weights(
        name="lpips-vgg",
        purpose="the LPIPS score's linear layers on VGG-16",
        filename="lpips_v0.1_vgg.pth",
        urls=("https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1/vgg.pth",),
        size=7_289,
        about_mb=0.01,
        sha256="a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
        licence="BSD-2-Clause",
        licence_url="https://github.com/richzhang/PerceptualSimilarity/blob/master/LICENSE",
        non_commercial=False,
    ),
    Weights(
        name="vgg16",
        purpose="the network under the LPIPS score",
        filename="vgg16-397923af.pth",
        urls=("https://download.pytorch.org/models/vgg16-397923af.pth",),
        size=None,
        about_mb=528.0,
        sha256="397923af",
        licence="BSD-3-Clause (torchvision); trained on ImageNet",
        licence_url="https://github.com/pytorch/vision/blob/main/LICENSE",
        non_commercial=False,
    ),
    Weights(
        name="uranker",
        purpose="the URanker score of underwater pictures",
        filename="URanker_ckpt-450eb36d.pth",
        urls=("https://huggingface.co/chaofengc/IQA-PyTorch-Weights/resolve/main/URanker_ckpt-450eb36d.pth",),
        size=None,
        about_mb=None,
        sha256="450eb36d",
        licence="CC BY-NC 4.0",
        licence_url="https://github.com/RQ-Wu/UnderwaterRanker",
        non_commercial=True,
    ),
)


@dataclass(frozen=True)
class Checked:
    """A file whose size and checksum are as expected."""

    path: Path
    size: int
    sha256: str
    against: Literal["published", "first use", "nothing"]
    """What it was compared with; "nothing": it is now the first use."""


def entry(name: str, manifest: tuple[Weights, ...] = MANIFEST) -> Weights:
    """The manifest's entry of a name. Raises UsageError for an unknown one."""
    for weights in manifest:
        if weights.name == name:
            return weights
    raise UsageError(
        f"there are no weights called {name!r}",
        cause="a mistyped name",
        hint="one of " + ", ".join(weights.name for weights in manifest),
    )


def directory() -> Path:
    """Where downloads go: $SWIMM3R_WEIGHTS_DIR, else `weights` in the cache."""
    return _directories()[0]


def find(name: str, explicit: Path | None = None, manifest: tuple[Weights, ...] = MANIFEST) -> Path | None:
    """Where the weights lie, or None. Never touches the network.

    Raises WeightsError for an explicit path without a file, and for a file of the wrong size.
    """
    if explicit is not None:
        if not explicit.is_file():
            raise WeightsError(
                f"there are no weights at {explicit}",
                cause="the path is mistyped, or is a folder",
                hint=f"give the path of {entry(name, manifest).filename} itself, or swimm3r weights get {name}",
            )
        return explicit
    wanted = entry(name, manifest)
    for weights in (wanted, *(w for w in manifest if w.serves_as == name)):
        for folder in _directories():
            path = folder / weights.filename
            if path.is_file():
                _check_size(path, weights)
                return path
    return None


def require(name: str, explicit: Path | None = None, manifest: tuple[Weights, ...] = MANIFEST) -> Path:
    """`find`, or a WeightsError that says which file is missing, how large it is, where it is and where to put it."""
    path = find(name, explicit, manifest)
    if path is None:
        raise _missing(entry(name, manifest), f"the weights {name!r} are not on this computer", "nobody got them yet")
    return path


def fetch(
    name: str, accept_licence: bool = False, progress: Progress = silent, manifest: tuple[Weights, ...] = MANIFEST
) -> Path:
    """The weights' path, downloaded if they are not here; goes on where an interrupted download stopped.

    Raises WeightsError without the licence's acceptance where it is non-commercial, within five seconds where no server
    answers, and for a file that arrives damaged; StorageError where it does not fit.
    """
    weights = entry(name, manifest)
    target = directory() / weights.filename
    for folder in _directories():
        if (folder / weights.filename).is_file():
            _check_size(folder / weights.filename, weights)
            return folder / weights.filename
    if weights.non_commercial and not accept_licence:
        raise WeightsError(
            f"the weights {name!r} may not be used commercially: {weights.licence}",
            cause="their authors set these terms, and only you can accept them",
            hint=f"read {weights.licence_url}, then swimm3r weights get {name} --accept-license",
        )
    with _writable(target.parent), _locked(target.with_name(target.name + ".lock")):
        if not target.is_file():  # else another process was faster
            part = target.with_name(target.name + ".part")
            _download(weights, target, part, progress)
            checked = _verify(weights, part)
            part.replace(target)
            _origin(part).unlink(missing_ok=True)
            if checked.against == "nothing":
                _note(target, checked.sha256)
                log.warning("%s: no checksum is published; trusted on first use: sha256 %s", target, checked.sha256)
    return target


def verify(name: str, explicit: Path | None = None, manifest: tuple[Weights, ...] = MANIFEST) -> Checked:
    """Reads the whole file and compares its checksum with the published one, else with that of the first use.

    Raises WeightsError where they differ.
    """
    path = require(name, explicit, manifest)
    weights = next((w for w in manifest if w.filename == path.name), entry(name, manifest))
    checked = _verify(weights, path)
    if checked.against == "nothing":
        _note(path, checked.sha256)
    return checked


def _verify(weights: Weights, path: Path) -> Checked:
    _check_size(path, weights)
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    noted = _noted(path)
    if weights.sha256 is not None:
        expected, against = weights.sha256, "published"
    elif noted.is_file():
        expected, against = noted.read_text().split()[0], "first use"
    else:
        return Checked(path, path.stat().st_size, digest, "nothing")
    if not digest.startswith(expected):
        arriving = path.suffix == ".part"
        if arriving:
            path.unlink()
        raise WeightsError(
            f"{path} is not the {against} file: sha256 {digest}, expected {expected}",
            cause="it was damaged on the way, or replaced by another version",
            hint="download it again" if arriving else f"delete it, then swimm3r weights get {weights.name}",
        )
    return Checked(path, path.stat().st_size, digest, against)


def _noted(path: Path) -> Path:
    return path.with_name(path.name + ".sha256")


def _note(path: Path, digest: str) -> None:
    try:
        _noted(path).write_text(f"{digest}  {path.name}\n")
    except OSError as error:  # a read-only folder of shared weights is no reason to stop
        log.warning("%s: its checksum could not be kept (%s)", path, error)


def _origin(part: Path) -> Path:
    """Which version of the file a part belongs to."""
    return part.with_name(part.name + ".origin")


def _check_size(path: Path, weights: Weights) -> None:
    size = path.stat().st_size
    if size == 0 or (weights.size is not None and size != weights.size):
        expected = f"{weights.size:,}" if weights.size is not None else "more"
        raise WeightsError(
            f"{path} has {size:,} bytes, expected {expected}",
            cause="a copy or a download that stopped early, or another version",
            hint=f"delete it, then swimm3r weights get {weights.name}",
        )


def _directories() -> list[Path]:
    given = os.environ.get("SWIMM3R_WEIGHTS_DIR")
    cache = os.environ.get("SWIMM3R_CACHE")
    if not cache:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "swimm3r"
    return [*([Path(given)] if given else []), Path(cache) / "weights"]


def _missing(weights: Weights, what: str, cause: str) -> WeightsError:
    accept = " --accept-license" if weights.non_commercial else ""
    size = f"about {weights.about_mb:g} MB" if weights.about_mb is not None else "size not published"
    return WeightsError(
        what,
        cause=cause,
        hint=f"with a network: swimm3r weights get {weights.name}{accept}; without: bring {weights.filename} "
        f"({size}) from {weights.urls[0]} and put it into {directory()}",
    )


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
    raise _missing(weights, f"{weights.filename} could not be downloaded", "; ".join(failures))


def _receive(url: str, part: Path, weights: Weights, progress: Progress, seconds: float) -> bool:
    """One connection's worth of the file appended to `part`; True when it is whole."""
    origin = _origin(part)
    have = _size(part) if origin.exists() else 0
    validator = json.loads(origin.read_text()).get("validator") if have else None
    headers = {"User-Agent": "swimm3r", "Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
        if validator:
            headers["If-Range"] = validator
    try:
        response = _answer(urllib.request.Request(url, headers=headers), seconds)
    except urllib.error.HTTPError as error:
        if error.code != 416 or have == 0:
            raise
        if error.headers.get("Content-Range", "").endswith(f"/{have}"):
            return True  # the part was whole already
        part.unlink()
        return _receive(url, part, weights, progress, seconds)
    with response:
        resumed = response.status == 206 and response.headers.get("Content-Range", "").startswith(f"bytes {have}-")
        if not resumed:
            have = 0
        length = response.headers.get("Content-Length")
        total = have + int(length) if length is not None else weights.size
        if weights.size is not None and total != weights.size:
            raise WeightsError(
                f"{url} has {total:,} bytes, the published {weights.filename} has {weights.size:,}",
                cause="the server sends another version or an error page",
                hint=f"bring the file by hand and put it into {directory()}",
            )
        _check_room(part.parent, (total or int((weights.about_mb or 0) * 1e6)) - have)
        tag = response.headers.get("ETag") or response.headers.get("Last-Modified")
        origin.write_text(json.dumps({"url": url, "validator": None if (tag or "").startswith("W/") else tag}))
        with part.open("ab" if resumed else "wb") as file:
            have = _copy(response, file, have, lambda done: progress(weights.filename, done, total or done))
    return total is None or have == total


def _copy(response: HTTPResponse, file: IO[bytes], have: int, report: Callable[[int], None]) -> int:
    report(have)
    while True:
        try:
            chunk = response.read1(_CHUNK)
        except (TimeoutError, ConnectionError, http.client.HTTPException):
            return have  # what came is kept
        if not chunk:
            return have
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
