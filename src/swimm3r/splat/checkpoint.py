"""Maps and training states on disk, as safetensors: tensors under their names, everything else in the header.

map.safetensors (`schema` 1) holds the primitives as stored (before activation), the water, and in its header
the recipe, its settings, the metric flag, the working unit and when the clip begins and ends; also the training
frames' poses where they were refined. A checkpoint adds the optimiser's moments and the step.
"""

import json
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from swimm3r.errors import InputError
from swimm3r.io.atomic import atomic_path
from swimm3r.splat.pose_codes import RefinedPoses
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import RECIPES, recipe_of, settings_of
from swimm3r.splat.state import parts_of

SCHEMA = 1


@dataclass(frozen=True)
class Stored:
    """The tensors of a file and its header."""

    tensors: dict[str, Tensor]
    about: dict[str, Any]


def save_map(path: Path, scene: SplatMap) -> None:
    """Write a map, whole or not at all."""
    tensors = {f"primitives.{name}": values for name, values in scene.primitives._asdict().items()}
    tensors |= {f"field.{name}": values for name, values in scene.field.state_dict().items()}
    about = {
        "recipe": recipe_of(scene.settings),
        "settings": asdict(scene.settings),
        "metric": scene.metric,
        "length": scene.length,
        "span": scene.span,
    }
    if scene.poses is not None:
        tensors["poses.cam2world"] = scene.poses.cam2world
        about["frames"] = scene.poses.names
    write(path, Stored(tensors, about))


def load_map(path: Path) -> SplatMap:
    """Read what `save_map` wrote. Raises InputError for a file that is damaged or of another kind."""
    stored = read(path)
    about = stored.about
    if about.get("recipe") not in RECIPES:
        raise _foreign(path, f"its recipe is {about.get('recipe')!r}, and known are {', '.join(RECIPES)}")
    try:
        settings = settings_from(settings_of(about["recipe"]), about["settings"])
        parts = parts_of(settings)
        field, kind = parts.field, parts.primitives
        field.load_state_dict(
            {k.removeprefix("field."): v for k, v in stored.tensors.items() if k.startswith("field.")}
        )
        primitives = kind(*(stored.tensors[f"primitives.{name}"] for name in kind._fields))
        if {len(values) for values in primitives} != {len(primitives.xyz)}:
            raise ValueError("its primitives' parts are of different lengths")
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise _foreign(path, str(error).splitlines()[0]) from error
    start, end = about.get("span", (0.0, 1.0))  # static maps of earlier versions have none
    poses = RefinedPoses(tuple(about["frames"]), stored.tensors["poses.cam2world"]) if "frames" in about else None
    field.requires_grad_(False)
    return SplatMap(primitives, field, settings, about["metric"], about["length"], (start, end), poses)


def write(path: Path, stored: Stored) -> None:
    """Tensors and header in one file, whole or not at all."""
    tensors = {name: values.detach().cpu().contiguous() for name, values in stored.tensors.items()}
    with atomic_path(path) as draft:
        save_file(tensors, draft, {"swimm3r": json.dumps({"schema": SCHEMA, **stored.about}, sort_keys=True)})


def read(path: Path) -> Stored:
    """Read what `write` wrote. Raises InputError for a file that is missing, damaged or of another kind."""
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            if "swimm3r" not in header:
                raise _foreign(path, "it has no Swimm3R header")
            about = json.loads(header["swimm3r"])
            schema = about.get("schema")
            if isinstance(schema, int) and schema > SCHEMA:
                raise InputError(
                    f"{path} was written by a newer Swimm3R: its schema is {schema}, this version reads {SCHEMA}.",
                    cause="the map was trained elsewhere, with a later version",
                    hint="update Swimm3R here, or train the map again",
                )
            if schema != SCHEMA:
                raise _foreign(path, f"its schema is {schema}, this version reads {SCHEMA}")
            return Stored({name: file.get_tensor(name) for name in file.keys()}, about)  # noqa: SIM118
    except (OSError, SafetensorError, ValueError) as error:
        raise _foreign(path, str(error)) from error


def settings_from(kind: type, values: dict[str, Any]) -> Any:
    """A settings dataclass from its `asdict`, nested ones by their annotations."""
    hints = get_type_hints(kind)
    nested = {f.name: hints[f.name] for f in fields(kind) if is_dataclass(hints[f.name])}
    return kind(**{k: settings_from(nested[k], v) if k in nested else v for k, v in values.items()})


def _foreign(path: Path, why: str) -> InputError:
    return InputError(
        f"{path} is not a map that can be read: {why}.",
        cause="the file is damaged, of another version, or of another program",
        hint="train the map again",
    )
