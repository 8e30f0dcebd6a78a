"""A folder of stills -> images of one size, upright, in order, uniquely named."""

import os
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from swimm3r import memory
from swimm3r.errors import InputError
from swimm3r.io import image_folder, images
from swimm3r.io.bags.bag import is_bag
from swimm3r.io.files.cache_key import cache_key, files_below, sample_digest, samples_digest
from swimm3r.io.files.safe_names import safe_name, shown_name
from swimm3r.io.image_header import ImageHeader, ImageSizeError, capture_time
from swimm3r.io.raw import RAW_SUFFIXES
from swimm3r.io.video import VIDEO_SUFFIXES
from swimm3r.prepare.candidates import (
    BLANK,
    STEP,
    SelectedImages,
    SourceImage,
    Taken,
    blank_warning,
    is_gray,
    recorded_on,
    scaled_down,
    sharpness,
    small_gray,
    some_names,
    thinned,
)
from swimm3r.prepare.development import Development, development_of, header_of, read_developed
from swimm3r.prepare.rig import cameras_of_folder, pair_images, rig_of, write_lens
from swimm3r.progress import Progress
from swimm3r.scene.settings import FrameSettings

MASKS = "masks"  # a folder of this name in the input is not searched for frames

_NOT_READ = (".heic", ".heif", ".hif", ".avif", ".jxl", ".jp2", ".psd")

Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class _Still:
    """An image to be prepared."""

    taken: Taken
    original: Path  # relative name
    name: str  # of the prepared image
    linked: bool  # the original serves as it is


@dataclass(frozen=True)
class _Seen:
    """An image that shows something."""

    sharpness: float
    gray: bool


@dataclass(frozen=True)
class ImageFolder:
    """The images of a folder."""

    root: Path  # names are relative to it
    paths: list[Path]
    unreadable: list[Path]  # folders that could not be searched
    beside: tuple[str, ...] = ()  # sentences about files that were passed over, as there are images


def prepare_stills(
    source: Path, draft: Path, settings: FrameSettings, progress: Progress, leave_out: Sequence[Path]
) -> SelectedImages:
    """Write the frames of a folder of images into `draft`. Raises InputError."""
    folder = images_of(source, [*leave_out, *([settings.masks] if settings.masks else [])])
    cameras = cameras_of_folder(folder.root, settings)
    if cameras:
        folder = replace(folder, paths=[p for p in folder.paths if p.relative_to(folder.root).parts[0] in cameras])
    development = development_of(settings, folder.paths)
    headers, refused = _headers(folder.paths, development)
    choice = _choose(folder, headers, cameras, settings)
    work = _named(choice.taken, folder.root, settings.long_side, headers)
    most = max((headers[still.taken.path].decoding_bytes for still in work), default=0)
    prepare = partial(_prepare_still, draft=draft, long_side=settings.long_side, development=development)
    results = list(zip(work, _in_threads(prepare, work, most, progress), strict=True))
    refused |= {still.taken.path: result for still, result in results if isinstance(result, InputError)}
    images = [
        _source_image(still, headers[still.taken.path].size, result)
        for still, result in results
        if isinstance(result, _Seen)
    ]
    blank = sum(result is None for _, result in results)
    rig = rig_of(cameras, settings, images[0].size if images else None) if cameras else None
    return SelectedImages(
        images,
        choice.ordered,
        [*choice.warnings, *_left_out(refused, folder), *([blank_warning(blank, "images")] if blank else [])],
        _mask_folders(source, folder.root, settings),
        originals=[path.relative_to(folder.root) for path in folder.paths],
        files=frozenset(folder.root.resolve() / path.relative_to(folder.root) for path in folder.paths),
        recorded=choice.recorded,
        timed=choice.timed,
        calibration=None if rig is None else write_lens(draft, rig, settings),
        rig=rig,
        development=str(development) if development.changes or development.balance is not None else None,
    )


@dataclass(frozen=True)
class _Choice:
    """The images of a folder that are used."""

    taken: list[Taken]
    ordered: bool  # neighbors were taken in turn
    timed: bool  # every image carries a time
    recorded: str | None  # date of the earliest image that has one, ISO 8601
    warnings: list[str]


def _choose(
    folder: ImageFolder, headers: dict[Path, ImageHeader], cameras: tuple[str, ...], settings: FrameSettings
) -> _Choice:
    """The readable images of one size, in order: those of a rig by instants, others by time, thinned."""
    sizes = {path: header.size for path, header in headers.items()}
    paths, warnings = _one_size(list(headers), sizes, folder.root, settings)
    warnings += folder.beside
    if cameras:
        paired = pair_images(folder.root, paths, cameras, settings)
        told = [*warnings, *paired.warnings]
        return _Choice(list(paired.images), paired.ordered, paired.timed, paired.recorded, told)
    taken, timed, recorded = _in_time_order(paths, warnings)
    ordered = timed or image_folder.numbered(paths)
    return _Choice(thinned(taken, settings.max_frames), ordered, timed, recorded, warnings)


def _headers(paths: Sequence[Path], development: Development) -> tuple[dict[Path, ImageHeader], dict[Path, InputError]]:
    """The headers of the images that can be read, and the errors of the others."""
    headers: dict[Path, ImageHeader] = {}
    refused: dict[Path, InputError] = {}
    for path in paths:
        try:
            headers[path] = header_of(path, development)
        except InputError as error:
            refused[path] = error
    return headers, refused


def _mask_folders(source: Path, root: Path, settings: FrameSettings) -> list[Path]:
    """The folders that may hold masks: the one that the settings name, else those beside the images, each once."""
    if settings.masks is not None:
        return [settings.masks]
    outer = _masks_outside(root)
    return list(dict.fromkeys([root, root / MASKS, source / MASKS, *([] if outer is None else [outer])]))


def _masks_outside(folder: Path) -> Path | None:
    """The folder masks/ beside a folder that is called images/; None of any other."""
    whole = folder.absolute()
    return whole.parent / MASKS if whole.name == "images" else None


def source_digest(source: Path, leave_out: Path | None = None) -> str:
    """`sample_digest` of a source, and of the masks beside it where it is a folder images/ that was named itself.

    Runs within a folder of images or videos are no part of it.
    """
    if not source.is_dir() or is_bag(source):
        return sample_digest(source, leave_out)
    with suppress(OSError):  # a folder that may not be searched counts as empty
        found = image_folder.find_files(source, ("",), [] if leave_out is None else [leave_out]).paths
        own = samples_digest(source, sorted(path for path in found if path.is_file()))
        masks = _masks_outside(source)
        return own if masks is None or not masks.is_dir() else cache_key(own, sample_digest(masks))
    return samples_digest(source, [])


def images_of(source: Path, leave_out: Sequence[Path] = ()) -> ImageFolder:
    """The images of a folder: those in images/ where there is one and no image beside it; without any, raw files.

    Raises InputError where there are neither.
    """
    root = _root_of(source)
    closed = [root / MASKS, *(path for path in leave_out if path.resolve() != root.resolve())]
    found = image_folder.find_images(root, closed)
    raw = image_folder.find_files(root, RAW_SUFFIXES, closed)
    if found.paths:
        return ImageFolder(root, found.paths, found.unreadable, _passed_over(root, closed, len(raw.paths)))
    if raw.paths:
        return ImageFolder(root, raw.paths, raw.unreadable, _passed_over(root, closed))
    kinds = Counter(path.suffix.lower() for path in files_below(root))
    instead = ", ".join(f"{count} {kind or 'nameless'}" for kind, count in kinds.most_common(4))
    raise InputError(
        f"{source} holds no images" + (f", only {instead}" if instead else ": it is empty"),
        cause="another folder was meant, or the images are HEIC",
        hint=f"a folder with {', '.join(images.SUFFIXES)}, or camera raw files; a video is given by its own path",
    )


def _passed_over(root: Path, closed: Sequence[Path], raw: int = 0) -> tuple[str, ...]:
    """Sentences about so many raw files beside images, about images that are not read, and about videos."""
    found = {
        "camera raw files": (raw, "A folder that holds them alone is developed."),
        "images of formats that are not read (HEIC, JPEG XL ...)": (
            len(image_folder.find_files(root, _NOT_READ, closed).paths),
            "Convert them to JPEG, PNG or TIFF to use them.",
        ),
        "videos": (
            len(image_folder.find_files(root, VIDEO_SUFFIXES, closed).paths),
            "A video is given by its own path.",
        ),
    }
    return tuple(
        f"{count} {what} lie beside the images and were left out. {hint}"
        for what, (count, hint) in found.items()
        if count
    )


def only_video(source: Path) -> Path | None:
    """The one video of a folder without images; None where it holds images, or no video.

    Raises InputError where there are several.
    """
    root = _root_of(source)
    if image_folder.find_images(root, [root / MASKS]).paths or image_folder.find_files(root, RAW_SUFFIXES).paths:
        return None
    videos = image_folder.find_files(source, VIDEO_SUFFIXES).paths
    if len(videos) > 1:
        raise InputError(
            f"{source} holds no images and {len(videos)} videos: {some_names(videos, source, most=10)}",
            cause="a folder stands for the images in it, or for its only video",
            hint=f"give one of the videos by its own path, such as {videos[0]}",
        )
    return videos[0] if videos else None


def _root_of(source: Path) -> Path:
    inner = source / "images"
    beside = any(
        path.suffix.lower() in (*images.SUFFIXES, *RAW_SUFFIXES) for path in source.iterdir() if path.is_file()
    )
    return inner if inner.is_dir() and not beside else source


def _left_out(refused: dict[Path, InputError], folder: ImageFolder) -> list[str]:
    """The warning about files and folders that could not be read."""
    warnings = []
    too_large = [error for error in refused.values() if isinstance(error, ImageSizeError)]
    damaged = [path for path, error in refused.items() if not isinstance(error, ImageSizeError)]
    if damaged:
        warnings.append(
            f"{len(damaged)} of {len(folder.paths)} files cannot be read as images and were left out "
            f"({some_names(damaged, folder.root)}). Copy them again if the originals are whole."
        )
    if too_large:
        more = f" (and {len(too_large) - 3} more such files)" if len(too_large) > 3 else ""
        what = "; ".join(shown_name(error.what) for error in too_large[:3])
        warnings.append(f"{len(too_large)} of {len(folder.paths)} files were left out: {what}{more}.")
    if folder.unreadable:
        names = some_names(folder.unreadable, folder.root)
        warnings.append(f"{len(folder.unreadable)} folders may not be searched and were left out ({names}).")
    return warnings


def _one_size(
    paths: list[Path], sizes: dict[Path, tuple[int, int]], root: Path, settings: FrameSettings
) -> tuple[list[Path], list[str]]:
    """The images of the commonest size, and what to say about the others."""
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
            f"the images are not of one size: {count} are {usual[0]}x{usual[1]}, but {which}",
            cause="images of another camera, crop, or orientation in the same folder",
            hint="take those out, or leave them out with --odd-sizes skip",
        )
    return [p for p in paths if sizes[p] == usual], [f"{len(odd)} images of another size were left out: {which}."]


def _in_time_order(paths: list[Path], warnings: list[str]) -> tuple[list[Taken], bool, str | None]:
    """Sorted images, and whether their times are those of the camera's clock, which all carry then.

    Last, the date of the earliest image that has one.
    """
    clock = [capture_time(path) for path in paths]
    known = [time for time in clock if time is not None]
    recorded = recorded_on(min(known)) if known else None
    if len(known) < len(paths) or len(set(known)) < 2:
        return [Taken(path, float(i)) for i, path in enumerate(paths)], False, recorded
    order = sorted(range(len(paths)), key=known.__getitem__)  # stable: equal seconds keep the order of names
    if order != list(range(len(paths))):
        warnings.append("The images are ordered by the camera's clock, which is not the order of their names.")
    return [Taken(paths[i], known[i] - min(known)) for i in order], True, recorded


def _named(chosen: list[Taken], root: Path, long_side: int, headers: dict[Path, ImageHeader]) -> list[_Still]:
    """Names that every file system takes, and that stay unique even without their suffix and where case is ignored."""
    relatives = [taken.path.relative_to(root) for taken in chosen]
    wanted = [safe_name(relative) for relative in relatives]
    stems = Counter(stem.lower() for stem in wanted)
    given = set(stems)
    work = []
    for relative, stem, taken in zip(relatives, wanted, chosen, strict=True):
        if stems[stem.lower()] > 1:  # a.jpg beside a.png
            stem += f"_{relative.suffix[1:]}"
            while stem.lower() in given:
                stem += "_"
            given.add(stem.lower())
        header = headers[taken.path]
        linked = header.plain and (not long_side or max(header.size) <= long_side)
        work.append(_Still(taken, relative, f"{stem}{taken.path.suffix if linked else '.png'}", linked))
    return work


def _prepare_still(still: _Still, draft: Path, long_side: int, development: Development) -> _Seen | InputError | None:
    """Put one image in its place; None where it shows nothing, the error where it cannot be read."""
    target, source = draft / still.name, still.taken.path
    try:
        image = read_developed(source, development)
    except InputError as error:
        return error
    gray = small_gray(image)
    if gray.std() < BLANK:
        return None
    if not still.linked:
        images.write_rgb(target, scaled_down(image, long_side))
        return _Seen(sharpness(gray), is_gray(image))
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source.resolve(), target)
    except OSError:  # another disk, or a file system without links
        shutil.copyfile(source, target)
    return _Seen(sharpness(gray), is_gray(image))


def _source_image(still: _Still, size: tuple[int, int], seen: _Seen) -> SourceImage:
    taken = still.taken
    return SourceImage(
        still.name, still.original, size, taken.time, seen.sharpness, seen.gray, taken.camera, taken.instant
    )


def _in_threads(
    work: Callable[[Job], Result], jobs: Sequence[Job], bytes_each: int, progress: Progress
) -> list[Result]:
    """The results in order; decoding and encoding run outside Python's lock. As many at once as fit the memory."""
    free = memory.available_mb()
    fitting = 4 if free is None else max(1, int(free * memory.MB) // max(1, bytes_each))
    results: list[Result] = []
    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1, fitting)) as pool:
        try:
            for result in pool.map(work, jobs):
                results.append(result)
                progress(STEP, len(results), len(jobs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results
