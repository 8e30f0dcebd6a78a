"""Low-rank updates of a frozen network (LoRA, Hu et al. 2022): y = W x + (alpha / r) B A x, B = 0 at the start.

    attach(network, settings, generator) -> Adapters     the student; `with adapters.off():` it is the teacher again

Of a convolution A is one with the base's kernel, stride and padding to r channels, B a 1 x 1 convolution back. The
updates hang on the layers as forward hooks, so the network, its parameter names and its single copy of the weights
stay what they were. Each trained number of the paper's reading is counted in `LoraSettings.reading`.
"""

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor, nn

from swimm3r.sfm.mast3r.settings import LoraSettings

_PATCH = r"patch_embed\.proj"
_SELF_PROJ = r"(enc_blocks|dec_blocks2?)\.\d+\.attn\.proj"
_SELF_QKV = r"(enc_blocks|dec_blocks2?)\.\d+\.attn\.qkv"
_ENCODER_PROJ = r"enc_blocks\.\d+\.attn\.proj"
_ENCODER_ALL = r"enc_blocks\.\d+\.(attn\.(qkv|proj)|mlp\.fc[12])"
_EMBED = r"decoder_embed"
_CROSS = r"dec_blocks2?\.\d+\.cross_attn\.proj[qkv]?"
_READINGS = {
    "A": (_PATCH, _SELF_PROJ),
    "A2": (_PATCH, _ENCODER_PROJ),
    "B": (_PATCH, _EMBED),
    "C": (_PATCH, _SELF_PROJ, _SELF_QKV, _EMBED),
    "D": (_PATCH, _ENCODER_ALL, _EMBED),
}


class LowRank(nn.Module):
    """The trained update of one Linear or Conv2d layer, float32; zero until B is trained."""

    def __init__(self, base: nn.Linear | nn.Conv2d, rank: int, alpha: float, generator: torch.Generator) -> None:
        super().__init__()
        if rank < 1:
            raise ValueError(f"a rank is 1 or more, got {rank}")
        self.rank, self.alpha = rank, alpha
        device = "meta" if base.weight.is_meta else "cpu"  # drawn on the CPU: the same numbers on every machine
        if isinstance(base, nn.Linear):
            self.lora_A: nn.Linear | nn.Conv2d = nn.Linear(base.in_features, rank, bias=False, device=device)
            self.lora_B: nn.Linear | nn.Conv2d = nn.Linear(rank, base.out_features, bias=False, device=device)
        else:
            if base.groups != 1 or base.dilation != (1, 1) or base.padding_mode != "zeros":
                raise ValueError("low-rank updates of grouped, dilated or wrapped convolutions are not defined here")
            kernel = (base.kernel_size[0], base.kernel_size[1])
            stride = (base.stride[0], base.stride[1])
            padding = base.padding if isinstance(base.padding, str) else (base.padding[0], base.padding[1])
            self.lora_A = nn.Conv2d(base.in_channels, rank, kernel, stride, padding, bias=False, device=device)
            self.lora_B = nn.Conv2d(rank, base.out_channels, 1, bias=False, device=device)
        if device == "cpu":
            nn.init.kaiming_uniform_(self.lora_A.weight, a=math.sqrt(5), generator=generator)
            nn.init.zeros_(self.lora_B.weight)
            self.to(base.weight.device)

    @property
    def scale(self) -> float:
        return self.alpha / self.rank

    def forward(self, x: Float[Tensor, " b *inner"]) -> Float[Tensor, " b *outer"]:
        """The term that is added to the layer's output."""
        return self.scale * self.lora_B(self.lora_A(x.to(self.lora_A.weight.dtype)))

    def weight_update(self) -> Float[Tensor, " out *inner"]:
        """The matrix that has the same effect when added to the layer's weight."""
        A, B = self.lora_A.weight, self.lora_B.weight
        return self.scale * (B.flatten(1) @ A.flatten(1)).unflatten(1, A.shape[1:])


class Adapters(nn.Module):
    """The updates of a network, hanging on its layers; its parameters are all that is trained of the network."""

    def __init__(
        self,
        network: nn.Module,
        ranks: Mapping[str, int],
        alphas: Mapping[str, float],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.names = tuple(ranks)  # of the adapted layers
        self.updates = nn.ModuleList()
        self._on = True
        self._bases: list[nn.Linear | nn.Conv2d] = []
        for name, rank in ranks.items():
            base = _layer(network, name)
            self._bases.append(base)
            self.updates.append(LowRank(base, rank, alphas[name], generator))
        # outside the module tree: the network's weights are not the adapters' to move, count or store
        self._handles = [
            base.register_forward_hook(self._hook(update)) for base, update in zip(self._bases, self, strict=True)
        ]

    def __iter__(self) -> Iterator[LowRank]:
        return (update for update in self.updates if isinstance(update, LowRank))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def on(self) -> bool:
        """Return whether the network is the student now."""
        return self._on

    @contextmanager
    def off(self) -> Iterator[None]:
        """Inside, the network is the one it was before: the teacher."""
        before, self._on = self._on, False
        try:
            yield
        finally:
            self._on = before

    def detach(self) -> None:
        """Takes the updates off the network for good."""
        for handle in self._handles:
            handle.remove()
        self._handles = []

    @torch.no_grad()
    def merge(self) -> None:
        """Adds the updates to the network's weights and takes them off: the same student, as fast as the plain network.

        Raises ValueError where they were merged or detached before.
        """
        if not self._handles:
            raise ValueError("these adapters do not hang on a network any more")
        for base, update in zip(self._bases, self, strict=True):
            # a new tensor: the old one may be pages of the checkpoint's file
            base.weight.data = (base.weight.float() + update.weight_update()).to(base.weight.dtype)
        self.detach()

    def _hook(self, update: LowRank):
        def add(layer: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor | None:
            return output + update(inputs[0]).to(output.dtype) if self._on else None

        return add


def attach(network: nn.Module, settings: LoraSettings, generator: torch.Generator) -> Adapters:
    """New updates on the layers that the settings name; the network computes what it did until they are trained."""
    ranks = targets(network, settings)
    return Adapters(network, ranks, {n: settings.alpha_per_rank * r for n, r in ranks.items()}, generator)


def targets(network: nn.Module, settings: LoraSettings) -> dict[str, int]:
    """The layers to be adapted, in the network's order, and their ranks."""
    ranks = {}
    for name, _ in network.named_modules():
        if re.fullmatch(_CROSS, name):
            ranks[name] = settings.cross_rank
        elif any(re.fullmatch(pattern, name) for pattern in _READINGS[settings.reading]):
            ranks[name] = settings.rank
    return ranks


def _layer(network: nn.Module, name: str) -> nn.Linear | nn.Conv2d:
    try:
        layer = network.get_submodule(name)
    except AttributeError as error:
        raise ValueError(f"the network has no layer {name}") from error
    if not isinstance(layer, nn.Linear | nn.Conv2d):
        raise ValueError(f"{name} is a {type(layer).__name__}; Linear and Conv2d layers can be adapted")
    return layer
