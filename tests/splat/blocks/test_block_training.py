"""A map trained in blocks: one water, blocks that join, and kills that cost one block."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from swimm3r.errors import InputError
from swimm3r.evaluate.images import psnr
from swimm3r.imaging.appearance import decide_appearance
from swimm3r.scene.surface import surface_of
from swimm3r.splat import train
from swimm3r.splat.appearance import read_decision
from swimm3r.splat.blocks.plan import plan_blocks
from swimm3r.splat.ground import held_by_any
from swimm3r.splat.map_file import load_map
from swimm3r.splat.settings import BlockSettings, DensifySettings, InitialSettings, UwbsSettings, with_recipe
from swimm3r.splat.shared_settings import MapAppearanceSettings
from swimm3r.splat.training.checkpoint import read_state
from swimm3r.splat.views import median_z_depth
from swimm3r.tasks.settings import EngineSettings

FEW = UwbsSettings(
    iterations=20,
    full_area=1.3,
    checkpoint_every=0.25,
    initial=InitialSettings(primitives=700, scale=2.0),
    densify=DensifySettings(cap_max=900, min_refine_every=10),
    blocks=BlockSettings(largest=1.3),
)


@pytest.fixture(scope="module")
def trained(tiny_dive, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("blocks")
    train(tiny_dive.rec, tiny_dive.frames, FEW, folder)
    return folder


def bits(folder: Path) -> dict[str, bytes]:
    """Every tensor of the blocks; the order of a header's entries is none of theirs."""
    found = {}
    for path in sorted(folder.glob("blocks/*.safetensors")):
        for name, values in load_file(path).items():
            found[f"{path.name} {name}"] = values.numpy().tobytes()
    return found


def test_blocks_share_the_ground(tiny_dive, trained):
    scene = load_map(trained / "map.safetensors")
    assert scene.blocks is not None
    assert len(scene.blocks) == 3
    assert scene.count == sum(len(part.xyz) for part in scene.parts())
    depth = median_z_depth(tiny_dive.rec)
    plan = plan_blocks(surface_of(tiny_dive.rec, depth), depth, FEW.blocks)
    for block, part in zip(plan, scene.parts(), strict=True):
        closed = [plan[j].window for j in block.before]
        assert held_by_any([block.window, *closed], part.xyz).all()
        assert block.window.holds(part.xyz).float().mean() > 0.9
    for part in scene.parts(coarse=True):
        assert 0 < len(part.xyz) < scene.count / 12


def test_blocks_are_trained_in_the_colors_that_all_frames_have_in_common(tracked, relit, tmp_path):
    """Held by all blocks as the sparse points tell them; the map keeps them, so that test frames are recolored."""
    train(tracked, relit, FEW, tmp_path)
    decision = read_decision(tmp_path)
    assert decision is not None
    assert decision.on
    told = decide_appearance(tracked, relit, tracked.names, FEW.appearance).colors
    kept = load_map(tmp_path / "map.safetensors").colors
    assert told is not None
    assert kept is not None
    assert kept.names == told.names
    assert torch.equal(kept.maps, told.maps)
    train(tracked, relit, replace(FEW, appearance=MapAppearanceSettings(mode="off")), tmp_path / "off")
    assert last_l1(tmp_path) < 0.8 * last_l1(tmp_path / "off")


def last_l1(folder: Path) -> float:
    """Mean difference of a block's renderings to the views they are compared with, at the end of its training."""
    lines = [(path / "metrics.jsonl").read_text().splitlines()[-1] for path in sorted(folder.glob("blocks/????"))]
    return sum(json.loads(line)["l1"] for line in lines) / len(lines)


def test_a_map_in_blocks_looks_like_one_map_of_the_same_density(tiny_dive, trained, tmp_path):
    in_blocks = load_map(trained / "map.safetensors")
    steps = [read_state(path / "checkpoint" / "state.safetensors").about.step for path in trained.glob("blocks/????")]
    whole = replace(
        FEW,
        iterations=max(steps),
        initial=replace(FEW.initial, primitives=in_blocks.count),
        densify=replace(FEW.densify, cap_max=in_blocks.count),
        blocks=BlockSettings(largest=0.0),
        poses=replace(FEW.poses, enabled=False),
    )
    one = train(tiny_dive.rec, tiny_dive.frames, whole, tmp_path)
    assert one.blocks is None
    scores = []
    for scene in (in_blocks, one):
        views = [(scene.render(tiny_dive.cameras[i]).rgb, tiny_dive.frames.image(i)) for i in (0, 8)]
        scores.append(sum(float(psnr(out, target)) for out, target in views) / len(views))
    assert scores[0] > scores[1] - 2.0


def test_more_ground_has_more_primitives(tiny_dive, tmp_path):
    """Up to that of a block; a map of the same many, asked for as such, has the same bits."""
    area = float(surface_of(tiny_dive.rec, median_z_depth(tiny_dive.rec)).area.sum())
    few = replace(FEW, full_area=area / 2, blocks=BlockSettings(largest=1.5 * area))
    many = replace(
        FEW,
        initial=replace(FEW.initial, primitives=1400),
        densify=replace(FEW.densify, cap_max=1800),
        full_area=2 * area,
        blocks=few.blocks,
    )
    maps = [train(tiny_dive.rec, tiny_dive.frames, s, tmp_path / str(s.full_area)) for s in (few, many)]
    assert maps[0].count > 1400
    assert maps[0].primitives.xyz.equal(maps[1].primitives.xyz)


def test_a_finished_training_is_not_repeated(tiny_dive, trained):
    files = {path: path.stat().st_mtime_ns for path in trained.glob("blocks/*.safetensors")}
    train(tiny_dive.rec, tiny_dive.frames, FEW, trained)
    assert {path: path.stat().st_mtime_ns for path in trained.glob("blocks/*.safetensors")} == files


def test_a_block_that_is_lost_is_trained_again_alone(tiny_dive, trained, tmp_path):
    before = bits(trained)
    lost = trained / "blocks" / "0001.safetensors"
    lost.write_bytes(b"not a block")
    kept = trained / "blocks" / "0000.safetensors"
    written = kept.stat().st_mtime_ns
    with pytest.raises(InputError, match="0001"):
        list(load_map(trained / "map.safetensors").parts())
    train(tiny_dive.rec, tiny_dive.frames, FEW, trained)
    assert bits(trained) == before
    assert kept.stat().st_mtime_ns == written


class CutError(Exception):
    pass


def test_a_block_that_was_killed_goes_on_from_its_checkpoint(tiny_dive, trained, tmp_path):
    state = tmp_path / "blocks" / "0001" / "checkpoint" / "state.safetensors"

    def cut_short(what: str, done: int, total: int) -> None:
        if what.startswith("training block 2 of") and state.is_file():
            raise CutError

    with pytest.raises(Exception, match="block_0001"):
        train(tiny_dive.rec, tiny_dive.frames, FEW, tmp_path, cut_short, engine=EngineSettings(retries=0))
    first = tmp_path / "blocks" / "0000.safetensors"
    written = first.stat().st_mtime_ns
    assert not (tmp_path / "blocks" / "0001.safetensors").exists()
    assert not (tmp_path / "map.safetensors").exists()
    reached = read_state(state).about.step
    seen = []
    train(tiny_dive.rec, tiny_dive.frames, FEW, tmp_path, lambda what, done, total: seen.append((what, done)))
    of_blocks = [(what, done) for what, done in seen if what.startswith("training block ")]
    assert of_blocks[0] == ("training block 2 of 3", reached)
    assert {what for what, _ in of_blocks} == {"training block 2 of 3", "training block 3 of 3"}
    assert first.stat().st_mtime_ns == written
    assert bits(tmp_path) == bits(trained)


@pytest.mark.long
def test_blocks_trained_in_processes_have_the_same_bits(tiny_dive, trained, tmp_path):
    train(tiny_dive.rec, tiny_dive.frames, FEW, tmp_path, engine=EngineSettings(jobs=2, cpus=1))
    assert bits(tmp_path) == bits(trained)


@pytest.mark.long
def test_other_settings_train_all_blocks_again(tiny_dive, trained, tmp_path):
    for path in trained.glob("blocks/*.safetensors"):
        target = tmp_path / "blocks" / path.name
        target.parent.mkdir(exist_ok=True)
        target.write_bytes(path.read_bytes())
    train(tiny_dive.rec, tiny_dive.frames, replace(FEW, seed=5), tmp_path)
    before, after = bits(trained), bits(tmp_path)
    assert all(before[name] != after[name] for name in before if name.endswith("primitives.xyz"))


def test_a_recipe_without_blocks_says_so(tiny_dive, tmp_path, caplog):
    scene = train(tiny_dive.rec, tiny_dive.frames, with_recipe(replace(FEW, iterations=5), "uwbs-dynamic"), tmp_path)
    assert scene.blocks is None
    assert "maps of uwbs-dynamic have one block" in caplog.text


def test_the_water_of_the_blocks_is_that_of_the_whole_dive(trained):
    """It is held while blocks are trained: every block's checkpoint has the same."""
    states = [read_state(path / "checkpoint" / "state.safetensors") for path in trained.glob("blocks/????")]
    states.append(read_state(trained / "checkpoint" / "state.safetensors"))
    names = [name for name in states[0].tensors if name.startswith("parameter.field.")]
    assert names
    for name in names:
        assert all(torch.equal(states[0].tensors[name], state.tensors[name]) for state in states), name


def test_a_later_block_leaves_the_ground_of_its_neighbor_to_it(tiny_dive, trained):
    """The neighbor's primitives are drawn beside its own, so it begins with none there, and ends with hardly any."""
    depth = median_z_depth(tiny_dive.rec)
    plan = plan_blocks(surface_of(tiny_dive.rec, depth), depth, FEW.blocks)
    assert sorted({block.turn for block in plan}) == [0, 1, 2]
    for k, block in enumerate(plan):
        xyz = read_state(trained / "blocks" / f"{k:04d}" / "checkpoint" / "state.safetensors").tensors["parameter.xyz"]
        for j in block.before:
            assert plan[j].turn < block.turn
            assert plan[j].window.holds(xyz).float().mean() < 0.05
