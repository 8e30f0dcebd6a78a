"""Videos, folders of images and masks that cannot be used as they are."""

import os
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image
from tests.attack import damage
from tests.attack.harness import Case, Fixture

REFUSED, TAKEN = (3,), (0,)


def cases(fixture: Fixture) -> Iterator[Case]:
    """Sources, images among good ones, masks."""
    yield from _sources(fixture)
    yield from _images(fixture)
    yield from _masks(fixture)


def _good(fixture: Fixture, folder: Path, suffix: str = ".png") -> Path:
    """Four small images in `folder`/p."""
    target = folder / "p"
    target.mkdir()
    for i, path in enumerate(sorted((fixture.dive / "images").iterdir())[:4]):
        Image.open(path).convert("RGB").save(target / f"{i:04d}{suffix}")
    return target


def _sources(fixture: Fixture) -> Iterator[Case]:
    def case(name: str, source: str, codes: tuple[int, ...], make: Callable[[Path], object], **options) -> Case:
        return Case(name, ("prepare", source, "--out", "out"), codes, make, **options)

    def fifo(folder: Path) -> None:
        os.mkfifo(folder / "p.mp4")

    def private(folder: Path) -> None:
        target = _good(fixture, folder)
        target.chmod(0)

    yield case("fifo", "p.mp4", REFUSED, fifo, seconds=60)
    yield case("fifo-link", "l.mp4", REFUSED, lambda f: (fifo(f), (f / "l.mp4").symlink_to("p.mp4")), seconds=60)
    yield case("device", "/dev/zero", REFUSED, lambda f: None, seconds=60)
    yield case("absent", "none.mp4", REFUSED, lambda f: None)
    yield case("empty-video", "x.mp4", REFUSED, lambda f: (f / "x.mp4").write_bytes(b""))
    yield case("garbage-video", "x.mp4", REFUSED, lambda f: (f / "x.mp4").write_bytes(os.urandom(5000)))
    yield case("text-video", "x.mp4", REFUSED, lambda f: (f / "x.mp4").write_text("#EXTM3U\n/etc/passwd\n"))
    yield case("empty-folder", "p", REFUSED, lambda f: (f / "p").mkdir())
    yield case("unreadable-folder", "p", REFUSED, private, as_nobody=True)
    yield case("name-too-long", "a" * 300 + ".mp4", REFUSED, lambda f: None)
    yield case("path-too-long", "/".join(["a" * 200] * 30), REFUSED, lambda f: None)
    yield case("dangling", "l.mp4", REFUSED, lambda f: (f / "l.mp4").symlink_to("nowhere"))
    yield case("loop", "l.mp4", REFUSED, lambda f: (f / "l.mp4").symlink_to("l.mp4"))
    yield case("one-image", "p", REFUSED, lambda f: [x.unlink() for x in list(_good(fixture, f).iterdir())[1:]])
    for option in ("--start", "--end", "--fps", "--max-frames", "--long-side"):
        for value in ("inf", "nan", "1e300", "-1", "text", ""):
            yield Case(
                f"option{option}={value}",
                ("prepare", "p", "--out", "out", option, value),
                (0, 2, 3),
                partial(_good_only, fixture),
            )


def _good_only(fixture: Fixture, folder: Path) -> None:
    _good(fixture, folder)


def _png_header(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 50)) + chunk(b"IEND", b"")
    )


def _images(fixture: Fixture) -> Iterator[Case]:
    """One odd file among four good images: it is left out with a warning, or the folder is refused with its name."""
    ether = (0, 3)

    def among(make: Callable[[Path], object], folder: Path) -> None:
        make(_good(fixture, folder))

    odd: dict[str, Callable[[Path], object]] = {
        "png-bomb-header": lambda p: (p / "9.png").write_bytes(_png_header(60_000, 60_000)),
        "png-2g-header": lambda p: (p / "9.png").write_bytes(_png_header(2**31 - 1, 2**31 - 1)),
        "png-cut": lambda p: damage.truncated(p / "0001.png"),
        "png-empty": lambda p: (p / "9.png").write_bytes(b""),
        "png-garbage": lambda p: (p / "9.png").write_bytes(os.urandom(999)),
        "other-size": lambda p: Image.new("RGB", (31, 17)).save(p / "9.png"),
        "one-pixel": lambda p: Image.new("RGB", (1, 1)).save(p / "9.png"),
        "fifo": lambda p: os.mkfifo(p / "9.png"),
        "folder-named-png": lambda p: (p / "9.png").mkdir(),
        "dangling": lambda p: (p / "9.png").symlink_to("nowhere"),
        "loop-folder": lambda p: (p / "sub").symlink_to("."),
        "palette": lambda p: Image.open(p / "0001.png").convert("P").save(p / "0001.png"),
        "gray": lambda p: Image.open(p / "0001.png").convert("L").save(p / "0001.png"),
        "alpha": lambda p: Image.open(p / "0001.png").convert("RGBA").save(p / "0001.png"),
        "16-bit": lambda p: Image.fromarray(np.zeros((120, 160), np.uint16)).save(p / "9.png"),
        "cmyk": lambda p: Image.open(p / "0001.png").convert("CMYK").save(p / "9.jpg"),
        "tiff-nan": lambda p: Image.fromarray(np.full((120, 160), np.nan, np.float32)).save(p / "9.tif"),
        "name-not-utf8": lambda p: os.rename(os.fsencode(p / "0001.png"), os.fsencode(p) + b"/a\xff\xfe.png"),
        "name-long": lambda p: (p / "0001.png").rename(p / ("a" * 247 + ".png")),
        "name-longest": lambda p: (p / "0001.png").rename(p / ("a" * 251 + ".png")),
        "name-newline": lambda p: (p / "0001.png").rename(p / "a\nb.png"),
        "name-spaces": lambda p: (p / "0001.png").rename(p / "  a b .png"),
        "name-case-twins": lambda p: shutil.copy(p / "0001.png", p / "0001.PNG"),
        "stem-twins": lambda p: Image.open(p / "0001.png").convert("RGB").save(p / "0001.jpg"),
        "unreadable": lambda p: (p / "0001.png").chmod(0),
    }
    for name, make in odd.items():
        yield Case(
            name,
            ("prepare", "p", "--out", "out"),
            ether,
            partial(among, make),
            as_nobody=name == "unreadable",
            seconds=90,
        )
        if not name.startswith(("fifo", "unreadable")):
            yield Case(
                f"sfm-{name}",
                ("sfm", "p", "--out", "out", "--preset", "fast"),
                (0, 3, 6),
                partial(among, make),
                seconds=300,
            )

    def subfolder(folder: Path) -> None:
        target = _good(fixture, folder) / "sub"
        target.mkdir()
        target.chmod(0)

    yield Case("unreadable-subfolder", ("prepare", "p", "--out", "out"), ether, subfolder, as_nobody=True)


def _masks(fixture: Fixture) -> Iterator[Case]:
    """Masks named like the frames, in every suffix, beside them or elsewhere, good and damaged."""

    def with_masks(suffix: str, where: str, name: str, folder: Path) -> None:
        frames = _good(fixture, folder, suffix)
        target = frames / "masks" if where == "inside" else folder / "k"
        target.mkdir()
        for path in frames.glob(f"*{suffix}"):
            mask = np.full((120, 160), 255, np.uint8)
            mask[:40] = 0
            Image.fromarray(mask).save(target / name.format(stem=path.stem, name=path.name))

    for suffix in (".png", ".jpg", ".tif"):
        for name in ("{stem}.png", "{name}.png", "{stem}_mask.png"):
            for where in ("inside", "beside"):
                options = () if where == "inside" else ("--masks", "k")
                yield Case(
                    f"masks{suffix}-{name}-{where}",
                    ("prepare", "p", "--out", "out", *options),
                    TAKEN,
                    partial(with_masks, suffix, where, name),
                    says="4",
                )

    def changed(change: Callable[[Path], object], folder: Path) -> None:
        with_masks(".png", "beside", "{stem}.png", folder)
        change(folder / "k")

    for name, change, codes in (
        ("all-out", lambda k: [Image.new("L", (160, 120)).save(x) for x in k.iterdir()], (0, 3)),
        ("all-in", lambda k: [Image.new("L", (160, 120), 255).save(x) for x in k.iterdir()], (0,)),
        ("other-size", lambda k: [Image.new("L", (16, 12), 255).save(x) for x in k.iterdir()], (0, 3)),
        ("garbage", lambda k: damage.garbage(next(k.iterdir())), (3,)),
        (
            "rgba-zero-alpha",
            lambda k: [Image.new("RGBA", (160, 120), (255, 255, 255, 0)).save(x) for x in k.iterdir()],
            (0, 3),
        ),
        ("strangers", lambda k: [x.rename(k / f"z{x.name}") for x in list(k.iterdir())], (0, 3)),
        ("empty", lambda k: [x.unlink() for x in list(k.iterdir())], (3,)),
        ("absent", lambda k: shutil.rmtree(k), (2, 3)),
    ):
        yield Case(f"masks-{name}", ("prepare", "p", "--out", "out", "--masks", "k"), codes, partial(changed, change))
