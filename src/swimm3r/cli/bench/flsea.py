"""`swimm3r bench flsea` and `ablation-sfm`: methods on FLSea's test sequences."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from swimm3r.bench.settings import ABLATION, SfmMethods
from swimm3r.cli.bench.table import ALL_METHODS, ONE_BY_ONE, Defaults, Jobs, Methods, show_table
from swimm3r.cli.terminal.options import FLAT, DataRoot, Out
from swimm3r.pipeline.presets import Preset
from swimm3r.settings import Count
from swimm3r.sfm.settings import ColmapSettings, Mast3rSettings
from swimm3r.tasks.settings import EngineSettings


@dataclass(frozen=True)
class Sequences:
    """The images that the methods are compared on."""

    stride: Count = 1
    """Use every N-th frame, the same for all methods and for the reference."""
    sequences: tuple[str, ...] = ()
    """Sequences by the names of their folders; by default the paper's test split."""


def flsea_command(defaults: Defaults) -> Callable:
    """The command, with the settings of a preset as defaults."""

    def flsea(
        root: DataRoot,
        /,
        out: Out,
        given: Methods = ALL_METHODS,
        images: Annotated[Sequences, FLAT] = Sequences(),
        preset: Preset = defaults.preset,
        colmap: ColmapSettings = defaults.colmap,
        mast3r: Mast3rSettings = defaults.mast3r,
        jobs: Jobs = ONE_BY_ONE,
    ) -> None:
        """Depth and poses of every method on FLSea's test sequences.

        Depth is scored against the data set's own, poses against COLMAP on its restored images.

        Args:
            root: FLSea-VI as unpacked.
            out: Folder for frames, references, results and the tables flsea.md, .csv, .json and .tex.
            given: Methods to compare, and their files.
            preset: Preset that supplies the other defaults.
            colmap: COLMAP's settings, for the reference too.
            mast3r: Settings of the methods that use the network.
            jobs: Sequences computed in parallel.
        """
        _compare("flsea", root, out, given, images, colmap, mast3r, jobs, defaults.label(preset, colmap, mast3r))

    return flsea


def ablation_sfm_command(defaults: Defaults) -> Callable:
    """The command, with the settings of a preset as defaults."""

    def ablation_sfm(
        root: DataRoot,
        /,
        out: Out,
        adapters: Path | None = None,
        images: Annotated[Sequences, FLAT] = Sequences(),
        preset: Preset = defaults.preset,
        colmap: ColmapSettings = defaults.colmap,
        mast3r: Mast3rSettings = defaults.mast3r,
        jobs: Jobs = ONE_BY_ONE,
    ) -> None:
        """Depth and poses of trainings that leave out a part of medium-aware distillation.

        For their restored images: bench sfm --methods swimm3r without-forward ..., then bench restoration.

        Args:
            root: FLSea-VI as unpacked.
            out: Folder for frames, references, results and the tables ablation-sfm.md, .csv, .json and .tex.
            adapters: Folder with trainings of swimm3r train-sfm by recipe: DIR/without-forward/adapter.safetensors ...
            preset: Preset that supplies the other defaults.
            colmap: COLMAP's settings, for the reference.
            mast3r: Settings of the methods that use the network.
            jobs: Sequences computed in parallel.
        """
        given, label = SfmMethods(ABLATION, adapters), defaults.label(preset, colmap, mast3r)
        _compare("ablation-sfm", root, out, given, images, colmap, mast3r, jobs, label)

    return ablation_sfm


def _compare(
    name: str,
    root: Path,
    out: Path,
    given: SfmMethods,
    images: Sequences,
    colmap: ColmapSettings,
    mast3r: Mast3rSettings,
    jobs: EngineSettings,
    preset: str,
) -> None:
    from swimm3r.bench.protocols.flsea import compare_on_flsea

    show_table(
        out,
        lambda progress: compare_on_flsea(
            root, out, given, colmap, mast3r, images.stride, images.sequences, jobs, progress, name
        ),
        preset,
    )
