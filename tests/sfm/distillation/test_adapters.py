"""Adapter files: no base weight in them, and whose network they belong to."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.sfm.distillation.training import BASE, SETTINGS, learned, nothing

from swimm3r.errors import WeightsError
from swimm3r.sfm.distillation.loop import train
from swimm3r.sfm.distillation.pairs import PairData
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.mast3r.settings import ObjectiveSettings
from swimm3r.sfm.student import adapter_file
from swimm3r.sfm.student.adapter_file import Base, fingerprint
from swimm3r.sfm.student.student import Student


def test_the_adapter_holds_no_base_weight_and_says_what_it_belongs_to(
    network: Mast3r, eight: PairData, none: PairData, tmp_path: Path
):
    base = Base("x.pth", fingerprint(network.state_dict()), "CC BY-NC-SA 4.0")
    path = train(network, base, eight, none, replace(SETTINGS, epochs=1), tmp_path, nothing)
    header = adapter_file.describe(path)
    assert header["base"] == {"name": "x.pth", "sha256": base.sha256, "license": "CC BY-NC-SA 4.0"}
    assert header["trained"]["settings"]["seed"] == 0
    names = learned(path).keys()
    assert all(".lora_" in name or name.startswith("head.") for name in names)
    assert not names & network.state_dict().keys()
    student = adapter_file.load(path, network, base.sha256)
    student.adapters.detach()
    with pytest.raises(WeightsError, match="trained on"):
        adapter_file.load(path, network, "f" * 64)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(WeightsError, match="cannot be used"):
        adapter_file.load(path, network)


def test_a_file_of_peft_alone_is_no_adapter_file(network: Mast3r, tmp_path: Path):
    from safetensors.torch import save_file

    save_file({"x": torch.zeros(1)}, tmp_path / "a.safetensors")
    with pytest.raises(WeightsError, match="it has no Swimm3R header"):
        adapter_file.load(tmp_path / "a.safetensors", network)


def test_one_network_has_one_fingerprint_whatever_its_file(network: Mast3r, tmp_path: Path):
    for name in ("a.pth", "a.safetensors"):
        checkpoint.save(network, tmp_path / name)
    marks = {fingerprint(checkpoint.read(tmp_path / name)[0]) for name in ("a.pth", "a.safetensors")}
    assert marks == {fingerprint(network.state_dict())}


def test_the_adapter_says_how_far_its_head_was_off_and_what_it_divided_by(
    network: Mast3r, eight: PairData, none: PairData, tmp_path: Path
):
    def validated(student: Student, data: PairData) -> dict:
        return {"loss": 1.0, "water_error": {"Binf": [0.1] * 3, "beta_D": [0.2] * 3, "beta_B": [0.3] * 3}}

    settings = replace(SETTINGS, epochs=1, objective=ObjectiveSettings(min_transmittance=0.2))
    path = train(network, BASE, eight, eight, settings, tmp_path / "held out", validated)
    facts = adapter_file.head_facts(path)
    assert facts.min_transmittance == 0.2
    assert facts.error is not None
    torch.testing.assert_close(facts.error.beta_D, torch.full((3,), 0.2))
    path = train(network, BASE, eight, none, settings, tmp_path / "nothing held out", validated)
    assert adapter_file.head_facts(path).error is None


@pytest.mark.parametrize(
    "header",
    [
        "[" * 100_000 + "]" * 100_000,
        "[]",
        '{"schema": 1, "base": 1}',
        '{"schema": 1, "base": {"name": "x", "sha256": "0", "license": ""}, "peft": {}, '
        '"objective": {"min_transmittance": "x"}, "trained": {}}',
    ],
)
def test_an_adapters_header_that_is_not_ours_is_refused_by_name(network: Mast3r, tmp_path: Path, header: str):
    from safetensors.torch import save_file

    path = tmp_path / "odd.safetensors"
    save_file({"x": torch.zeros(1)}, path, metadata={"swimm3r": header})
    with pytest.raises(WeightsError, match=r"odd\.safetensors cannot be used as an adapter"):
        adapter_file.load(path, network)
