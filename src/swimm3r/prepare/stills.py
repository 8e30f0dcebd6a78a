"""A folder of stills -> pictures of one size, upright, in order, uniquely named."""

import os
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from swimm3r.errors import InputError
from swimm3r.frame_settings import FrameSettings
from swimm3r.io import images, stills
from swimm3r.prepare.pictures import (
    BLANK,
    STEP,
    Dive,
    Picture,
    blank_caution,
    scaled_down,
    sharpness,
    small_grey,
    some_names,
    thinned,
)
from swimm3r.progress import Progress

MASKS = "masks"  # a folder of this name in the input is not searched for frames

Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class _Still:
    source: Path
    original: Path  # relative name
    name: str  # of the prepared picture
    time: float
    linked: bool  # the original serves as it is


def prepare_stills(
    source: Path, draft: Path, settings: FrameSettings, progress: Progress, leave_out: Sequence[Path]
) -> Dive:
    root, paths = pictures_of(source, [*leave_out, *([settings.masks] if settings.masks else [])])
    originals = [path.relative_to(root) for path in paths]
    sizes, damaged = {}, []
    for path in paths:
        try:
            sizes[path] = images.image_size(path)
        except InputError:
            damaged.append(path)
    paths, cautions = _one_size([path for path in paths if path in sizes], sizes, root, settings)
    paths, times, ordered = _in_time_order(paths, cautions)
    chosen = thinned(list(zip(paths, times, strict=True)), settings.max_frames)
    work = _named(chosen, root, settings.long_side)
    results = _in_threads(partial(_prepare_still, draft=draft, long_side=settings.long_side), work, progress)
    pictures, blank = [], 0
    for still, result in zip(work, results, strict=True):
        match result:
            case InputError():
                damaged.append(still.source)
            case None:
                blank += 1
            case float():
                pictures.append(Picture(still.name, still.original, sizes[still.source], still.time, result))
    if damaged:
        cautions.append(
            f"{len(damaged)} of {len(originals)} files cannot be read as pictures and were left out "
            f"({some_names(damaged, root)}). Copy them again if the originals are whole."
        )
    if blank:
        cautions.append(blank_caution(blank, "pictures"))
    if settings.masks is not None:
        mask_folders = [settings.masks]
    else:
        mask_folders = list(dict.fromkeys([root, source / MASKS, *([root.parent / MASKS] * (root.name == "images"))]))
    return Dive(pictures, ordered, cautions, mask_folders, originals)


def pictures_of(source: Path, leave_out: Sequence[Path] = ()) -> tuple[Path, list[Path]]:
    """The folder that names are relative to, and its pictures: images/ where there is one and no picture beside it."""
    inner = source / "images"
    beside = any(path.suffix.lower() in images.SUFFIXES for path in source.iterdir() if path.is_file())
    root = inner if inner.is_dir() and not beside else source
    outer = [path for path in leave_out if path.resolve() != root.resolve()]
    paths = stills.find_pictures(root, [*outer, root / MASKS])
    if paths:
        return root, paths
    kinds = Counter(path.suffix.lower() for path in root.rglob("*") if path.is_file())
    instead = ", ".join(f"{count} {kind or 'nameless'}" for kind, count in kinds.most_common(4))
    raise InputError(
        f"{source} holds no pictures" + (f", only {instead}" if instead else ": it is empty"),
        cause="another folder was meant, or the pictures are videos, raw files or HEIC",
        hint=f"a folder with {', '.join(images.SUFFIXES)}; a video is given by its own path; develop raw files first",
    )


def _one_size(
    paths: list[Path], sizes: dict[Path, tuple[int, int]], root: Path, settings: FrameSettings
) -> tuple[list[Path], list[str]]:
    """The pictures of the commonest size, and what to say about the others."""
    if not paths:
        return [], []
    (usual, count), *_ = Counter(sizes[path] for path in paths).most_common(1)
    odd = [path for path in paths if sizes[path] != usual]
    if not odd:
        return paths, []
    which = ", ".join(f"{path.relative_to(root).as_posix()} ({sizes[path][0]}x{sizes[path][1]})" for path in odd[:5])
    which += f" and {len(odd) - 5} more" if len(odd) > 5 else ""
    if settings.odd_sizes == "refuse":
        raise InputError(
            f"the pictures are not of one size: {count} are {usual[0]}x{usual[1]}, but {which}",
            cause="pictures of another camera, crop, or orientation in the same folder",
            hint="take those out, or leave them out with --odd-sizes skip",
        )
    return [p for p in paths if sizes[p] == usual], [f"{len(odd)} pictures of another size were left out: {which}."]


def _in_time_order(paths: list[Path], cautions: list[str]) -> tuple[list[Path], list[float], bool]:
    """Sorted pictures, their times, whether neighbours were taken in turn; by the camera's clock where all carry it."""
    taken = [stills.capture_time(path) for path in paths]
    known = [time for time in taken if time is not None]
    if len(known) < len(paths) or len(set(known)) < 2:
        return paths, [float(i) for i in range(len(paths))], stills.numbered(paths)
    order = sorted(range(len(paths)), key=known.__getitem__)  # stable: equal seconds keep the order of names
    if order != list(range(len(paths))):
        cautions.append("The pictures are ordered by the camera's clock, which is not the order of their names.")
    return [paths[i] for i in order], [known[i] - min(known) for i in order], True


def _named(chosen: list[tuple[Path, float]], root: Path, long_side: int) -> list[_Still]:
    """Names that stay unique even without their suffix and where case does not count."""
    relatives = [path.relative_to(root) for path, _ in chosen]
    stems = Counter(relative.with_suffix("").as_posix().lower() for relative in relatives)
    taken = set(stems)
    work = []
    for relative, (path, time) in zip(relatives, chosen, strict=True):
        stem = relative.with_suffix("").as_posix()
        if stems[stem.lower()] > 1:  # a.jpg beside a.png
            stem += f"_{relative.suffix[1:]}"
            while stem.lower() in taken:
                stem += "_"
            taken.add(stem.lower())
        linked = images.is_plain(path) and (not long_side or max(images.image_size(path)) <= long_side)
        work.append(_Still(path, relative, f"{stem}{path.suffix if linked else '.png'}", time, linked))
    return work


def _prepare_still(still: _Still, draft: Path, long_side: int) -> float | InputError | None:
    """Put one picture in its place: its sharpness, None where it shows nothing, or what is wrong with it."""
    target = draft / still.name
    try:
        picture = images.read_rgb(still.source)
    except InputError as error:
        return error
    grey = small_grey(picture)
    if grey.std() < BLANK:
        return None
    if not still.linked:
        images.write_rgb(target, scaled_down(picture, long_side))
        return sharpness(grey)
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(still.source.resolve(), target)
    except OSError:  # another disk, or a file system without links
        shutil.copyfile(still.source, target)
    return sharpness(grey)


def _in_threads(work: Callable[[Job], Result], jobs: Sequence[Job], progress: Progress) -> list[Result]:
    """The results in order; decoding and encoding run outside Python's lock. Few at once: each holds a picture."""
    results: list[Result] = []
    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
        try:
            for result in pool.map(work, jobs):
                results.append(result)
                progress(STEP, len(results), len(jobs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results
