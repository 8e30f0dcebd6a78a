"""Output heads for the tokens of one view: a pointmap with confidence (DPT) and pixel descriptors (MLP).

    points      = x / |x| * (e^|x| - 1)        metres, in the frame of camera 1
    confidence  = 1 + e^c                      in [1, inf)
    descriptors = v / |v|,  their confidence e^c in (0, inf)

The four maps that feed the DPT (Ranftl et al. 2021) come from the encoder's output, the middle, three quarters and the
end of the decoder. Heads run in float32 whatever the trunk runs in: e^|x| of a bfloat16 would round metres away.
Module names are those of the published state dict.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F


@dataclass(frozen=True)
class HeadSizes:
    """Channel counts of one view's head."""

    token_dims: tuple[int, int, int, int]  # of the four feature maps the DPT reads
    layer_dims: tuple[int, int, int, int] = (96, 192, 384, 768)
    feature_dim: int = 256
    last_dims: tuple[int, int] = (128, 128)  # the two convolutions before the output
    local_hidden_dim: int = 7168
    descriptor_dim: int = 24
    patch: int = 16


class ResidualConvUnit(nn.Module):
    """x + conv(relu(conv(relu(x))))."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(dim, dim, 3, padding=1)
        self.conv2 = nn.Conv2d(dim, dim, 3, padding=1)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))


class FeatureFusion(nn.Module):
    """Adds a finer map to a coarser one and doubles the resolution."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(dim, dim, 1)
        self.resConfUnit1 = ResidualConvUnit(dim)  # idle in refinenet4, but its weights are in every checkpoint
        self.resConfUnit2 = ResidualConvUnit(dim)

    def forward(
        self, x: Float[Tensor, "b c h w"], skip: Float[Tensor, "b c h w"] | None = None
    ) -> Float[Tensor, "b c h2 w2"]:
        if skip is not None:
            x = x + self.resConfUnit1(skip)
        x = self.resConfUnit2(x)
        return self.out_conv(F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True))


class Scratch(nn.Module):
    """The part of a DPT that works at one width: input convolutions and the four fusions."""

    def __init__(self, sizes: HeadSizes) -> None:
        super().__init__()
        convolutions = [nn.Conv2d(dim, sizes.feature_dim, 3, padding=1, bias=False) for dim in sizes.layer_dims]
        # The published state dict holds these four under two names each.
        self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn = convolutions
        self.layer_rn = nn.ModuleList(convolutions)
        self.refinenet1 = FeatureFusion(sizes.feature_dim)
        self.refinenet2 = FeatureFusion(sizes.feature_dim)
        self.refinenet3 = FeatureFusion(sizes.feature_dim)
        self.refinenet4 = FeatureFusion(sizes.feature_dim)


class DensePrediction(nn.Module):
    """DPT: four token maps at 1/16 of the image -> 4 channels (x, y, z, confidence; before activation) at full size."""

    def __init__(self, sizes: HeadSizes) -> None:
        super().__init__()
        t, d = sizes.token_dims, sizes.layer_dims
        self.scratch = Scratch(sizes)
        first, last = sizes.last_dims
        self.head = nn.Sequential(
            nn.Conv2d(sizes.feature_dim, first, 3, padding=1),
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True),
            nn.Conv2d(first, last, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(last, 4, 1),
        )
        self.act_postprocess = nn.ModuleList(
            [
                nn.Sequential(nn.Conv2d(t[0], d[0], 1), nn.ConvTranspose2d(d[0], d[0], 4, stride=4)),
                nn.Sequential(nn.Conv2d(t[1], d[1], 1), nn.ConvTranspose2d(d[1], d[1], 2, stride=2)),
                nn.Sequential(nn.Conv2d(t[2], d[2], 1)),
                nn.Sequential(nn.Conv2d(t[3], d[3], 1), nn.Conv2d(d[3], d[3], 3, stride=2, padding=1)),
            ]
        )

    def forward(self, maps: Sequence[Float[Tensor, "b _ h w"]]) -> Float[Tensor, "b 4 H W"]:
        s = self.scratch
        l1, l2, l3, l4 = (rn(post(m)) for m, post, rn in zip(maps, self.act_postprocess, s.layer_rn, strict=True))
        # An odd number of tokens comes back from the halved map one too large.
        p = s.refinenet4(l4)[:, :, : l3.shape[2], : l3.shape[3]]
        p = s.refinenet1(s.refinenet2(s.refinenet3(p, l3), l2), l1)
        return self.head(p)


class Mlp(nn.Module):
    """Linear, GELU, Linear."""

    def __init__(self, dim: int, hidden_dim: int, out_dim: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden_dim)
        self.fc2 = nn.Linear(hidden_dim, out_dim)

    def forward(self, x: Float[Tensor, "*tokens c"]) -> Float[Tensor, "*tokens d"]:
        return self.fc2(F.gelu(self.fc1(x)))


class ViewHead(nn.Module):
    """Pointmap and descriptor heads of one view; each runs only when it is called."""

    def __init__(self, sizes: HeadSizes) -> None:
        super().__init__()
        self.patch = sizes.patch
        self.dpt = DensePrediction(sizes)
        self.head_local_features = Mlp(
            sizes.token_dims[0] + sizes.token_dims[3],
            sizes.local_hidden_dim,
            (sizes.descriptor_dim + 1) * sizes.patch**2,
        )

    def pointmap(
        self, tokens: Sequence[Float[Tensor, "b n _"]], height: int, width: int
    ) -> tuple[Float[Tensor, "b {height} {width} 3"], Float[Tensor, "b {height} {width}"]]:
        """Points (metres, camera 1) and their confidence (>= 1) from the DPT's four token sequences."""
        h, w = height // self.patch, width // self.patch
        with torch.autocast(tokens[0].device.type, enabled=False):
            raw = self.dpt([t.float().transpose(1, 2).unflatten(2, (h, w)) for t in tokens])
            return activate_points(raw[:, :3].permute(0, 2, 3, 1)), 1 + raw[:, 3].exp()

    def descriptors(
        self, encoded: Float[Tensor, "b n c"], decoded: Float[Tensor, "b n d"], height: int, width: int
    ) -> tuple[Float[Tensor, "b {height} {width} k"], Float[Tensor, "b {height} {width}"]]:
        """Unit descriptors per pixel and their confidence (> 0) from the first and last token sequence."""
        h, w = height // self.patch, width // self.patch
        with torch.autocast(encoded.device.type, enabled=False):
            raw = self.head_local_features(torch.cat([encoded, decoded], dim=-1).float())
            raw = F.pixel_shuffle(raw.transpose(1, 2).unflatten(2, (h, w)), self.patch)
            # normalize's floor keeps a zero vector zero instead of NaN
            return F.normalize(raw[:, :-1], dim=1, eps=1e-8).permute(0, 2, 3, 1), raw[:, -1].exp()


def activate_points(raw: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels 3"]:
    """The network's logarithmic distance made metres: the direction stays, |x| becomes e^|x| - 1."""
    distance = raw.norm(dim=-1, keepdim=True)
    return raw / distance.clamp(min=1e-8) * torch.expm1(distance)
