"""From a source to a complete folder of frames, and back from the folder.

The folder appears when it is complete, and not before. frames.json holds name, time, split, sharpness and mask of each
frame, and width, height, ordered, source and cautions of them all.
"""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Any

from swimm3r.errors import InputError
from swimm3r.frame_settings import FrameSettings
from swimm3r.frames import Frame, Frames
from swimm3r.io import images
from swimm3r.io.atomic import write_text
from swimm3r.io.video import Video
from swimm3r.prepare.clip import prepare_clip
from swimm3r.prepare.masks import prepare_masks
from swimm3r.prepare.pictures import Dive, target_size
from swimm3r.prepare.stills import pictures_of, prepare_stills
from swimm3r.progress import Progress, silent

TEST_EVERY = 8  # index % 8 == 0 is held back, as the paper and 3DGS count
LEAST = 3  # frames: the first is held back for testing, and depth takes two


def read_frames(
    source: str | Path,
    settings: FrameSettings | None = None,
    folder: Path | None = None,
    progress: Progress = silent,
    **changes: Any,
) -> Frames:
    """See `swimm3r.prepare.read_frames`."""
    source, settings = Path(source), replace(settings or FrameSettings(), **changes)
    check_source(source)
    if folder is None:
        folder = _cache_folder(source, settings)
        if (folder / "frames.json").is_file():
            return load_frames(folder)
    with _whole_folder(folder) as draft:
        if source.is_dir():
            dive = prepare_stills(source, draft, settings, progress, leave_out=[folder, folder.parent])
        else:
            dive = prepare_clip(source, draft, settings, progress)
        _write_frames(dive, draft, source, settings)
    return load_frames(folder)


def load_frames(folder: Path) -> Frames:
    """What `read_frames` prepared in a folder. Raises InputError where that is not whole."""
    path = folder / "frames.json"
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        frames = tuple(
            Frame(
                name=entry["name"],
                path=_inside(folder, entry["name"]),
                time=float(entry["time"]),
                sharpness=float(entry["sharpness"]),
                split=entry["split"],
                mask=_inside(folder, entry["mask"]) if entry["mask"] else None,
            )
            for entry in document["frames"]
        )
        return Frames(
            frames, document["width"], document["height"], document["ordered"], tuple(document.get("cautions", ()))
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{folder} holds no prepared frames ({error})",
            cause="the folder was moved, damaged, or is not a prepare/ folder",
            hint="prepare the frames anew from the video or the pictures",
        ) from error


def check_source(source: Path) -> None:
    """Raises InputError where a source is plainly no video and no folder of pictures; cheap, and writes nothing."""
    if source.is_dir():
        pictures_of(source)
    elif not source.exists():
        raise InputError(
            f"there is no {source}",
            cause="a slip in the name, or a disk that is not mounted",
            hint="give the path of a video, or of a folder with pictures",
        )
    elif source.suffix.lower() in images.SUFFIXES:
        raise InputError(
            f"{source} is a single picture",
            cause="one picture shows no depth",
            hint="give the folder that holds the pictures of the dive",
        )
    else:
        Video(source)


def _write_frames(dive: Dive, draft: Path, source: Path, settings: FrameSettings) -> None:
    """Masks and frames.json; frames.json is the last file of the folder."""
    cautions = list(dive.cautions)
    size = target_size(dive.pictures[0].size, settings.long_side) if dive.pictures else (0, 0)
    masks, covered = prepare_masks(dive, draft, size, settings, cautions)
    kept = [picture for picture in dive.pictures if picture.name not in covered]
    if covered:
        if not kept:
            raise InputError(
                f"the masks leave nothing: every one of {len(covered)} frames is wholly masked out",
                cause="the masks are the wrong way round; here 0 means leave out, anything else means use",
                hint="invert the masks, or run without them",
            )
        cautions.append(f"{len(covered)} frames were left out because their masks cover them wholly.")
    if len(kept) < LEAST:
        raise InputError(
            f"{source} gives {len(kept)} usable frame{'s' * (len(kept) != 1)}, and at least {LEAST} are needed",
            cause=" ".join(cautions) or "the clip is too short, or the pictures are too few",
            hint="more pictures with overlap, a longer clip, or a larger fps",
        )
    document = {
        "schema": 1,
        "source": str(source.resolve()),
        "width": size[0],
        "height": size[1],
        "ordered": dive.ordered,
        "cautions": cautions,
        "frames": [
            {
                "name": picture.name,
                "time": round(picture.time, 6),
                "split": "test" if i % TEST_EVERY == 0 else "train",
                "sharpness": round(picture.sharpness, 3),
                "mask": masks.get(picture.name),
            }
            for i, picture in enumerate(kept)
        ],
    }
    _remove_all_but(draft, {entry[key] for entry in document["frames"] for key in ("name", "mask") if entry[key]})
    write_text(draft / "frames.json", json.dumps(document, indent=1) + "\n")


def _inside(folder: Path, name: str) -> Path:
    """The file of that name in the folder. Names come from a file: they must not lead out of it."""
    relative = PurePosixPath(name)
    if relative.is_absolute() or ".." in relative.parts:
        raise ValueError(f"{name} leads out of the folder")
    path = folder / relative
    if not path.is_file():
        raise FileNotFoundError(f"{name} is missing")
    return path


def _remove_all_but(folder: Path, names: set[str]) -> None:
    """Drop what was written for frames that were left out in the end."""
    for path in folder.rglob("*"):
        if path.is_file() and path.relative_to(folder).as_posix() not in names:
            path.unlink()


@contextmanager
def _whole_folder(folder: Path) -> Iterator[Path]:
    """A draft that takes the place of `folder` if the block succeeds, and leaves no trace if not."""
    if folder.exists() and any(folder.iterdir()) and not (folder / "frames.json").is_file():
        raise InputError(
            f"{folder} is not empty and holds no prepared frames",
            cause="the folder is used for something else",
            hint="a folder that does not exist yet",
        )
    missing = [parent for parent in folder.parents if not parent.exists()]
    draft = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(draft, ignore_errors=True)  # left by a run that was killed
    draft.mkdir(parents=True)
    try:
        yield draft
        if folder.exists():
            shutil.rmtree(folder)
        draft.rename(folder)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        with suppress(OSError):  # somebody else has put something there meanwhile
            for parent in missing:
                parent.rmdir()
        raise


def _cache_folder(source: Path, settings: FrameSettings) -> Path:
    """Where frames go that were given no folder: the same source and settings find them again."""
    files = sorted(path for path in source.rglob("*") if path.is_file()) if source.is_dir() else [source]
    stats = [(str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    key = sha256(repr((stats, sorted(asdict(settings).items()))).encode()).hexdigest()[:16]
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "swimm3r" / "frames" / key
