"""Models, cameras and truth that other programs wrote, or that somebody edited."""

import json
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from tests.attack import damage
from tests.attack.harness import SMALL, Case, Fixture

REFUSED = (3, 6)
NAN = float("nan")


def cases(fixture: Fixture) -> Iterator[Case]:
    """transforms.json, COLMAP text models, cameras.json as model, reference and lens, and a dive's truth."""
    table = json.loads((fixture.run / "sfm" / "cameras.json").read_text())

    def transforms(**changes: object) -> Callable[[Path], None]:
        def write(folder: Path) -> None:
            _images(fixture, folder)
            flip = [1, -1, -1, 1]
            document = {"fl_x": table["fx"], "fl_y": table["fy"], "cx": table["cx"], "cy": table["cy"]}
            document |= {"w": table["width"], "h": table["height"], "k1": 0.0, "frames": []}
            for frame in table["frames"]:
                matrix = [[value * flip[k] for k, value in enumerate(row)] for row in frame["c2w"]]
                document["frames"].append({"file_path": f"pics/{frame['name']}", "transform_matrix": matrix})
            for key, value in changes.items():
                if key in ("file_path", "transform_matrix"):
                    document["frames"][0][key] = value
                elif value is None:
                    document.pop(key, None)
                else:
                    document[key] = value
            (folder / "transforms.json").write_text(json.dumps(document))

        return write

    splat = ("splat", "--transforms", "transforms.json", "--out", "out", *SMALL)
    zero, bad = [[0.0] * 4] * 4, [[NAN] * 4] * 4
    for name, changes in {
        **{
            f"focal-{n}": {"fl_x": v, "fl_y": v}
            for n, v in {"zero": 0, "negative": -100, "nan": NAN, "text": "x"}.items()
        },
        **{f"size-{n}": {"w": v, "h": v} for n, v in {"zero": 0, "negative": -4, "text": "x"}.items()},
        **{f"k1-{n}": {"k1": v} for n, v in {"huge": 1e9, "nan": NAN, "text": "x"}.items()},
        **{
            f"pose-{n}": {"transform_matrix": v}
            for n, v in {"zero": zero, "nan": bad, "short": [[1]], "text": "x"}.items()
        },
        **{f"path-{n}": {"file_path": v} for n, v in {"number": 4, "dot": ".", "escape": "../../../x.png"}.items()},
        "angle-zero": {"fl_x": None, "fl_y": None, "camera_angle_x": 0},
        "frames-number": {"frames": 3},
        "frames-empty": {"frames": []},
    }.items():
        yield Case(f"transforms-{name}", splat, REFUSED, transforms(**changes))
    for kind, change in (damage.JSON_KINDS | damage.ANY).items():
        if kind == "missing":
            continue
        yield Case(f"transforms-{kind}", splat, (2, *REFUSED), partial(_then, transforms(), "transforms.json", change))

    yield from _cameras_json(fixture, table)
    yield from _colmap_text(fixture, table)
    yield from _truth(fixture)


def _images(fixture: Fixture, folder: Path) -> None:
    shutil.copytree(fixture.run / "prepare", folder / "pics", ignore=shutil.ignore_patterns("*.json"))


def _then(first: Callable[[Path], None], name: str, change: damage.Damage, folder: Path) -> None:
    first(folder)
    change(folder / name)


def _cameras_json(fixture: Fixture, table: dict) -> Iterator[Case]:
    changes: dict[str, Callable[[dict], object]] = {
        "nan": lambda d: d["frames"][0].update(c2w=[[NAN] * 4] * 4),
        "singular": lambda d: d["frames"][0].update(c2w=[[0.0] * 4] * 4),
        "mirrored": lambda d: d["frames"][0]["c2w"][0].__setitem__(0, -d["frames"][0]["c2w"][0][0]),
        "distortion-long": lambda d: d.update(distortion=[0.0] * 40),
        "distortion-nan": lambda d: d.update(distortion=[NAN] * len(d["distortion"])),
        "model": lambda d: d.update(model="EVIL"),
        "focal-zero": lambda d: d.update(fx=0),
        "size-zero": lambda d: d.update(width=0),
        "twins": lambda d: d["frames"].append(d["frames"][0]),
        "no-frames": lambda d: d.update(frames=[]),
        "name-number": lambda d: d["frames"][0].update(name=3),
    }

    def write(change: Callable[[dict], object], folder: Path) -> None:
        shutil.copytree(fixture.run, folder / "run")
        _images(fixture, folder)
        document = json.loads(json.dumps(table))
        change(document)
        (folder / "c.json").write_text(json.dumps(document))

    for name, change in changes.items():
        prepare = partial(write, change)
        yield Case(f"reference-{name}", ("eval", "run", "--steps", "1", "--reference", "c.json"), (0, 3), prepare)
        frame = f"run/prepare/{table['frames'][0]['name']}"
        yield Case(f"lens-{name}", ("localize", "run", frame, "--lens", "c.json"), (0, 3, 6), prepare)
        arguments = ("splat", "--colmap", "c.json", "--images", "pics", "--out", "out", *SMALL)
        yield Case(f"own-cameras-{name}", arguments, REFUSED, prepare)


def _colmap_text(fixture: Fixture, table: dict) -> Iterator[Case]:
    size = f"{table['width']} {table['height']}"
    lens = f"{table['fx']} {table['fy']} {table['cx']} {table['cy']}"
    cameras = {
        "zero-focal": f"1 PINHOLE {size} 0 0 10 10",
        "negative-focal": f"1 PINHOLE {size} -90 -90 10 10",
        "nan-focal": f"1 PINHOLE {size} nan nan 10 10",
        "size-0": f"1 PINHOLE 0 0 {lens}",
        "model": f"1 EVIL {size} {lens}",
        "short": f"1 PINHOLE {size}",
        "words": "a camera",
        "none": "",
    }
    poses = {"zero-quat": "0 0 0 0 0 0 0", "nan-pose": "nan 0 0 0 nan 0 0", "words": "a b c d e f g", "short": "1 0"}

    def write(camera: str, pose: str, folder: Path) -> None:
        _images(fixture, folder)
        model = folder / "m"
        model.mkdir()
        (model / "cameras.txt").write_text(camera + "\n")
        names = [frame["name"] for frame in table["frames"]]
        (model / "images.txt").write_text("".join(f"{i + 1} {pose} 1 {name}\n\n" for i, name in enumerate(names)))
        (model / "points3D.txt").write_text("")

    arguments = ("splat", "--colmap", "m", "--images", "pics", "--out", "out", *SMALL)
    for name, camera in cameras.items():
        yield Case(f"colmap-camera-{name}", arguments, REFUSED, partial(write, camera, "1 0 0 0 0 0 0"))
    for name, pose in poses.items():
        yield Case(f"colmap-text-{name}", arguments, REFUSED, partial(write, f"1 PINHOLE {size} {lens}", pose))


def _truth(fixture: Fixture) -> Iterator[Case]:
    """A synthetic dive whose truth was damaged after the run."""

    def write(name: str, change: damage.Damage, folder: Path) -> None:
        shutil.copytree(fixture.dive, folder / "dive")
        for path in sorted((folder / "dive" / "truth").rglob(name)):
            change(path)

    for pattern in ("medium.json", "cameras.json", "*.npz"):
        kinds = damage.ANY | (damage.JSON_KINDS if pattern.endswith("json") else {"pickle": damage.pickled})
        for kind, change in kinds.items():
            if kind in ("missing",):
                continue
            yield Case(
                f"truth-{pattern.strip('*.')}-{kind}",
                ("run", "dive", "--out", "out", *SMALL),
                (0, 3),
                partial(write, pattern, change),
            )
