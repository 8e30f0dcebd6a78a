"""Files that are not maps are refused in plain words."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from swimm3r.errors import InputError
from swimm3r.io.files.damage import remake
from swimm3r.io.files.tensor_file import read_tensors, write_tensors
from swimm3r.settings_document import from_document, to_document
from swimm3r.splat.map_file import load_map
from swimm3r.splat.settings import RenderSettings, UwbsSettings
from swimm3r.splat.training.checkpoint import StateHeader, read_state, write_state
from swimm3r.splat.training_poses import RefinedPoses


def test_settings_survive_their_dictionary():
    settings = UwbsSettings(iterations=7, render=RenderSettings(depth="z"))
    assert from_document(to_document(settings), UwbsSettings) == settings


def test_tensors_and_header_come_back(tmp_path):
    write_state(tmp_path / "a.safetensors", {"x": torch.arange(5)}, StateHeader(3, "abc"))
    stored = read_state(tmp_path / "a.safetensors")
    assert torch.equal(stored.tensors["x"], torch.arange(5))
    assert stored.about == StateHeader(3, "abc")


def test_a_file_that_is_no_map_is_refused(tmp_path, wall):
    path = tmp_path / "map.safetensors"
    with pytest.raises(InputError, match="is missing"):
        load_map(path)
    path.write_bytes(b"not a map")
    with pytest.raises(InputError, match="not a map"):
        load_map(path)
    save_file({"x": torch.zeros(2)}, path)
    with pytest.raises(InputError, match="header"):
        load_map(path)
    write_tensors(path, {"x": torch.zeros(2)}, {"schema": 2, "recipe": "splatfacto"})
    with pytest.raises(InputError, match="not a map"):
        load_map(path)
    wall(10).save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="not a map"):
        load_map(path)
    path.write_bytes(path.read_bytes()[:4])
    with pytest.raises(InputError, match="not a map"):
        load_map(path)


def test_a_map_comes_back_with_the_same_bits(tmp_path, wall, camera):
    poses = RefinedPoses(("a.png", "b.png"), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1))
    for scene in (wall(50), replace(wall(50), poses=poses, viewpoint=camera(), span=(1 / 3, 2 / 3), length=0.1)):
        scene.save(str(tmp_path / "map.safetensors"))
        again = load_map(str(tmp_path / "map.safetensors"))
        for name in scene.primitives._fields:
            assert torch.equal(getattr(again.primitives, name), getattr(scene.primitives, name)), name
        for name, values in scene.field.state_dict().items():
            assert torch.equal(again.field.state_dict()[name], values), name
        rest = ("settings", "metric", "length", "span")
        assert [getattr(again, name) for name in rest] == [getattr(scene, name) for name in rest]
        assert (again.poses is None) == (scene.poses is None)
        assert torch.equal(again.render(camera()).rgb, scene.render(camera()).rgb)
    assert again.poses.names == poses.names
    assert torch.equal(again.poses.cam2world, poses.cam2world)
    for name in ("K", "distortion", "cam2world"):
        assert torch.equal(getattr(again.viewpoint, name), getattr(camera(), name)), name
    assert (again.viewpoint.width, again.viewpoint.height) == (camera().width, camera().height)


def rewritten(path: Path, tensors: Mapping[str, Tensor | None], about: dict[str, Any]) -> None:
    """The same map with some tensors and header entries replaced, or left out where they are None."""
    stored = read_tensors(path, dict[str, Any], remake(path.parent), None)

    def merged(old: dict, new: Mapping) -> dict:
        return {k: v for k, v in {**old, **new}.items() if v is not None}

    write_tensors(path, merged(stored.tensors, tensors), merged(stored.about, about))


def test_a_map_from_before_the_filters_is_drawn_as_it_was_trained(tmp_path, wall, camera):
    path, dilated = tmp_path / "map.safetensors", RenderSettings(antialiasing="dilation")
    scene = replace(wall(50), settings=UwbsSettings(render=dilated))
    scene.save(path)
    old = to_document(scene.settings)
    del old["render"]["antialiasing"]
    rewritten(path, {"primitives.footprint": None}, {"schema": 2, "settings": old})
    again = load_map(path)
    assert again.settings == scene.settings
    assert torch.equal(again.render(camera()).rgb, scene.render(camera()).rgb)


def test_the_water_of_earlier_maps_had_convolutions_for_layers(tmp_path, wall, camera):
    path, scene = tmp_path / "map.safetensors", wall(50)
    scene.save(path)
    layers = {f"field.{k}": v for k, v in scene.field.state_dict().items() if v.ndim == 2}
    assert layers
    rewritten(path, {k: v[:, :, None, None] for k, v in layers.items()}, {"schema": 4})
    assert torch.equal(load_map(path).render(camera()).rgb, scene.render(camera()).rgb)
    rewritten(path, {}, {"schema": 6})
    with pytest.raises(InputError, match="size mismatch"):
        load_map(path)


@pytest.mark.parametrize(
    ("tensors", "about", "said"),
    [
        ({}, {"schema": 8}, "newer Swimm3R: its schema is 8, this version reads 2 and 3 and 4 and 5 and 6 and 7"),
        ({}, {"schema": 3}, "schema 3 lists 0 blocks"),
        ({}, {"schema": 1}, "an older Swimm3R: its schema is 1, this version reads 2 and 3 and 4 and 5 and 6 and 7"),
        ({}, {"schema": None}, "its schema is None"),
        ({}, {"recipe": "splatfacto"}, "splatfacto"),
        ({}, {"recipe": []}, "recipe: a text is expected"),
        ({}, {"metric": None}, "there is no metric"),
        ({}, {"length": "1"}, "length: a number is expected"),
        ({}, {"length": float("nan")}, "length: a finite number"),
        ({}, {"length": 0}, "working unit is 0"),
        ({}, {"span": [1.0]}, "span: 2 values are expected"),
        ({}, {"span": ["0", "1"]}, r"span\[0\]: a number is expected"),
        ({}, {"span": [2.0, 1.0]}, "ends before it begins"),
        ({}, {"settings": "all"}, "settings: an object is expected"),
        ({}, {"settings": {"iterations": 3, "salinity": 35}}, "salinity"),
        ({}, {"settings": {"render": "fine"}}, "render must be a mapping"),
        ({}, {"settings": {"iterations": -3}}, "iterations must be"),
        ({}, {"settings": {"render": {"near": -1.0}}}, "near"),
        ({}, {"frames": ["../../a.png", "b.png"]}, "outside its folder"),
        ({}, {"frames": ["a.png", "a.png"]}, "names a.png twice"),
        ({}, {"frames": ["a.png"]}, "for 1 frames"),
        ({"poses.cam2world": None}, {}, "poses.cam2world"),
        ({"poses.cam2world": torch.zeros(2, 4, 4)}, {}, "rotation"),
        ({"poses.cam2world": torch.full((2, 4, 4), torch.nan)}, {}, "poses.cam2world has values that are not finite"),
        ({"primitives.xyz": None}, {}, "primitives.xyz"),
        ({"primitives.xyz": torch.zeros(9, 3)}, {}, "different lengths|shape"),
        ({"primitives.xyz": torch.zeros(10, 2)}, {}, "primitives.xyz has the shape"),
        ({"primitives.xyz": torch.zeros(10, 3, dtype=torch.int64)}, {}, "primitives.xyz"),
        ({"primitives.opacity": torch.full((10,), torch.inf)}, {}, "opacity has values that are not finite"),
        ({"primitives.lower": torch.zeros(10, 14)}, {}, "numbers wide"),
        ({"primitives.query_mean": torch.zeros(10, 5)}, {}, "numbers wide"),
        ({"field.network.0.weight": torch.zeros(1, 1)}, {}, "network.0.weight"),
        ({"field.network.0.weight": None}, {}, "network.0.weight"),
        ({"viewpoint.K": None}, {}, "viewpoint.K"),
        ({"viewpoint.K": torch.eye(3)}, {}, "viewpoint has the shapes"),
        ({"viewpoint.cam2world": torch.zeros(1, 4, 4)}, {}, "rotation"),
        ({}, {"viewpoint": {"width": 0, "height": 5}}, "whole pixels"),
        ({}, {"viewpoint": [64, 48]}, "viewpoint: an object is expected"),
    ],
)
def test_a_map_that_is_damaged_is_refused(tmp_path, wall, camera, tensors, about, said):
    path = tmp_path / "map.safetensors"
    poses = RefinedPoses(("a.png", "b.png"), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1))
    replace(wall(10), poses=poses, viewpoint=camera()).save(path)
    load_map(path)
    rewritten(path, tensors, about)
    with pytest.raises(InputError, match=said) as raised:
        load_map(path)
    assert "map.safetensors is not a map that can be read (" in raised.value.what
    assert f"remove {tmp_path}" in raised.value.hint


@pytest.mark.parametrize("header", ["[" * 100_000, "[1]", '"text"', "null", "{"])
def test_a_header_that_is_no_record_is_refused(tmp_path, wall, header):
    path = tmp_path / "map.safetensors"
    save_file({"x": torch.zeros(2)}, path, {"swimm3r": header})
    with pytest.raises(InputError, match="not a map"):
        load_map(path)
