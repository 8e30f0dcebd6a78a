"""A map in memory cut into blocks on disk."""

from dataclasses import replace
from pathlib import Path

import torch

from swimm3r.splat.block_store import BlockEntry, StoredBlocks, no_primitives, write_block
from swimm3r.splat.blocks.coarse import box_of, coarse_of
from swimm3r.splat.primitives.beta import BetaPrimitives, select
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import RenderSettings


def in_blocks(scene: SplatMap, folder: Path, parts: int = 6) -> SplatMap:
    """The map of a wall cut into strips."""
    p = scene.primitives
    assert isinstance(p, BetaPrimitives)
    edges = torch.linspace(float(p.xyz[:, 0].min()), float(p.xyz[:, 0].max()) + 1e-3, parts + 1)
    entries = []
    for k in range(parts):
        own = select(p, (p.xyz[:, 0] >= edges[k]) & (p.xyz[:, 0] < edges[k + 1]))
        few, (low, high) = coarse_of(own), box_of(own, RenderSettings())
        count, coarse = len(own.xyz), len(few.primitives.xyz)
        entry = BlockEntry(
            f"blocks/{k:04d}.safetensors", count, coarse, few.spacing, tuple(low.tolist()), tuple(high.tolist())
        )
        write_block(folder / entry.coarse_file, few.primitives, "key")
        write_block(folder / entry.file, own, "key", entry)
        entries.append(entry)
    return replace(scene, primitives=no_primitives(), blocks=StoredBlocks(folder, "key", tuple(entries)))
