"""A network of the published shape, thousands of times smaller, with random weights."""

import pytest
import torch

from swimm3r.sfm.mast3r.network import Architecture, Mast3r

SMALL = Architecture(
    encoder_dim=64, encoder_depth=2, encoder_heads=1, decoder_dim=64, decoder_depth=4, decoder_heads=1,
    dpt_layer_dims=(4, 6, 8, 10), dpt_feature_dim=8, dpt_last_dims=(4, 4), local_hidden_dim=64, descriptor_dim=6,
)  # fmt: skip


@pytest.fixture(scope="session")
def small_network() -> Mast3r:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Mast3r(SMALL).eval().requires_grad_(False)
