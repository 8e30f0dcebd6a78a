"""The settings that a run goes by: those given, those its folder holds, and how the two differ; torch-free."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from swimm3r.pipeline.presets import MAST3R_PRESETS, PRESETS, Preset, RunSettings
from swimm3r.scale.settings import NAVIGATION, ScaleSettings
from swimm3r.sfm.settings import BACKENDS, BackendName, ColmapModelSettings, ColmapSettings, SfmSettings
from swimm3r.splat.settings import RecipeName, UwbsSettings, with_recipe

_PARTS = {"prepare": "frames", "sfm": "sfm", "splat": "splat", "eval": "test"}  # of RunSettings, by the stage they make

_WRITTEN = ("sfm.cache",)  # settings that name a folder to write into

_BESIDE_POSES = ("features", "depth", "water", "restore")  # parts of structure from motion that do not find poses


def settings_by_stage(settings: RunSettings) -> dict[str, dict[str, Any]]:
    """Every setting by name, under the stage that it decides."""
    return {
        "prepare": asdict(settings.frames),
        "sfm": {type(settings.sfm).__name__: asdict(settings.sfm), **_mapping_navigation(settings)},
        "splat": asdict(settings.splat),
        "eval": asdict(settings.test),
    }


def files_by_stage(settings: RunSettings, reference: Path | None) -> dict[str, dict[str, Path]]:
    """The files and folders that settings name, by the names in settings.yaml, under the stage that reads them."""
    found = {stage: _flat(asdict(getattr(settings, part)), part) for stage, part in _PARTS.items()}
    found["sfm"] |= _mapping_navigation(settings)
    found["eval"]["reference"] = reference
    return {
        stage: {name: value for name, value in values.items() if isinstance(value, Path) and name not in _WRITTEN}
        for stage, values in found.items()
    }


def with_stages_of(settings: RunSettings, other: RunSettings, stages: tuple[str, ...]) -> RunSettings:
    """The settings with those of some stages taken from others."""
    return replace(settings, **{_PARTS[stage]: getattr(other, _PARTS[stage]) for stage in stages})


def differences(old: RunSettings, new: RunSettings, stages: list[str]) -> list[str]:
    """Differences in the settings of some stages, by the names in settings.yaml: "splat.iterations: 2000 -> 5000"."""
    lines = []
    for part in (_PARTS[stage] for stage in stages):
        before, after = getattr(old, part), getattr(new, part)
        if type(before) is not type(after):
            lines.append(f"{part}.kind: {type(before).__name__} -> {type(after).__name__}")
            continue
        was, will = _flat(asdict(before), part), _flat(asdict(after), part)
        if part == "sfm":
            was, will = (found | _mapping_navigation(each) for found, each in ((was, old), (will, new)))
        names = dict.fromkeys((*was, *will))
        lines += [f"{name}: {was.get(name)} -> {will.get(name)}" for name in names if was.get(name) != will.get(name)]
    return lines


def navigation_of_mapping(settings: RunSettings) -> ScaleSettings | None:
    """The settings of the navigation that mapping uses; None where it uses none."""
    sfm, scale = settings.sfm, settings.scale
    return scale if scale.nav is not None and isinstance(sfm, ColmapSettings) and sfm.mapping.navigation else None


def _mapping_navigation(settings: RunSettings) -> dict[str, Any]:
    """The same by the names in settings.yaml."""
    if navigation_of_mapping(settings) is None:
        return {}
    return {f"scale.{name}": getattr(settings.scale, name) for name in NAVIGATION}


def starting_settings(
    preset: Preset | None, backend: BackendName | None, recipe: RecipeName | None, held: RunSettings | None
) -> RunSettings:
    """The defaults of a command's options: those of a named preset, else those that the run folder holds.

    Where there is neither, they are those of `default`. A back end or a recipe other than theirs comes with what the
    preset (or `default`) sets for it.
    """
    named = PRESETS[preset or "default"]
    base = named if preset is not None or held is None else held
    sfm, splat = base.sfm, base.splat
    if backend is not None and BACKENDS[backend] is not BACKENDS[sfm.backend]:
        kind = BACKENDS[backend]
        tuned = (named.sfm, MAST3R_PRESETS[preset or "default"])
        sfm = next((settings for settings in tuned if isinstance(settings, kind)), kind())
    if recipe is not None and splat.recipe != recipe:
        assert isinstance(named.splat, UwbsSettings)
        splat = with_recipe(named.splat, recipe)
    return replace(base, sfm=sfm, splat=splat)


def with_poses_of(model: Path, settings: SfmSettings) -> ColmapModelSettings:
    """The poses of a model that another program made, with depth and medium estimated as these settings say."""
    kept = {name: getattr(settings, name) for name in _BESIDE_POSES if hasattr(settings, name)}
    return ColmapModelSettings(model.resolve(), **kept)


def _flat(values: dict[str, Any], under: str) -> dict[str, Any]:
    flat = {}
    for name, value in values.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{under}.{name}")
        else:
            flat[f"{under}.{name}"] = value
    return flat
