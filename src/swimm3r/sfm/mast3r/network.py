"""The two-view network of MASt3R (Leroy et al. 2024): a shared encoder, two decoders that look at each other, heads.

    encode(image)          -> tokens of one image, independent of its partner: do it once per image and keep it
    decode(enc_1, enc_2)   -> tokens of both views after `decoder_depth` exchanges
    pointmap, descriptors  -> maps of one view; both pointmaps of a pass are in the frame of camera 1

Positions enter only through rotary embedding (Su et al. 2021), split over the two axes: the first half of every head
turns with y, the second with x, in whole tokens. Inside a half of size D, the pair (t[k], t[k + D/2]) turns by
p * base^(-2k/D). Its tables stay float32 whatever the tokens are.
Module names and parameter shapes are those of the published checkpoint.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional as F

from swimm3r.sfm.mast3r.heads import HeadSizes, Mlp, ViewHead


@dataclass(frozen=True)
class Architecture:
    """Sizes of the network; the defaults are those of MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric."""

    encoder_dim: int = 1024
    encoder_depth: int = 24
    encoder_heads: int = 16
    decoder_dim: int = 768
    decoder_depth: int = 12
    decoder_heads: int = 12
    mlp_ratio: int = 4
    patch: int = 16
    rope_base: float = 100.0
    dpt_layer_dims: tuple[int, int, int, int] = (96, 192, 384, 768)
    dpt_feature_dim: int = 256
    dpt_last_dims: tuple[int, int] = (128, 128)
    local_hidden_dim: int = 7168
    descriptor_dim: int = 24

    @property
    def dpt_levels(self) -> tuple[int, int, int, int]:
        """Indices of the token sequences of `Decoded` that the DPT reads."""
        return 0, self.decoder_depth // 2, 3 * self.decoder_depth // 4, self.decoder_depth


@dataclass(frozen=True)
class Encoded:
    """Tokens of a batch of images of one size, before they have seen a partner."""

    tokens: Float[Tensor, "b n c"]
    positions: Int64[Tensor, "b n 2"]  # (y, x) of each token, whole tokens
    height: int  # of the images as they were passed, pixels
    width: int
    portrait: Bool[Tensor, " b"] | None = None  # which ones were passed lying on their side; None: none


@dataclass(frozen=True)
class Decoded:
    """One view after the exchange: [0] the encoder's tokens, [i] after decoder block i, the last one normalized."""

    tokens: tuple[Float[Tensor, "b n _"], ...]
    height: int
    width: int
    portrait: Bool[Tensor, " b"] | None = None


@dataclass(frozen=True)
class Pointmap:
    """The surface point of every pixel in the frame of camera 1 of the pass, metres, and its confidence (>= 1)."""

    points: Float[Tensor, "b h w 3"]
    confidence: Float[Tensor, "b h w"]


@dataclass(frozen=True)
class Descriptors:
    """Unit vectors that are alike where two views show the same thing; and how distinctive (> 0)."""

    descriptors: Float[Tensor, "b h w d"]
    confidence: Float[Tensor, "b h w"]


@dataclass(frozen=True)
class RotaryTable:
    """cos and sin of every token's angles, float32."""

    cos: Float[Tensor, "b 1 n d"]
    sin: Float[Tensor, "b 1 n d"]


def rotary_table(positions: Int64[Tensor, "b n 2"], head_dim: int, base: float = 100.0) -> RotaryTable:
    """Angles of tokens at (y, x) for heads of `head_dim` channels, which must divide by 4."""
    if head_dim % 4:
        raise ValueError(f"rotary embedding over two axes needs heads divisible by 4, got {head_dim}")
    quarter = head_dim // 4
    frequencies = base ** (-torch.arange(quarter, device=positions.device, dtype=torch.float32) / quarter)
    angles = positions[..., None].float() * frequencies  # b n 2 quarter
    angles = torch.cat([angles, angles], dim=-1).flatten(2)[:, None]
    return RotaryTable(angles.cos(), angles.sin())


def rotate(tokens: Float[Tensor, "b heads n d"], table: RotaryTable) -> Float[Tensor, "b heads n d"]:
    """Tokens turned by their positions, in float32 and back."""
    halves = tokens.float().unflatten(-1, (2, 2, -1))
    turned = torch.stack([-halves[..., 1, :], halves[..., 0, :]], dim=-2).flatten(-3)
    return (tokens.float() * table.cos + turned * table.sin).to(tokens.dtype)


def rope2d(
    tokens: Float[Tensor, "b heads n d"], positions: Int64[Tensor, "b n 2"], base: float = 100.0
) -> Float[Tensor, "b heads n d"]:
    """Rotary embedding of tokens at (y, x); `rotary_table` and `rotate` in one."""
    return rotate(tokens, rotary_table(positions, tokens.shape[-1], base))


class PatchEmbed(nn.Module):
    """A linear map of every 16 x 16 patch."""

    def __init__(self, dim: int, patch: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, patch, stride=patch)

    def forward(self, images: Float[Tensor, "b 3 h w"]) -> tuple[Float[Tensor, "b n c"], Int64[Tensor, "b n 2"]]:
        x = self.proj(images.to(self.proj.weight.dtype))
        h, w = x.shape[2:]
        y_x = torch.cartesian_prod(torch.arange(h, device=x.device), torch.arange(w, device=x.device))
        return x.flatten(2).transpose(1, 2), y_x.expand(len(x), -1, -1)


class SelfAttention(nn.Module):
    """Tokens of one view look at each other."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Float[Tensor, "b n c"], rope: RotaryTable) -> Float[Tensor, "b n c"]:
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        out = F.scaled_dot_product_attention(rotate(q, rope), rotate(k, rope), v)
        return self.proj(out.transpose(1, 2).flatten(2))


class CrossAttention(nn.Module):
    """Tokens of one view look at those of the other."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.projq = nn.Linear(dim, dim)
        self.projk = nn.Linear(dim, dim)
        self.projv = nn.Linear(dim, dim)
        self.proj = nn.Linear(dim, dim)

    def forward(
        self, x: Float[Tensor, "b n c"], y: Float[Tensor, "b m c"], rope_x: RotaryTable, rope_y: RotaryTable
    ) -> Float[Tensor, "b n c"]:
        q, k, v = (
            t.unflatten(-1, (self.heads, -1)).transpose(1, 2) for t in (self.projq(x), self.projk(y), self.projv(y))
        )
        out = F.scaled_dot_product_attention(rotate(q, rope_x), rotate(k, rope_y), v)
        return self.proj(out.transpose(1, 2).flatten(2))


class EncoderBlock(nn.Module):
    def __init__(self, dim: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=1e-6)
        self.attn = SelfAttention(dim, heads)
        self.norm2 = nn.LayerNorm(dim, eps=1e-6)
        self.mlp = Mlp(dim, mlp_ratio * dim, dim)

    def forward(self, x: Float[Tensor, "b n c"], rope: RotaryTable) -> Float[Tensor, "b n c"]:
        x = x + self.attn(self.norm1(x), rope)
        return x + self.mlp(self.norm2(x))


class DecoderBlock(nn.Module):
    def __init__(self, dim: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=1e-6)
        self.attn = SelfAttention(dim, heads)
        self.cross_attn = CrossAttention(dim, heads)
        self.norm2 = nn.LayerNorm(dim, eps=1e-6)
        self.norm3 = nn.LayerNorm(dim, eps=1e-6)
        self.mlp = Mlp(dim, mlp_ratio * dim, dim)
        self.norm_y = nn.LayerNorm(dim, eps=1e-6)

    def forward(
        self, x: Float[Tensor, "b n c"], y: Float[Tensor, "b m c"], rope_x: RotaryTable, rope_y: RotaryTable
    ) -> Float[Tensor, "b n c"]:
        x = x + self.attn(self.norm1(x), rope_x)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(y), rope_x, rope_y)
        return x + self.mlp(self.norm3(x))


class Mast3r(nn.Module):
    """The network. Build it with `checkpoint.load`; the trunk's dtype may be lower than that of the heads."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        a = self.architecture = architecture
        self.mask_token = nn.Parameter(torch.zeros(1, 1, a.decoder_dim))  # of the pre-training; never read
        self.patch_embed = PatchEmbed(a.encoder_dim, a.patch)
        self.enc_blocks = nn.ModuleList(
            EncoderBlock(a.encoder_dim, a.encoder_heads, a.mlp_ratio) for _ in range(a.encoder_depth)
        )
        self.enc_norm = nn.LayerNorm(a.encoder_dim, eps=1e-6)
        self.decoder_embed = nn.Linear(a.encoder_dim, a.decoder_dim)
        self.dec_blocks, self.dec_blocks2 = (
            nn.ModuleList(DecoderBlock(a.decoder_dim, a.decoder_heads, a.mlp_ratio) for _ in range(a.decoder_depth))
            for _ in range(2)
        )
        self.dec_norm = nn.LayerNorm(a.decoder_dim, eps=1e-6)
        sizes = HeadSizes(
            token_dims=(a.encoder_dim, a.decoder_dim, a.decoder_dim, a.decoder_dim),
            layer_dims=a.dpt_layer_dims,
            feature_dim=a.dpt_feature_dim,
            last_dims=a.dpt_last_dims,
            local_hidden_dim=a.local_hidden_dim,
            descriptor_dim=a.descriptor_dim,
            patch=a.patch,
        )
        self.downstream_head1 = ViewHead(sizes)
        self.downstream_head2 = ViewHead(sizes)

    @property
    def device(self) -> torch.device:
        """The device of the weights."""
        return self.mask_token.device

    def set_precision(self, dtype: torch.dtype) -> "Mast3r":
        """The trunk in `dtype` (float32, bfloat16, float16), the heads in float32."""
        self.to(dtype)
        self.downstream_head1.float()
        self.downstream_head2.float()
        return self

    def encode(self, images: Float[Tensor, "b 3 h w"], portrait: Bool[Tensor, " b"] | None = None) -> Encoded:
        """Tokens of images in -1..1 whose sides divide by the patch (16).

        A training batch may mix orientations: portrait images are then passed transposed, marked in `portrait`, and
        are seen upright by the network; their maps come back transposed too.
        """
        height, width = images.shape[2:]
        patch = self.architecture.patch
        if height % patch or width % patch:
            raise ValueError(f"the sides of an image must divide by {patch}, got {height} x {width} (height x width)")
        if portrait is not None and not bool(portrait.any()):
            portrait = None
        if portrait is None:
            tokens, positions = self.patch_embed(images)
        else:
            upright = [self.patch_embed(i.mT if p else i) for i, p in zip(images.split(1), portrait, strict=True)]
            tokens, positions = (torch.cat(parts) for parts in zip(*upright, strict=True))
        rope = self._encoder_table(positions)
        for block in self.enc_blocks:
            tokens = block(tokens, rope)
        return Encoded(self.enc_norm(tokens), positions, height, width, portrait)

    def decode(self, view1: Encoded, view2: Encoded) -> tuple[Decoded, Decoded]:
        """Both views after they have looked at each other; their images may differ in size."""
        rope1, rope2 = self._decoder_table(view1.positions), self._decoder_table(view2.positions)
        x1, x2 = self.decoder_embed(view1.tokens), self.decoder_embed(view2.tokens)
        outputs1, outputs2 = [view1.tokens], [view2.tokens]
        for block1, block2 in zip(self.dec_blocks, self.dec_blocks2, strict=True):
            x1, x2 = block1(x1, x2, rope1, rope2), block2(x2, x1, rope2, rope1)  # both read the previous step
            outputs1.append(x1)
            outputs2.append(x2)
        outputs1[-1], outputs2[-1] = self.dec_norm(x1), self.dec_norm(x2)
        return (
            Decoded(tuple(outputs1), view1.height, view1.width, view1.portrait),
            Decoded(tuple(outputs2), view2.height, view2.width, view2.portrait),
        )

    def pointmap(self, view: Decoded, which: int) -> Pointmap:
        """Points of view 1 or 2 (`which`) in the frame of camera 1."""
        head = self._head(which)
        levels = [view.tokens[level] for level in self.architecture.dpt_levels]
        return Pointmap(*_upright(lambda height, width, *t: head.pointmap(t, height, width), view, levels))

    def descriptors(self, view: Decoded, which: int) -> Descriptors:
        """Descriptors of view 1 or 2 (`which`)."""
        head = self._head(which)
        ends = [view.tokens[0], view.tokens[-1]]
        return Descriptors(*_upright(lambda height, width, e, d: head.descriptors(e, d, height, width), view, ends))

    def _head(self, which: int) -> ViewHead:
        if which not in (1, 2):
            raise ValueError(f"a pass has views 1 and 2, got {which}")
        return self.downstream_head1 if which == 1 else self.downstream_head2

    def _encoder_table(self, positions: Int64[Tensor, "b n 2"]) -> RotaryTable:
        a = self.architecture
        return rotary_table(positions, a.encoder_dim // a.encoder_heads, a.rope_base)

    def _decoder_table(self, positions: Int64[Tensor, "b n 2"]) -> RotaryTable:
        a = self.architecture
        return rotary_table(positions, a.decoder_dim // a.decoder_heads, a.rope_base)


def _upright(head, view: Decoded, tokens: list[Tensor]) -> tuple[Tensor, Tensor]:
    """A head's two maps, the portrait images of the batch in their own orientation and transposed back."""
    if view.portrait is None:
        return head(view.height, view.width, *tokens)
    maps = []
    for b, lying in enumerate(view.portrait):
        one = [t[b : b + 1] for t in tokens]
        if lying:
            values, confidence = head(view.width, view.height, *one)
            maps.append((values.transpose(1, 2), confidence.mT))
        else:
            maps.append(head(view.height, view.width, *one))
    values, confidence = zip(*maps, strict=True)
    return torch.cat(values), torch.cat(confidence)
