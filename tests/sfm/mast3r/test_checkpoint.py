"""Checkpoints come back as they went in, and every bad file is refused by name."""

import argparse
import json
import math
import os
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from swimm3r.errors import WeightsError
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.mast3r.network import Mast3r

PUBLISHED_CALL = (
    "AsymmetricMASt3R(enc_depth=24, dec_depth=12, enc_embed_dim=1024, dec_embed_dim=768, enc_num_heads=16, "
    "dec_num_heads=12, pos_embed='RoPE100', img_size=(512, 512), head_type='catmlp+dpt', output_mode='pts3d+desc24', "
    "depth_mode=('exp', -inf, inf), conf_mode=('exp', 1, inf), two_confs=True, desc_conf_mode=('exp', 0, inf))"
)


@pytest.fixture
def state(small_network: Mast3r) -> dict[str, torch.Tensor]:
    return {k: v.clone() for k, v in small_network.state_dict().items()}


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_network_comes_back_from_its_file(small_network: Mast3r, tmp_path: Path, suffix: str):
    path = tmp_path / f"network{suffix}"
    checkpoint.save(small_network, path)
    loaded = checkpoint.load(path)
    assert loaded.architecture == small_network.architecture
    assert not loaded.training
    assert not any(p.requires_grad for p in loaded.parameters())
    for key, value in small_network.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[key], value, atol=0, rtol=0)
    assert os.listdir(tmp_path) == [path.name]


def test_exports_hold_the_published_names(small_network: Mast3r, tmp_path: Path):
    checkpoint.save(small_network, tmp_path / "n.pth")
    checkpoint.save(small_network, tmp_path / "n.safetensors")
    both = torch.load(tmp_path / "n.pth", weights_only=False)["model"]
    once = load_file(tmp_path / "n.safetensors")
    assert set(both) == set(small_network.state_dict())
    assert set(both) - set(once) == {k for k in both if ".layer_rn." in k}
    assert len(both) - len(once) == 8


@pytest.mark.parametrize("kept", ["layer_rn.", "_rn.weight"], ids=["numbered twins left out", "named twins left out"])
def test_either_name_of_the_input_convolutions_is_enough(
    small_network: Mast3r, state: dict[str, torch.Tensor], tmp_path: Path, kept: str
):
    state = {k: v for k, v in state.items() if kept not in k}
    save_file(state, tmp_path / "n.safetensors")
    loaded = checkpoint.load(tmp_path / "n.safetensors").state_dict()
    for key, value in small_network.state_dict().items():
        torch.testing.assert_close(loaded[key], value, atol=0, rtol=0)


def test_trunk_takes_the_asked_precision_and_the_heads_stay_exact(small_network: Mast3r, tmp_path: Path):
    checkpoint.save(small_network, tmp_path / "n.safetensors")
    loaded = checkpoint.load(tmp_path / "n.safetensors", dtype=torch.bfloat16)
    kinds = {k.split(".")[0]: v.dtype for k, v in loaded.state_dict().items()}
    assert kinds.pop("downstream_head1") == kinds.pop("downstream_head2") == torch.float32
    assert set(kinds.values()) == {torch.bfloat16}


@pytest.mark.parametrize("text", ["[" * 100_000 + "]" * 100_000, "{", "[]", "\udcff"])
def test_a_damaged_config_beside_the_file_is_refused_by_name(small_network: Mast3r, tmp_path: Path, text: str):
    checkpoint.save(small_network, tmp_path / "n.safetensors")
    (tmp_path / "config.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(WeightsError, match=r"config\.json"):
        checkpoint.load(tmp_path / "n.safetensors")


@pytest.mark.parametrize(
    ("key", "odd"),
    [
        ("patch_embed.proj.weight", (4,)),
        ("patch_embed.proj.weight", (0, 3, 16, 16)),
        ("decoder_embed.weight", ()),
        ("downstream_head1.head_local_features.fc2.weight", (3,)),
        ("downstream_head1.dpt.scratch.layer1_rn.weight", (5,)),
    ],
)
def test_tensors_of_odd_shapes_are_refused_by_name(
    state: dict[str, torch.Tensor], tmp_path: Path, key: str, odd: tuple[int, ...]
):
    state = {k: v for k, v in state.items() if ".layer_rn." not in k}
    save_file(state | {key: torch.zeros(odd)}, tmp_path / "n.safetensors")
    with pytest.raises(WeightsError, match=key.replace(".", r"\.")):
        checkpoint.load(tmp_path / "n.safetensors")


def test_published_constructor_call_is_read_without_running_it():
    arguments = checkpoint.parse_arguments(PUBLISHED_CALL)
    assert arguments["enc_num_heads"] == 16
    assert arguments["depth_mode"] == ("exp", -math.inf, math.inf)
    assert arguments["two_confs"] is True


@pytest.mark.parametrize(
    "call",
    [
        "__import__('os').system('true')",
        "A(x=__import__('os'))",
        "A(x=[y for y in (1,)])",
        "A(**{})",
        "A(1)",
        "A(",
        "A(x=-'1')",
    ],
)
def test_constructor_call_with_anything_but_plain_values_is_refused(call: str):
    with pytest.raises(ValueError, match=r"^not a"):
        checkpoint.parse_arguments(call)


def test_numbers_of_heads_come_from_the_arguments(state: dict[str, torch.Tensor], tmp_path: Path):
    save_file({k: v for k, v in state.items() if ".layer_rn." not in k}, tmp_path / "model.safetensors")
    assert checkpoint.load(tmp_path / "model.safetensors").architecture.encoder_heads == 1  # 64 channels each
    (tmp_path / "config.json").write_text(json.dumps({"enc_num_heads": 4, "dec_num_heads": 2, "img_size": [512, 512]}))
    architecture = checkpoint.load(tmp_path / "model.safetensors").architecture
    assert (architecture.encoder_heads, architecture.decoder_heads) == (4, 2)


def test_one_decoder_of_a_pre_training_serves_both_views(state: dict[str, torch.Tensor]):
    single = {k: v for k, v in state.items() if not k.startswith("dec_blocks2.")}
    double = checkpoint.duplicate_decoder(single)
    assert set(double) == set(state)
    assert torch.equal(double["dec_blocks2.3.mlp.fc1.weight"], single["dec_blocks.3.mlp.fc1.weight"])
    assert set(checkpoint.duplicate_decoder(state)) == set(state)
    assert checkpoint.duplicate_decoder(state)["dec_blocks2.0.norm1.bias"] is state["dec_blocks2.0.norm1.bias"]


class _Code:
    def __reduce__(self):
        return os.mkdir, ("pwned",)


def _truncate(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("missing.pth", lambda path: path.unlink(), "there is no checkpoint at"),
        ("truncated.pth", _truncate, "cannot be read"),
        ("truncated.safetensors", _truncate, "cannot be read"),
        ("text.pth", lambda path: path.write_text("<html>404</html>"), "cannot be read"),
        ("text.safetensors", lambda path: path.write_text("<html>404</html>"), "cannot be read"),
        ("empty.pth", lambda path: path.write_bytes(b""), "cannot be read"),
        ("code.pth", lambda path: torch.save({"model": {}, "args": _Code()}, path), "holds more than weights"),
        ("bare.pth", lambda path: path.write_bytes(pickle.dumps(_Code())), "cannot be read"),
        ("list.pth", lambda path: torch.save([1, 2], path), "holds no state dict"),
        ("other.pth", lambda path: torch.save({"fc.weight": torch.zeros(2)}, path), "not of the DUSt3R family"),
        (
            "dune.pth",
            lambda path: torch.save({"dune_backbone_name": "x", "model": {"a": torch.zeros(1)}}, path),
            "DUNE variant",
        ),
        (
            "call.pth",
            lambda path: torch.save(
                {"args": argparse.Namespace(model="A(x=open('f'))"), "model": {"a": torch.zeros(1)}}, path
            ),
            "in a way that cannot be read",
        ),
    ],
)
def test_bad_file_is_refused_by_name(
    small_network: Mast3r, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, damage, message: str
):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / name
    checkpoint.save(small_network, path)
    damage(path)
    with pytest.raises(WeightsError, match=message) as caught:
        checkpoint.load(path)
    assert caught.value.exit_code == 4
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("enc_norm.bias"), "lacks 1 tensors of the network, the first enc_norm.bias"),
        (lambda s: s.pop("patch_embed.proj.weight"), "no patch embedding"),
        (lambda s: s.pop("downstream_head1.head_local_features.fc1.weight"), "predicts no descriptors"),
        (lambda s: s.update(extra=torch.zeros(1)), "1 tensors the network does not have, the first extra"),
        (lambda s: s.update({"enc_norm.bias": torch.zeros(3)}), r"enc_norm.bias has shape \(3,\)"),
        (lambda s: s.update({"enc_norm.bias": torch.zeros(64, dtype=torch.int64)}), "not weights"),
        (
            lambda s: s.update({k: v + 1 for k, v in s.items() if ".layer_rn.0." in k}),
            "must be one tensor, and differ",
        ),
    ],
)
def test_state_dict_of_another_model_is_refused(state: dict[str, torch.Tensor], tmp_path: Path, change, message: str):
    change(state)
    torch.save({"model": state}, tmp_path / "n.pth")
    with pytest.raises(WeightsError, match=message):
        checkpoint.load(tmp_path / "n.pth")


def test_heads_that_do_not_divide_the_channels_are_refused(state: dict[str, torch.Tensor]):
    with pytest.raises(WeightsError, match="7 attention heads do not divide 64 channels"):
        checkpoint.infer_architecture(state, {"enc_num_heads": 7})
