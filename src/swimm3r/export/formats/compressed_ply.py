"""PlayCanvas's compressed PLY: chunks of 256 Gaussians, positions and scales in 32 bits of its box.

Written by gsply. The Gaussians are put along a Morton curve first, which keeps the boxes small.
"""

from pathlib import Path

from swimm3r.devices import torch_threads
from swimm3r.export.result import Exported, check_replaceable
from swimm3r.export.settings import CompressedPlySettings
from swimm3r.export.splats import along_curve, for_gsply, from_gsply, gsply_or_refuse, open_map
from swimm3r.io.files.atomic import atomic_path
from swimm3r.io.ply import is_ply


def export_run(folder: Path, path: Path, settings: CompressedPlySettings) -> Exported:
    """Write a finished run's map, and measure how far the Gaussians of the file are from it in views along the dive."""
    check_replaceable(path, is_ply, "PLY file")
    gsply = gsply_or_refuse()
    found = open_map(folder, settings)
    arrays = found.arrays()
    with torch_threads():
        packed = gsply.compress_to_bytes(for_gsply(gsply, arrays[along_curve(arrays.xyz)]))
        written = from_gsply(gsply.decompress_from_bytes(packed))
    with atomic_path(path) as draft:
        draft.write_bytes(packed)
    return found.result(path, written)
