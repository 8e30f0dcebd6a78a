"""Files that are not maps are refused in plain words."""

import json
from dataclasses import asdict

import pytest
import torch
from safetensors.torch import save_file

from swimm3r.errors import InputError
from swimm3r.splat.checkpoint import Stored, load_map, read, save_map, settings_from, write
from swimm3r.splat.settings import RenderSettings, UwbsSettings


def test_settings_survive_their_dictionary():
    settings = UwbsSettings(iterations=7, render=RenderSettings(depth="z"))
    assert settings_from(UwbsSettings, asdict(settings)) == settings


def test_tensors_and_header_come_back(tmp_path):
    write(tmp_path / "a.safetensors", Stored({"x": torch.arange(5)}, {"step": 3}))
    stored = read(tmp_path / "a.safetensors")
    assert torch.equal(stored.tensors["x"], torch.arange(5))
    assert stored.about["step"] == 3


def test_a_damaged_file_and_a_strangers_file_are_refused(tmp_path, wall):
    path = tmp_path / "map.safetensors"
    with pytest.raises(InputError):
        load_map(path)
    path.write_bytes(b"not a map")
    with pytest.raises(InputError):
        load_map(path)
    save_file({"x": torch.zeros(2)}, path)
    with pytest.raises(InputError, match="header"):
        load_map(path)
    write(path, Stored({"x": torch.zeros(2)}, {"recipe": "splatfacto"}))
    with pytest.raises(InputError, match="splatfacto"):
        load_map(path)
    save_map(path, wall(10))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError):
        load_map(path)


def test_a_map_of_a_newer_version_says_so(tmp_path, wall):
    path = tmp_path / "map.safetensors"
    save_map(path, wall(10))
    stored = read(path)
    header = {"swimm3r": json.dumps({**stored.about, "schema": 2})}
    save_file(stored.tensors, path, header)
    with pytest.raises(InputError, match="newer Swimm3R: its schema is 2, this version reads 1"):
        load_map(path)


def test_a_map_without_its_water_or_with_settings_nobody_knows_is_refused(tmp_path, wall):
    path = tmp_path / "map.safetensors"
    save_map(path, wall(10))
    stored = read(path)
    dry = {name: values for name, values in stored.tensors.items() if not name.startswith("field.network.0")}
    write(path, Stored(dry, stored.about))
    with pytest.raises(InputError, match="not a map"):
        load_map(path)
    write(path, Stored(stored.tensors, {**stored.about, "settings": {"iterations": 3, "salinity": 35}}))
    with pytest.raises(InputError, match="salinity"):
        load_map(path)
