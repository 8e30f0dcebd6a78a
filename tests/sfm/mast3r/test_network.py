"""The network against the published key list and against every intermediate of a small twin."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from swimm3r.sfm.mast3r.checkpoint import infer_architecture
from swimm3r.sfm.mast3r.network import Architecture, Mast3r, rope2d, rotary_table, rotate

PARITY: dict[str, Any] = {"atol": 5e-5, "rtol": 0.0}


@pytest.fixture(scope="module")
def vectors(shared: Path) -> Path:
    return shared / "vectors" / "mast3r"


@pytest.fixture(scope="module")
def recipe(vectors: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("recipe", vectors / "recipe.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def tiny(vectors: Path, recipe: ModuleType) -> Mast3r:
    manifest = json.loads((vectors / "tiny_weights_manifest.json").read_text())
    state = {k: torch.from_numpy(recipe.weight(k, t["shape"])) for k, t in manifest["tensors"].items()}
    model = Mast3r(infer_architecture(state, manifest["config"]))
    model.load_state_dict(state, strict=True)
    return model.eval().requires_grad_(False)


@pytest.fixture(scope="module")
def expected(vectors: Path) -> dict[str, torch.Tensor]:
    return load_file(vectors / "tiny_forward.safetensors")


@pytest.mark.shared
def test_full_size_network_has_the_published_parameters_and_no_other(vectors: Path):
    published = {}
    for line in (vectors / "mast3r_state_dict_keys.txt").read_text().splitlines():
        key, shape, dtype = line.split("\t")
        published[key] = (shape, dtype)
    with torch.device("meta"):
        model = Mast3r(Architecture())
    assert len(published) == 1017
    assert {k: (str(tuple(v.shape)), str(v.dtype)) for k, v in model.state_dict().items()} == published
    assert sum(p.numel() for p in model.parameters()) == 688_638_856
    assert sum(1 for _ in model.parameters()) == 1009


@pytest.mark.shared
def test_rotary_embedding_reproduces_the_reference(vectors: Path):
    v = load_file(vectors / "rope2d.safetensors")
    torch.testing.assert_close(rope2d(v["tokens"], v["pos"]), v["rope100"], atol=1e-5, rtol=0)


def test_rotary_embedding_makes_attention_depend_on_relative_positions_only():
    generator = torch.Generator().manual_seed(0)
    q, k = torch.randn(2, 1, 2, 6, 16, generator=generator)
    positions = torch.randint(0, 9, (1, 6, 2), generator=generator)

    def scores(shift: torch.Tensor) -> torch.Tensor:
        return rope2d(q, positions + shift) @ rope2d(k, positions + shift).mT

    torch.testing.assert_close(scores(torch.tensor([5, 3])), scores(torch.tensor([0, 0])), atol=1e-4, rtol=0)


def test_rotary_angles_stay_exact_for_low_precision_tokens():
    positions = torch.tensor([[[31, 30], [17, 23]]])
    tokens = torch.randn(1, 1, 2, 16, generator=torch.Generator().manual_seed(0))
    table = rotary_table(positions, 16)
    low = rotate(tokens.bfloat16(), table)
    assert low.dtype == torch.bfloat16
    # one rounding of the input and one of the output, none of the angles
    torch.testing.assert_close(low, rotate(tokens.bfloat16().float(), table).bfloat16(), atol=0, rtol=0)


@pytest.mark.shared
def test_encoder_reproduces_the_reference_at_every_step(tiny: Mast3r, expected: dict[str, torch.Tensor]):
    seen: dict[str, torch.Tensor] = {}

    def keep(name: str):
        return lambda module, inputs, output: seen.__setitem__(name, output[0] if isinstance(output, tuple) else output)

    first: Any = tiny.enc_blocks[0]
    hooks = [
        tiny.patch_embed.register_forward_hook(keep("patch_embed")),
        first.norm1.register_forward_hook(keep("enc0.norm1")),
        first.attn.qkv.register_forward_hook(keep("qkv")),
        first.attn.register_forward_hook(keep("enc0.attn")),
        *(block.register_forward_hook(keep(f"enc_block{i}")) for i, block in enumerate(tiny.enc_blocks)),
    ]
    encoded = tiny.encode(expected["img1"])
    for hook in hooks:
        hook.remove()
    a = tiny.architecture
    seen["enc_norm"] = encoded.tokens
    seen["enc0.q"] = seen.pop("qkv").unflatten(-1, (3, a.encoder_heads, -1))[:, :, 0].transpose(1, 2)
    seen["enc0.q_rope"] = rope2d(seen["enc0.q"], encoded.positions)
    assert torch.equal(encoded.positions, expected["v1.pos"])
    assert len(seen) == 9
    for name, value in seen.items():
        torch.testing.assert_close(value, expected[f"v1.{name}"], **PARITY, msg=lambda m, name=name: f"{name}: {m}")
    torch.testing.assert_close(tiny.encode(expected["img2"]).tokens, expected["v2.enc_norm"], **PARITY)


@pytest.mark.shared
def test_decoder_and_heads_reproduce_the_reference_at_every_step(tiny: Mast3r, expected: dict[str, torch.Tensor]):
    seen: dict[str, torch.Tensor] = {}

    def keep(name: str):
        return lambda module, inputs, output: seen.__setitem__(name, output)

    head = tiny.downstream_head1
    hooks = [
        head.dpt.register_forward_hook(keep("raw.dpt1")),
        tiny.downstream_head2.dpt.register_forward_hook(keep("raw.dpt2")),
        head.head_local_features.register_forward_hook(keep("raw.loc1")),
        tiny.downstream_head2.head_local_features.register_forward_hook(keep("raw.loc2")),
        *(m.register_forward_hook(keep(f"raw.head1.act{i}")) for i, m in enumerate(head.dpt.act_postprocess)),
        *(
            getattr(head.dpt.scratch, f"refinenet{i}").register_forward_hook(keep(f"raw.head1.refinenet{i}"))
            for i in (1, 2, 3, 4)
        ),
    ]
    views = tiny.decode(tiny.encode(expected["img1"]), tiny.encode(expected["img2"]))
    for which, view in enumerate(views, start=1):
        for level, tokens in enumerate(view.tokens):
            seen[f"dec{which}.{level}"] = tokens
        points, descriptors = tiny.pointmap(view, which), tiny.descriptors(view, which)
        seen[f"res{which}.{'pts3d' if which == 1 else 'pts3d_in_other_view'}"] = points.points
        seen[f"res{which}.conf"] = points.confidence
        seen[f"res{which}.desc"] = descriptors.descriptors
        seen[f"res{which}.desc_conf"] = descriptors.confidence
    for hook in hooks:
        hook.remove()
    assert set(seen) == {k for k in expected if k.startswith(("dec", "res", "raw"))}
    for name, value in seen.items():
        torch.testing.assert_close(value, expected[name], **PARITY, msg=lambda m, name=name: f"{name}: {m}")


@pytest.mark.shared
@pytest.mark.parametrize(("prefix", "partner"), [("sym", "img2"), ("mix", "img3")], ids=["same size", "mixed sizes"])
def test_both_directions_of_a_pair_reproduce_the_reference(
    tiny: Mast3r, expected: dict[str, torch.Tensor], prefix: str, partner: str
):
    a, b = tiny.encode(expected["img1"]), tiny.encode(expected[partner])
    forth, back = tiny.decode(a, b), tiny.decode(b, a)
    passes = {"11": (forth[0], 1), "21": (forth[1], 2), "22": (back[0], 1), "12": (back[1], 2)}
    for name, (view, which) in passes.items():
        points, descriptors = tiny.pointmap(view, which), tiny.descriptors(view, which)
        for key, value in {
            "pts3d": points.points,
            "conf": points.confidence,
            "desc": descriptors.descriptors,
            "desc_conf": descriptors.confidence,
        }.items():
            torch.testing.assert_close(value, expected[f"{prefix}{name}.{key}"], **PARITY)


@pytest.mark.shared
def test_batch_of_landscape_and_portrait_images_reproduces_the_reference(
    tiny: Mast3r, expected: dict[str, torch.Tensor]
):
    encoded = []
    for v in "12":
        height, width = expected[f"many.true_shape{v}"].T
        encoded.append(tiny.encode(expected[f"many.img{v}"], portrait=height > width))
    assert torch.equal(encoded[0].positions, expected["many.pos1"])
    for which, view in enumerate(tiny.decode(*encoded), start=1):
        points, descriptors = tiny.pointmap(view, which), tiny.descriptors(view, which)
        name = "pts3d" if which == 1 else "pts3d_in_other_view"
        torch.testing.assert_close(points.points, expected[f"many.res{which}.{name}"], **PARITY)
        torch.testing.assert_close(points.confidence, expected[f"many.res{which}.conf"], **PARITY)
        torch.testing.assert_close(descriptors.descriptors, expected[f"many.res{which}.desc"], **PARITY)
        torch.testing.assert_close(descriptors.confidence, expected[f"many.res{which}.desc_conf"], **PARITY)


@pytest.mark.shared
def test_head_nobody_asks_for_is_not_run(tiny: Mast3r, expected: dict[str, torch.Tensor]):
    def fail(module, inputs):
        raise AssertionError("the DPT ran")

    view, _ = tiny.decode(tiny.encode(expected["img1"]), tiny.encode(expected["img2"]))
    hook = tiny.downstream_head1.dpt.register_forward_pre_hook(fail)
    assert tiny.descriptors(view, 1).descriptors.shape == (1, 48, 64, 6)
    with pytest.raises(AssertionError, match="the DPT ran"):
        tiny.pointmap(view, 1)
    hook.remove()


@pytest.mark.shared
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_low_precision_trunk_stays_near_the_full_one(
    vectors: Path, tiny: Mast3r, expected: dict[str, torch.Tensor], dtype: torch.dtype
):
    low = Mast3r(tiny.architecture)
    low.load_state_dict(tiny.state_dict())
    low.set_precision(dtype).requires_grad_(False)
    encoded = low.encode(expected["img1"]), low.encode(expected["img2"])
    assert encoded[0].tokens.dtype == dtype
    points = low.pointmap(low.decode(*encoded)[0], 1).points
    assert points.dtype == torch.float32
    error = (points - expected["res1.pts3d"]).norm() / expected["res1.pts3d"].norm()
    assert error < (0.05 if dtype == torch.bfloat16 else 0.01)


def test_image_that_does_not_divide_into_patches_is_refused():
    with torch.device("meta"):
        model = Mast3r(Architecture(encoder_depth=1, decoder_depth=4))
    with pytest.raises(ValueError, match="must divide by 16, got 50 x 64"):
        model.encode(torch.zeros(1, 3, 50, 64, device="meta"))
