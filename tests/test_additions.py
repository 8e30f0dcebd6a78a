"""The recipes of CONTRIBUTING.md: each test fails until an addition of its kind is wired everywhere.

A structure-from-motion back end, a renderer recipe, a camera model, an export format, a score, a data set.
"""

import ast
import inspect
import re
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import get_args

import numpy as np
import pytest
import torch

import swimm3r
from swimm3r import export, sfm
from swimm3r.bench import protocols, scores
from swimm3r.cameras import DISTORTION_PARAMETERS, CameraModel, Cameras, distort, undistort
from swimm3r.cli.export import export_command
from swimm3r.datasets import tree
from swimm3r.export.settings import FOLDERS, FORMATS, ExportSettings, FormatName
from swimm3r.io.colmap.cameras import from_pycolmap_camera, to_pycolmap_camera
from swimm3r.pipeline.run_settings import starting_settings, with_poses_of
from swimm3r.settings import declarations
from swimm3r.settings_document import from_document, to_document
from swimm3r.sfm.settings import BackendName, ColmapSettings, SfmSettings
from swimm3r.splat import recipes
from swimm3r.splat.settings import RECIPES, RecipeName, SplatSettings, UwbsSettings, settings_of

PACKAGE = Path(swimm3r.__file__).parent
DOCS = PACKAGE.parents[1] / "docs"


def page(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def rows(text: str) -> list[str]:
    """The lines of a page's tables."""
    return [line for line in text.splitlines() if line.startswith("|")]


def test_the_recipes_name_tests_that_exist():
    named = set(re.findall(r"`(test_\w+)`", (PACKAGE.parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")))
    assert named < globals().keys()
    assert len(named) > 6


def test_an_addition_touches_at_most_three_files_of_the_package():
    text = (PACKAGE.parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    additions = text.split("## Adding something")[1].split("\n## ")[0].split("\n### ")[1:]
    assert len(additions) == 6
    for addition in additions:
        steps = re.findall(r"^\d\. (.*?):", addition, re.M)
        assert 1 < len(steps) <= 3, addition
        assert all(step.count("`src/") < 2 or " or " in step for step in steps), addition
        assert len(re.findall(r"`src/", addition)) == sum(step.count("`src/") for step in steps), addition


def cases(module: ModuleType) -> set[str]:
    """The classes that the `match` statements of a module name."""
    found = ast.walk(ast.parse(inspect.getsource(module)))
    return {ast.unparse(node.cls) for node in found if isinstance(node, ast.MatchClass)}


def modules(package: ModuleType) -> dict[str, ModuleType]:
    """The modules directly in a package, by name."""
    assert package.__file__ is not None
    files = sorted(Path(package.__file__).parent.glob("[!_]*.py"))
    return {file.stem: import_module(f"{package.__name__}.{file.stem}") for file in files}


# a structure-from-motion back end


@pytest.mark.parametrize("settings", get_args(SfmSettings), ids=lambda kind: kind.__name__)
def test_a_back_end_is_dispatched_checked_offered_and_described(settings: type):
    assert settings.__name__ in cases(sfm)
    assert settings.__name__ in {kind.__name__ for kind in checked_settings()}
    offered = {type(starting_settings(None, backend, None, None).sfm) for backend in get_args(BackendName)}
    assert settings in offered | {type(with_poses_of(Path("model"), ColmapSettings()))}
    assert any(f"`{settings.__module__}.{settings.__name__}`" in row for row in rows(page("method.md")))


def checked_settings() -> set[type]:
    """The settings whose files a back end checks."""
    found = modules(import_module("swimm3r.sfm.backends"))
    return {inspect.signature(module.check_files).parameters["settings"].annotation for module in found.values()}


def test_every_back_end_module_makes_a_reconstruction():
    found = modules(import_module("swimm3r.sfm.backends"))
    assert len(found) == len(get_args(SfmSettings))
    takes = {tuple(inspect.signature(module.reconstruct).parameters) for module in found.values()}
    assert takes == {("frames", "settings", "folder", "progress", "engine", "navigator")}
    kinds = {inspect.signature(module.reconstruct).parameters["settings"].annotation for module in found.values()}
    assert kinds == set(get_args(SfmSettings))


# a renderer recipe


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_recipe_has_settings_parts_and_a_description(recipe: RecipeName):
    settings = swimm3r.with_recipe(UwbsSettings(iterations=300, long_side=200), recipe)
    assert (settings.iterations, settings.long_side) == (300, 200)
    assert isinstance(settings, settings_of(recipe))
    assert settings.recipe == recipe
    assert from_document(to_document(settings), settings_of(recipe)) == settings
    assert recipes.recipe_parts(settings).primitives.__name__.endswith("Primitives")
    assert any(f"`{recipe}`" in row for row in rows(page("method.md"))), recipe


def test_every_kind_of_map_settings_has_its_training():
    kinds = {kind.__name__ for kind in get_args(SplatSettings)}
    assert kinds == {settings_of(recipe).__name__ for recipe in RECIPES}
    assert kinds == cases(recipes)


# a camera model


@pytest.mark.parametrize("model", [model for model in get_args(CameraModel) if model != "POLYNOMIAL"])  # of no file
def test_a_camera_model_distorts_inverts_is_stored_and_described(model: str, tmp_path: Path):
    distortion = torch.tensor([[0.05, -0.02, 0.001, 0.002][: len(DISTORTION_PARAMETERS[model])]]).double()
    points = torch.tensor([[[0.0, 0.0], [0.3, -0.2], [-0.4, 0.1]]]).double()
    bent = distort(points, distortion[:, None], model)
    assert (torch.equal(bent, points)) == (model == "PINHOLE")
    torch.testing.assert_close(undistort(bent, distortion[:, None], model), points, atol=1e-9, rtol=0)

    focal = [300.0, 300.0] if model == "SIMPLE_RADIAL" else [300.0, 310.0]
    K = torch.tensor([[[focal[0], 0, 160], [0, focal[1], 100], [0, 0, 1]]]).double()
    camera = Cameras(K, distortion, torch.eye(4).double()[None], 320, 200, model)
    for_colmap = to_pycolmap_camera(camera)
    assert for_colmap.model.name == model
    back = from_pycolmap_camera(for_colmap, model)
    np.testing.assert_array_equal(back[0], K[0].numpy())
    np.testing.assert_array_equal(back[1], distortion[0].numpy())
    seen = for_colmap.img_from_cam(np.concatenate([points[0].numpy(), np.ones((3, 1))], 1))
    ours = bent[0].numpy() * focal + [160, 100]
    assert seen is not None
    np.testing.assert_allclose(seen, ours, atol=1e-6)

    camera.save(tmp_path / "cameras.json")
    read = swimm3r.load_cameras(tmp_path / "cameras.json")
    assert read.model == model
    torch.testing.assert_close(read.distortion, distortion)

    offered = set().union(*(_options(kind) for kind in get_args(SfmSettings) if "camera" in declarations(kind)))
    assert model in offered
    assert any(model in row for row in rows(page("conventions.md")))


def _options(settings: type) -> set[str]:
    return set(get_args(declarations(settings)["camera"]))


# an export format


def test_every_export_format_is_chosen_by_its_settings_offered_and_described():
    kinds = {kind.__name__ for kind in get_args(ExportSettings)}
    formats = modules(import_module("swimm3r.export.formats"))
    assert kinds == cases(export) == {type(settings).__name__ for settings in FORMATS.values()}
    assert tuple(FORMATS) == get_args(FormatName)
    takes = {name: inspect.signature(module.export_run).parameters for name, module in formats.items()}
    assert {tuple(parameters) for parameters in takes.values()} == {("folder", "path", "settings")}
    assert sorted(one["settings"].annotation.__name__ for one in takes.values()) == sorted(kinds)
    for name, settings in FORMATS.items():
        offered = inspect.signature(export_command(name)).parameters
        assert offered["settings"].default == settings
        assert isinstance(settings, FOLDERS) == (not Path(settings.file_name).suffix)
        assert any(f"`{name}`" in row for row in rows(page("guides/export.md"))), name
    for module in formats.values():
        assert any(f"`{module.__name__}`" in row for row in rows(page("guides/export.md"))), module.__name__


# a score


def test_every_score_has_a_direction_a_note_and_a_table():
    names = [column.score for column in scores.COLUMNS]
    assert len(set(names)) == len(names)
    assert all(column.note and column.best in ("high", "low", "neither") for column in scores.COLUMNS)
    tables = {name: module for name, module in modules(protocols).items() if hasattr(module, "COLUMNS")}
    assert len(tables) > 4
    assert {column.score for table in tables.values() for column in table.COLUMNS} == set(names)


def test_every_score_is_computed():
    made = [pattern for file in (PACKAGE / "bench").rglob("*.py") for pattern in _names_made(file.read_text())]
    for column in scores.COLUMNS:
        assert any(re.fullmatch(pattern, column.score) for pattern in made), column.score


def _names_made(source: str) -> list[str]:
    """Patterns of the strings of a module, beside those that only list columns."""
    found = []
    for statement in ast.parse(source).body:
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "COLUMNS":
            continue
        for node in ast.walk(statement):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(re.escape(node.value))
            if isinstance(node, ast.JoinedStr) and re.search("[a-z]{3}", _fixed(node)):
                texts = [re.escape(str(v.value)) if isinstance(v, ast.Constant) else r"[a-z\d]+" for v in node.values]
                found.append("".join(texts))
    return found


def _fixed(text: ast.JoinedStr) -> str:
    return "_".join(str(value.value) for value in text.values if isinstance(value, ast.Constant))


# a data set


def test_every_reader_of_a_data_set_is_tried_and_described():
    readers = {
        (name.removeprefix("is_"), module)
        for module in modules(import_module("swimm3r.datasets")).values()
        for name, value in vars(module).items()
        if name.startswith("is_") and inspect.isfunction(value) and value.__module__ == module.__name__
    }
    tried = {(fits.__name__.removeprefix("is_"), import_module(fits.__module__)) for fits, _ in tree._LAYOUTS}
    assert readers == tried
    for fits, read in tree._LAYOUTS:
        assert fits.__module__ == read.__module__
        assert any(f"`{fits.__module__}`" in row for row in rows(page("datasets.md"))), fits.__module__
