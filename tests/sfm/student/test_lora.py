"""Low-rank updates: what they add, when they are off, what merging does, and that PEFT says the same."""

import copy
import json

import pytest
import torch
from torch import nn

from swimm3r.errors import WeightsError
from swimm3r.sfm.mast3r.network import Architecture, Mast3r
from swimm3r.sfm.mast3r.settings import LoraSettings
from swimm3r.sfm.student.lora import Adapters, LowRank, attach, targets
from swimm3r.sfm.student.peft_format import read_peft, write_peft

IMAGES = torch.rand(2, 3, 32, 48, generator=torch.Generator().manual_seed(1)) * 2 - 1


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def network(small_network: Mast3r) -> Mast3r:
    return copy.deepcopy(small_network)


def randomized(adapters: Adapters) -> Adapters:
    """As after training: B is not zero any more."""
    g = torch.Generator().manual_seed(7)
    for update in adapters:
        update.lora_B.weight.data.normal_(std=0.1, generator=g)
    return adapters


def forward(network: Mast3r) -> torch.Tensor:
    a, b = network.encode(IMAGES[:1]), network.encode(IMAGES[1:])
    views = network.decode(a, b)
    return torch.cat([t.flatten() for view in views for t in view.tokens])


def test_a_new_adapter_changes_nothing(network: Mast3r):
    before = forward(network)
    attach(network, LoraSettings(), generator())
    assert torch.equal(forward(network), before)


def test_the_update_of_a_linear_layer_is_the_printed_formula():
    base = nn.Linear(5, 4)
    update = LowRank(base, rank=2, alpha=6.0, generator=generator())
    update.lora_B.weight.data.normal_(generator=generator())
    x = torch.randn(3, 5, generator=generator())
    expected = 3.0 * (update.lora_B.weight @ (update.lora_A.weight @ x.T)).T
    torch.testing.assert_close(update(x), expected)
    torch.testing.assert_close(x @ update.weight_update().T, expected)


def test_the_update_of_a_convolution_is_a_convolution_with_its_merged_weight():
    base = nn.Conv2d(3, 7, 4, stride=2, padding=1)
    update = LowRank(base, rank=2, alpha=1.0, generator=generator())
    update.lora_B.weight.data.normal_(generator=generator())
    x = torch.randn(2, 3, 12, 10, generator=generator())
    merged = nn.functional.conv2d(x, update.weight_update(), stride=2, padding=1)
    torch.testing.assert_close(update(x), merged)


def test_switched_off_the_network_is_the_teacher_again_and_on_again_afterwards(network: Mast3r):
    teacher = forward(network)
    adapters = randomized(attach(network, LoraSettings(), generator()))
    student = forward(network)
    assert not torch.allclose(student, teacher, atol=1e-3)
    with adapters.off():
        assert not adapters.on
        assert torch.equal(forward(network), teacher)
    assert torch.equal(forward(network), student)
    with pytest.raises(KeyError), adapters.off():
        raise KeyError
    assert adapters.on


def test_merging_keeps_the_student_and_its_parameter_names(network: Mast3r):
    names = set(network.state_dict())
    adapters = randomized(attach(network, LoraSettings(), generator()))
    assert set(network.state_dict()) == names
    student = forward(network)
    adapters.merge()
    torch.testing.assert_close(forward(network), student, atol=1e-5, rtol=1e-5)
    assert set(network.state_dict()) == names
    with pytest.raises(ValueError, match="any more"):
        adapters.merge()


def test_only_the_adapters_get_a_gradient(network: Mast3r):
    adapters = randomized(attach(network, LoraSettings(), generator()))
    forward(network).square().mean().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in adapters.parameters())
    assert all(p.grad is None for p in network.parameters())


def test_a_low_precision_trunk_keeps_its_dtype(network: Mast3r):
    network.set_precision(torch.bfloat16)
    adapters = randomized(attach(network, LoraSettings(), generator()))
    assert network.encode(IMAGES).tokens.dtype == torch.bfloat16
    assert all(p.dtype == torch.float32 for p in adapters.parameters())


@pytest.mark.parametrize(
    ("reading", "trained"),
    [("A", 2_584_576), ("A2", 1_994_752), ("B", 1_236_992), ("C", 5_365_760), ("D", 7_528_448)],
)
def test_each_reading_trains_as_many_numbers_of_the_published_network_as_the_specification_counts(reading, trained):
    with torch.device("meta"):
        full = Mast3r(Architecture())
    adapters = attach(full, LoraSettings(reading=reading), generator())
    assert sum(p.numel() for p in adapters.parameters()) == trained


def test_the_papers_ranks_are_16_on_projections_and_8_on_cross_attention(network: Mast3r):
    ranks = targets(network, LoraSettings())
    assert ranks["patch_embed.proj"] == ranks["enc_blocks.1.attn.proj"] == ranks["dec_blocks2.3.attn.proj"] == 16
    assert ranks["dec_blocks.0.cross_attn.projq"] == ranks["dec_blocks2.0.cross_attn.proj"] == 8
    assert len(ranks) == 1 + 2 + 8 + 32


def test_a_layer_that_is_not_there_or_not_linear_is_refused(network: Mast3r):
    with pytest.raises(ValueError, match="no layer"):
        Adapters(network, {"enc_blocks.9.attn.proj": 4}, {"enc_blocks.9.attn.proj": 4.0}, generator())
    with pytest.raises(ValueError, match="LayerNorm"):
        Adapters(network, {"enc_norm": 4}, {"enc_norm": 4.0}, generator())


def test_written_and_read_the_student_is_the_same(network: Mast3r, small_network: Mast3r, tmp_path):
    adapters = randomized(attach(network, LoraSettings(alpha_per_rank=2.0), generator()))
    write_peft(adapters, tmp_path / "adapter", base="a checkpoint")
    other = copy.deepcopy(small_network)
    again = read_peft(tmp_path / "adapter", other)
    assert set(again.names) == set(adapters.names)
    assert torch.equal(forward(other), forward(network))


def test_peft_computes_the_same_from_our_folder_and_we_from_its(network: Mast3r, small_network: Mast3r, tmp_path):
    peft = pytest.importorskip("peft", reason="the dev extra has it")
    adapters = randomized(attach(network, LoraSettings(), generator()))
    write_peft(adapters, tmp_path / "ours")
    theirs = peft.PeftModel.from_pretrained(copy.deepcopy(small_network), tmp_path / "ours")
    assert not theirs.peft_config["default"].use_dora
    expected = forward(network)
    torch.testing.assert_close(forward(theirs.base_model.model), expected, atol=1e-5, rtol=1e-5)

    theirs.save_pretrained(tmp_path / "theirs")
    other = copy.deepcopy(small_network)
    read_peft(tmp_path / "theirs", other)
    torch.testing.assert_close(forward(other), expected, atol=1e-5, rtol=1e-5)


def test_a_rank_stabilized_adapter_of_peft_is_read_with_its_scale(small_network: Mast3r, tmp_path):
    peft = pytest.importorskip("peft", reason="the dev extra has it")
    config = peft.LoraConfig(r=4, lora_alpha=3, use_rslora=True, target_modules=["decoder_embed", "patch_embed.proj"])
    theirs = peft.get_peft_model(copy.deepcopy(small_network), config)
    for name, parameter in theirs.named_parameters():
        if "lora_B" in name:
            parameter.data.normal_(std=0.1, generator=generator())
    theirs.save_pretrained(tmp_path)
    network = copy.deepcopy(small_network)
    read_peft(tmp_path, network)
    torch.testing.assert_close(forward(network), forward(theirs.base_model.model), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "said"),
    [({"use_dora": True}, "use_dora"), ({"peft_type": "IA3"}, "IA3"), ({"bias": "all"}, "biases")],
)
def test_what_is_more_than_a_low_rank_update_is_refused_by_name(network: Mast3r, tmp_path, change, said):
    write_peft(attach(network, LoraSettings(), generator()), tmp_path)
    config = tmp_path / "adapter_config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | change))
    with pytest.raises(WeightsError, match=said):
        read_peft(tmp_path, network)


def test_an_adapter_of_another_network_is_refused(network: Mast3r, tmp_path):
    write_peft(attach(network, LoraSettings(), generator()), tmp_path)
    wider = Architecture(encoder_dim=32, encoder_depth=2, encoder_heads=1, decoder_dim=32, decoder_depth=4,
                         decoder_heads=1, dpt_layer_dims=(4, 6, 8, 10), dpt_feature_dim=8, dpt_last_dims=(4, 4),
                         local_hidden_dim=64, descriptor_dim=6)  # fmt: skip
    with pytest.raises(WeightsError, match="expected"):
        read_peft(tmp_path, Mast3r(wider))
    with pytest.raises(WeightsError, match=r"adapter_config\.json"):
        read_peft(tmp_path / "nowhere", network)
