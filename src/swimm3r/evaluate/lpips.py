"""LPIPS v0.1 (Zhang et al. 2018) with published weights; without them there is no score.

    LPIPS(x, y) = sum over taps l of the pixel mean of w_l . (f_l(x) / |f_l(x)| - f_l(y) / |f_l(y)|)^2

f_l are the activations after chosen ReLUs of an ImageNet network (VGG16 or AlexNet, keys `features.N.weight|bias` of
torchvision's state dicts), w_l the learnt non-negative channel weights (keys `lin0..4.model.1.weight`, [1, C, 1, 1]).
The input scaling was made for values in -1..1. 3DGS and its kin feed 0..1 to VGG without mapping it (`inputs="0..1"`,
the default, comparable with their tables); gsplat's AlexNet numbers map first (`inputs="-1..1"`).
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, relu

from swimm3r.errors import WeightsError
from swimm3r.evaluate import NotComputed

Backbone = Literal["vgg", "alex"]
Inputs = Literal["0..1", "-1..1"]

# sha256 of the published files: the trunks' names hold the first 8 digits, the heads are those of lpips v0.1
SHA256 = {
    "vgg16-397923af.pth": "397923af",
    "alexnet-owt-7be5be79.pth": "7be5be79",
    "vgg.pth": "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
    "alex.pth": "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
}
TRUNK_FILE = {"vgg": "vgg16-397923af.pth", "alex": "alexnet-owt-7be5be79.pth"}
HEADS_FILE = {"vgg": "vgg.pth", "alex": "alex.pth"}


@dataclass(frozen=True)
class _Conv:
    index: int  # in torchvision's `features`; a ReLU follows
    tap: bool = False  # LPIPS reads the activation
    stride: int = 1
    padding: int = 1
    pool: int = 0  # window of the max pooling in front, stride 2


_LAYERS: dict[str, tuple[_Conv, ...]] = {
    "vgg": (
        *(_Conv(0), _Conv(2, tap=True)),
        *(_Conv(5, pool=2), _Conv(7, tap=True)),
        *(_Conv(10, pool=2), _Conv(12), _Conv(14, tap=True)),
        *(_Conv(17, pool=2), _Conv(19), _Conv(21, tap=True)),
        *(_Conv(24, pool=2), _Conv(26), _Conv(28, tap=True)),
    ),
    "alex": (
        _Conv(0, tap=True, stride=4, padding=2),
        _Conv(3, tap=True, padding=2, pool=3),
        _Conv(6, tap=True, pool=3),
        _Conv(8, tap=True),
        _Conv(10, tap=True),
    ),
}


@dataclass(frozen=True)
class Lpips:
    """Loaded weights and the convention they are used with."""

    backbone: Backbone
    inputs: Inputs
    trunk: dict[str, Tensor]
    heads: tuple[Float[Tensor, " _"], ...]

    @property
    def variant(self) -> str:
        """The name that travels with the number."""
        return f"LPIPS {self.backbone}, inputs {self.inputs}"


def load_lpips(
    trunk: Path | None, heads: Path | None, backbone: Backbone = "vgg", inputs: Inputs = "0..1"
) -> Lpips | NotComputed:
    """LPIPS from the published trunk and heads; NotComputed, naming the files, where one of them is not there.

    Raises WeightsError where a file is there but is not the published one (sha256).
    """
    for path, name in ((trunk, TRUNK_FILE[backbone]), (heads, HEADS_FILE[backbone])):
        if path is None or not path.is_file():
            return NotComputed(f"LPIPS {backbone} needs {name}, which is not at {path or 'any known place'}")
    assert trunk is not None
    assert heads is not None
    heads_state = _read(heads, HEADS_FILE[backbone])
    return Lpips(
        backbone,
        inputs,
        {key: v for key, v in _read(trunk, TRUNK_FILE[backbone]).items() if key.startswith("features.")},
        tuple(heads_state[f"lin{k}.model.1.weight"].flatten() for k in range(len(heads_state))),
    )


@torch.no_grad()
def lpips(render: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], model: Lpips) -> float:
    """Perceptual distance of two images in 0..1; 0 for equal ones."""
    if min(render.shape[:2]) < 32:
        raise ValueError(f"LPIPS needs at least 32 pixels a side, got {tuple(render.shape[:2])}")
    x = torch.stack((render, target)).permute(0, 3, 1, 2).float()
    distance = 0.0
    for (f, g), head in zip(_activations(x, model), model.heads, strict=True):
        distance += (head[:, None, None] * (_unit(f) - _unit(g)) ** 2).sum(0).mean().item()
    return distance


def _activations(x: Float[Tensor, "2 3 h w"], model: Lpips) -> list[Tensor]:
    if model.inputs == "-1..1":
        x = 2 * x - 1
    shift, scale = x.new_tensor([-0.030, -0.088, -0.188]), x.new_tensor([0.458, 0.448, 0.450])
    x = (x - shift[:, None, None]) / scale[:, None, None]
    taps = []
    for c in _LAYERS[model.backbone]:
        if c.pool:
            x = max_pool2d(x, c.pool, stride=2)
        weight, bias = model.trunk[f"features.{c.index}.weight"], model.trunk[f"features.{c.index}.bias"]
        x = relu(conv2d(x, weight, bias, stride=c.stride, padding=c.padding))
        if c.tap:
            taps.append(x)
    return taps


def _unit(f: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    return f / (f.norm(dim=0, keepdim=True) + 1e-10)


def _read(path: Path, published: str) -> dict[str, Tensor]:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if not digest.startswith(SHA256[published]):
        raise WeightsError(
            f"{path} is not the published {published}: its sha256 is {digest}",
            cause="a download that broke off, or weights of another training, whose scores compare with nobody's",
            hint=f"fetch {published} again; its sha256 begins with {SHA256[published][:16]}",
        )
    state = torch.load(path, map_location="cpu", weights_only=True)
    return {key: value.float() for key, value in state.items()}
