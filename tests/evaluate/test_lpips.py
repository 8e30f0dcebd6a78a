"""The trunks against torch.nn modules in torchvision's order; no weights, no score; wrong weights, an error."""

import hashlib
from typing import Any

import pytest
import torch
from torch import nn

from swimm3r.errors import WeightsError
from swimm3r.evaluate import NotComputed
from swimm3r.evaluate import lpips as module
from swimm3r.evaluate.images import view_scores
from swimm3r.evaluate.lpips import Lpips, load_lpips, lpips

TAPS = {"vgg": (3, 8, 15, 22, 29), "alex": (1, 4, 7, 9, 11)}


def published_layout(backbone: str) -> nn.Sequential:
    """`features` of the network as torchvision numbers its layers, drawn at random."""
    torch.manual_seed(0)
    if backbone == "alex":
        return nn.Sequential(
            nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
            nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
            nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
            nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
            nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(),
        )  # fmt: skip
    layers, before = [], 3
    for channels in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if channels:
            layers += [nn.Conv2d(before, channels, 3, padding=1), nn.ReLU()]
            before = channels
        else:
            layers.append(nn.MaxPool2d(2, 2))
    return nn.Sequential(*layers)


@pytest.fixture(scope="module", params=["vgg", "alex"])
def weights(request, tmp_path_factory):
    """Random weights in the published files' form: backbone, trunk network, heads, folder."""
    backbone = request.param
    folder = tmp_path_factory.mktemp(backbone)
    features = published_layout(backbone)
    torch.save({f"features.{k}": v for k, v in features.state_dict().items()}, folder / "trunk.pth")
    layers: Any = features
    channels = [layers[t - 1].out_channels for t in TAPS[backbone]]
    heads = {f"lin{k}.model.1.weight": torch.rand(1, c, 1, 1) for k, c in enumerate(channels)}
    torch.save(heads, folder / "heads.pth")
    return backbone, features, list(heads.values()), folder


@pytest.fixture
def trusted(weights, monkeypatch):
    """The random files pass for the published ones."""
    backbone, *_, folder = weights
    for file, name in (("trunk.pth", module.TRUNK_FILE[backbone]), ("heads.pth", module.HEADS_FILE[backbone])):
        monkeypatch.setitem(module.SHA256, name, hashlib.sha256((folder / file).read_bytes()).hexdigest())


def images() -> tuple[torch.Tensor, torch.Tensor]:
    a, b = torch.rand(2, 65, 70, 3, generator=torch.Generator().manual_seed(1))
    return a, b


@pytest.mark.usefixtures("trusted")
@pytest.mark.parametrize("inputs", ["0..1", "-1..1"])
@torch.no_grad()
def test_distance_is_that_of_the_network_written_with_modules(weights, inputs):
    backbone, features, heads, folder = weights
    a, b = images()
    x = torch.stack((a, b)).permute(0, 3, 1, 2)
    x = x if inputs == "0..1" else 2 * x - 1
    x = (x - torch.tensor([-0.030, -0.088, -0.188]).view(3, 1, 1)) / torch.tensor([0.458, 0.448, 0.450]).view(3, 1, 1)
    expected, taps = 0.0, dict(zip(TAPS[backbone], heads, strict=True))
    for index, layer in enumerate(features):
        x = layer(x)
        if index in taps:
            unit = nn.functional.normalize(x, dim=1)
            expected += nn.functional.conv2d((unit[:1] - unit[1:]) ** 2, taps[index]).mean().item()
    model = load_lpips(folder / "trunk.pth", folder / "heads.pth", backbone, inputs)
    assert not isinstance(model, NotComputed)
    assert lpips(a, b, model) == pytest.approx(expected, rel=1e-4)
    assert lpips(a, a, model) == 0
    assert lpips(a, b, model) == pytest.approx(lpips(b, a, model), rel=1e-6)
    assert model.variant == f"LPIPS {backbone}, inputs {inputs}"


@pytest.mark.usefixtures("trusted")
def test_views_carry_the_backbone_beside_the_number(weights):
    backbone, _, _, folder = weights
    model = load_lpips(folder / "trunk.pth", folder / "heads.pth", backbone)
    scores = view_scores(*images(), model)
    assert isinstance(scores.lpips, float)
    assert f"LPIPS {backbone}" in scores.variant


def test_without_weights_there_is_no_score_and_the_file_is_named(tmp_path):
    for trunk in (None, tmp_path / "elsewhere.pth"):
        missing = load_lpips(trunk, None, "vgg")
        assert isinstance(missing, NotComputed)
        assert "vgg16-397923af.pth" in missing.reason


def test_weights_that_are_not_the_published_ones_are_refused(weights):
    backbone, _, _, folder = weights
    with pytest.raises(WeightsError, match="not the published"):
        load_lpips(folder / "trunk.pth", folder / "heads.pth", backbone)


@pytest.mark.usefixtures("trusted")
def test_a_image_too_small_for_the_trunk_is_refused(weights):
    backbone, _, _, folder = weights
    model = load_lpips(folder / "trunk.pth", folder / "heads.pth", backbone)
    assert isinstance(model, Lpips)
    with pytest.raises(ValueError, match="32 pixels"):
        lpips(torch.zeros(31, 64, 3), torch.zeros(31, 64, 3), model)
