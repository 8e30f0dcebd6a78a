"""The preset `paper`: its objective is Eq. 18 and nothing else, and its numbers are the printed ones."""

import copy
from dataclasses import asdict, replace

import pytest
import torch

from swimm3r.cameras import image_directions
from swimm3r.cli.main import main
from swimm3r.evaluate.images import ssim
from swimm3r.pipeline.presets import MAST3R_PRESETS, PRESETS
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.recipes import uwbs
from swimm3r.splat.rendering import draw
from swimm3r.splat.settings import SplatSettings, UwbsSettings, WaterSplattingSettings, with_recipe
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.views import TrainingViews

PAPER = PRESETS["paper"]


def uwbs_of(settings: SplatSettings) -> UwbsSettings:
    assert isinstance(settings, UwbsSettings)
    return settings


MAP = uwbs_of(PAPER.splat)


def varied_field(dive, settings: UwbsSettings):
    """The dive's water, different in every direction."""
    field = copy.deepcopy(dive.truth.field)
    field.stride = settings.medium.stride
    with torch.no_grad():
        field.network[-1].weight.normal_(std=1.0, generator=torch.Generator().manual_seed(3))
    return field


def test_the_objective_is_the_literal_sum_of_eq_18(tiny_dive):
    """On a scene in which every term counts: one primitive is oversize, half of the depths are unknown."""
    view = TrainingViews(tiny_dive.rec, tiny_dive.frames, MAP, 1.0)[3]
    z_depth = view.z_depth.clone()
    z_depth[:, ::2] = 0
    view = replace(view, z_depth=z_depth, rgb=(1.3 * view.rgb).clamp(0, 1), open_water=z_depth == 0)
    p = tiny_dive.truth.primitives
    scale, rgb = p.scale.clone(), p.rgb.clone()
    scale[:40, :3] = 20.0
    rgb[::7] = 1.8  # beyond what a clear color can be
    p = p._replace(scale=scale, rgb=rgb, opacity=p.opacity - 5, xyz=p.xyz * 0.9)
    field = varied_field(tiny_dive, MAP)
    scene = TrainingScene(tiny_dive.rec, 1.0, 1.0, TrainingViews(tiny_dive.rec, tiny_dive.frames, MAP, 1.0))
    prior = uwbs.known_water(scene, MAP)
    drawing = draw(p, field, view_camera(view.camera), MAP)
    loss = uwbs.objective(p, drawing, view, MAP, prior, True)

    I, rendered = view.rgb.double(), drawing.images.rgb.double()
    L_3dgs = 0.8 * (rendered - I).abs().mean() + 0.2 * (1 - ssim(rendered.permute(1, 2, 0), I.permute(1, 2, 0)))
    s = torch.nn.functional.softplus(p.scale[:, :3].double())
    L_mcmc = 0.01 * torch.sigmoid(p.opacity.double()).mean() + 0.01 * s.mean()
    d = image_directions(view.camera).double() @ view.camera.cam2world[0, :3, :3].mT
    M = field(torch.nn.functional.normalize(d, dim=-1).float()).double()
    L_smooth = (M[:, :, 1:] - M[:, :, :-1]).abs().mean() + (M[:, 1:] - M[:, :-1]).abs().mean()
    r = drawing.projection.radius
    L_rad = s[r > 256].sum(-1).div(3).mean()
    A = drawing.images.alpha.double()
    D_hat, D = drawing.images.z_depth.double() / A, view.z_depth.double()
    valid = (D > 0) & (A > 0.5)
    dx, dy = torch.zeros_like(D), torch.zeros_like(D)
    dx[:, :-1] = (I[:, :, 1:] - I[:, :, :-1]).abs().mean(0)
    dy[:-1] = (I[:, 1:] - I[:, :-1]).abs().mean(0)
    w = torch.exp(-dx) + torch.exp(-dy)
    w = w[valid] / w[valid].sum()
    L_depth = (w * torch.log(1 + (1 / D_hat[valid] - 1 / D[valid]).abs())).sum()
    expected = L_3dgs + L_mcmc + 0.1 * L_depth + 1.0 * L_smooth + 0.1 * L_rad
    parts = [float(part) for part in (L_3dgs, L_mcmc, L_depth, L_smooth, L_rad)]
    assert min(parts) > 1e-3
    assert float(loss.total) == pytest.approx(float(expected), rel=1e-5)
    beyond = ("in_front", "uncovered", "drawn_on_water", "outside_gamut", "medium_prior")
    assert all(float(loss.numbers[name]) > 1e-3 for name in beyond)  # they would show


def test_the_water_learns_from_the_first_step(tiny_dive):
    """`default` waits a tenth of the run."""
    before_and_after = {}
    for name in ("paper", "default"):
        whole = uwbs_of(PRESETS[name].splat)
        settings = replace(whole, initial=replace(whole.initial, primitives=300), iterations=1000)
        views = TrainingViews(tiny_dive.rec, tiny_dive.frames, settings, 1.0)
        scene = TrainingScene(tiny_dive.rec, 1.0, 1.0, views)
        recipe = uwbs.Uwbs(settings, scene, uwbs.known_water(scene, settings))
        start = recipe.start()
        first = {name: values.clone() for name, values in start.field.state_dict().items()}
        state, _ = recipe.step(start, views[3], 1)
        before_and_after[name] = first, state.field.state_dict()
    changed = {name: any(not torch.equal(a[key], b[key]) for key in a) for name, (a, b) in before_and_after.items()}
    assert changed == {"paper": True, "default": False}


def test_the_numbers_are_the_printed_ones():
    assert (MAP.initial.primitives, MAP.densify.cap_max, MAP.iterations) == (400_000, 800_000, 20_000)
    assert MAP.sgg.enabled
    assert (MAP.sgg.residual, MAP.sgg.end * MAP.iterations, MAP.densify.refine_stop * MAP.iterations) == (
        0.15,
        10_000,
        10_000,
    )
    assert MAP.poses.enabled
    assert (PAPER.frames.pick, PAPER.frames.fps) == ("uniform", 5)
    assert (PAPER.test.steps, PAPER.test.long_side, PAPER.test.halvings) == (300, 0, 0)
    assert PRESETS["best"].test.long_side == 0  # the training images' own
    assert MAST3R_PRESETS.keys() == PRESETS.keys()


@pytest.mark.parametrize("command", ["run", "prepare", "sfm", "splat", "bench render", "bench ablation-uwbs"])
def test_every_command_with_presets_knows_it(command: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), "--preset", "paper", "--help-all"])
    shown = capsys.readouterr().out
    assert stop.value.code == 0
    assert "fast,default,best,paper" in shown.replace("\n", "").replace(" ", "")
    if "sfm" not in command and command != "prepare":
        assert "(default: 400000)" in shown


def test_it_trains_no_peer_otherwise_than_at_its_size():
    peer = with_recipe(MAP, "watersplatting")
    assert isinstance(peer, WaterSplattingSettings)
    assert (peer.iterations, peer.initial.primitives, peer.cap_max) == (20_000, 400_000, 800_000)
    assert asdict(peer.weights) == asdict(with_recipe(UwbsSettings(), "watersplatting").weights)
