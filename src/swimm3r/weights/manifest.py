"""The published weight files: where each comes from, how large it is, what its license allows."""

from dataclasses import dataclass

from swimm3r.errors import UsageError

_NAVER = "https://download.europe.naverlabs.com/ComputerVision"
_MAST3R = "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric"
_MAST3R_LICENSE = (
    "CC BY-NC-SA 4.0 and the terms of the training sets (CHECKPOINTS_NOTICE; Map-free allows no commercial use at all)"
)


@dataclass(frozen=True)
class Weights:
    """One published file."""

    name: str  # what the command line calls it
    purpose: str
    filename: str
    urls: tuple[str, ...]  # tried in turn
    size: int | None  # bytes; None where it is not published
    about_mb: float | None  # for messages, where the size is not exactly known
    sha256: str | None  # whole, or the first digits; None where it is not published
    license: str
    license_url: str
    non_commercial: bool
    serves_as: str | None = None  # another entry's name, of which this is the same in another format


MANIFEST = (
    Weights(
        name="mast3r",
        purpose="two-view pointmaps and descriptors, for --backend mast3r",
        filename=f"{_MAST3R}.pth",
        urls=(f"{_NAVER}/MASt3R/{_MAST3R}.pth",),
        size=2_754_910_614,
        about_mb=2755.0,
        sha256=None,
        license=_MAST3R_LICENSE,
        license_url="https://github.com/naver/mast3r/blob/main/CHECKPOINTS_NOTICE",
        non_commercial=True,
    ),
    Weights(
        name="mast3r-safetensors",
        purpose="the same weights as mast3r, which load without copying",
        filename=f"{_MAST3R}.safetensors",
        urls=(f"https://huggingface.co/naver/{_MAST3R}/resolve/main/model.safetensors",),
        size=None,
        about_mb=2755.0,
        sha256=None,
        license=_MAST3R_LICENSE,
        license_url="https://github.com/naver/mast3r/blob/main/CHECKPOINTS_NOTICE",
        non_commercial=True,
        serves_as="mast3r",
    ),
    Weights(
        name="mast3r-retrieval",
        purpose="whitening of MASt3R's encoder tokens, for loop closures",
        filename=f"{_MAST3R}_retrieval_trainingfree.pth",
        urls=(f"{_NAVER}/MASt3R/{_MAST3R}_retrieval_trainingfree.pth",),
        size=None,
        about_mb=8.4,
        sha256=None,
        license=_MAST3R_LICENSE,
        license_url="https://github.com/naver/mast3r/blob/main/CHECKPOINTS_NOTICE",
        non_commercial=True,
    ),
    Weights(
        name="mast3r-codebook",
        purpose="visual words for ASMK retrieval; belongs to mast3r-retrieval",
        filename=f"{_MAST3R}_retrieval_codebook.pkl",
        urls=(f"{_NAVER}/MASt3R/{_MAST3R}_retrieval_codebook.pkl",),
        size=None,
        about_mb=268.0,  # 65,536 words of 1,024 float32; not verified
        sha256=None,
        license=_MAST3R_LICENSE,
        license_url="https://github.com/naver/mast3r/blob/main/CHECKPOINTS_NOTICE",
        non_commercial=True,
    ),
    Weights(
        name="lpips-vgg",
        purpose="the LPIPS score's linear layers on VGG-16",
        filename="lpips_v0.1_vgg.pth",
        urls=("https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1/vgg.pth",),
        size=7_289,
        about_mb=0.01,
        sha256="a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
        license="BSD-2-Clause",
        license_url="https://github.com/richzhang/PerceptualSimilarity/blob/master/LICENSE",
        non_commercial=False,
    ),
    Weights(
        name="vgg16",
        purpose="the network under the LPIPS score",
        filename="vgg16-397923af.pth",
        urls=("https://download.pytorch.org/models/vgg16-397923af.pth",),
        size=None,
        about_mb=528.0,
        sha256="397923af",
        license="BSD-3-Clause (torchvision); trained on ImageNet",
        license_url="https://github.com/pytorch/vision/blob/main/LICENSE",
        non_commercial=False,
    ),
    Weights(
        name="uranker",
        purpose="the URanker score of underwater images; nothing here loads them yet",
        filename="URanker_ckpt-450eb36d.pth",
        urls=("https://huggingface.co/chaofengc/IQA-PyTorch-Weights/resolve/main/URanker_ckpt-450eb36d.pth",),
        size=None,
        about_mb=None,
        sha256="450eb36d",
        license="CC BY-NC 4.0",
        license_url="https://github.com/RQ-Wu/UnderwaterRanker",
        non_commercial=True,
    ),
)


def entry(name: str, manifest: tuple[Weights, ...] = MANIFEST) -> Weights:
    """The manifest's entry of a name. Raises UsageError for an unknown one."""
    for weights in manifest:
        if weights.name == name:
            return weights
    raise UsageError(
        f"there are no weights called {name!r}",
        cause="a mistyped name",
        hint="one of " + ", ".join(weights.name for weights in manifest),
    )
