"""`swimm3r bench PROTOCOL`: the paper's tables on your own dives, one sub-command each."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg, subcommand

from swimm3r.bench.settings import ABLATION, JobSettings, Seeds, SfmMethods
from swimm3r.cli.terminal.console import drawn_progress
from swimm3r.cli.terminal.ranges import with_ranges
from swimm3r.localization.settings import GS_CPR, LocalizationSettings
from swimm3r.pipeline.presets import MAST3R_PRESETS, PRESETS, Preset, RunSettings
from swimm3r.progress import Progress
from swimm3r.scene.settings import FrameSettings
from swimm3r.settings import Count
from swimm3r.sfm.settings import ColmapSettings, Mast3rSettings
from swimm3r.splat.settings import RECIPES, PoseRefinementSettings, RecipeName, UwbsSettings

if TYPE_CHECKING:
    from swimm3r.bench.tables import Table

_FLAT = arg(name="")
_Jobs = Annotated[JobSettings, _FLAT]
_Methods = Annotated[SfmMethods, _FLAT]
_ONE_BY_ONE, _ALL_METHODS = JobSettings(), SfmMethods()


def command_for_preset(name: Preset) -> Callable:
    """The command, with the map settings of a preset as defaults."""
    defaults = PRESETS[name]
    assert isinstance(defaults.sfm, ColmapSettings)
    assert isinstance(defaults.splat, UwbsSettings)
    full = defaults.splat
    found_poses, picked_evenly = defaults.sfm, replace(defaults.frames, pick="uniform")
    as_filmed = replace(picked_evenly, long_side=0)

    def ablation_uwbs(
        runs: Positional[tuple[Path, ...]],
        /,
        out: Path,
        seeds: Seeds = 3,
        preset: Preset = "fast",
        splat: UwbsSettings = full,
        test: PoseRefinementSettings = defaults.test,
        jobs: _Jobs = _ONE_BY_ONE,
    ) -> None:
        """Train the map without its parts, several seeds each: baseline, + SGG, + depth, full.

        Args:
            runs: run folders with finished structure from motion; they are only read.
            out: where maps, scores and the tables go: ablation.md, .csv, .json and .tex.
            seeds: trainings of each variant on each run.
            preset: what the other defaults aim at.
            splat: how the full variant is trained; the others are it without a part.
            test: how the test frames' poses are refined.
            jobs: scenes in parallel.
        """
        from swimm3r.bench.protocols.ablation_uwbs import ablate

        kept = (splat, test) == (full, defaults.test)
        _show(out, lambda progress: ablate(runs, out, splat, seeds, test, jobs, progress), _preset(preset, kept))

    def render(
        inputs: Positional[tuple[Path, ...]],
        /,
        out: Path,
        recipes: tuple[RecipeName, ...] = RECIPES,
        seeds: Seeds = 1,
        poses: bool = False,
        given_poses: bool = False,
        against: RecipeName | None = None,
        references: Path | None = None,
        preset: Preset = "fast",
        frames: FrameSettings = picked_evenly,
        sfm: ColmapSettings = found_poses,
        splat: UwbsSettings = full,
        test: PoseRefinementSettings = defaults.test,
        jobs: _Jobs = _ONE_BY_ONE,
    ) -> None:
        """Train every recipe on every clip's structure from motion and compare how they show the test frames.

        Args:
            inputs: run folders with finished structure from motion, which are only read; or clips, of which runs are
                made in OUT/runs. Runs of one clip whose poses were found in different ways are rows of one table.
            out: where maps, scores, images side by side and the tables go: render.md, .csv, .json and .tex.
            recipes: the renderers.
            seeds: trainings of each recipe on each run.
            poses: add all recipes again with the training frames' poses refined along with the map.
            given_poses: clips are folders of images with a COLMAP model (SeaThru-NeRF and its kin); take its poses.
            against: the recipe that differences are taken from; the first where none is named.
            references: a folder with CLIP.json (a cameras.json) of all frames of each clip, test frames included; by
                default their poses are found by COLMAP.
            preset: what the other defaults aim at.
            frames: which frames to take of clips; the paper's are evenly spaced.
            sfm: how poses, depth and water of clips are found.
            splat: size and length of the maps; a recipe changes what makes it another method.
            test: how the test frames' poses are refined.
            jobs: scenes in parallel.
        """
        from swimm3r.bench import reference
        from swimm3r.bench.cells import check_choice
        from swimm3r.bench.protocols.render import compare_renderers
        from swimm3r.bench.runs import made_runs

        def run(progress: Progress) -> "Table":
            check_choice("recipes", recipes, against)  # before minutes of structure from motion
            reference.given(references, "")
            runs = made_runs(inputs, out, RunSettings(frames, sfm, splat, test), given_poses, progress)
            return compare_renderers(runs, out, recipes, splat, seeds, poses, test, against, references, jobs, progress)

        kept = (frames, sfm, splat, test) == (picked_evenly, found_poses, full, defaults.test)
        _show(out, run, _preset(preset, kept))

    def sfm(
        clips: Positional[tuple[Path, ...]],
        /,
        out: Path,
        given: _Methods = _ALL_METHODS,
        references: Path | None = None,
        preset: Preset = "fast",
        frames: FrameSettings = as_filmed,
        colmap: ColmapSettings = found_poses,
        mast3r: Mast3rSettings = MAST3R_PRESETS[name],
        jobs: _Jobs = _ONE_BY_ONE,
    ) -> None:
        """Structure from motion of clips by every method: registration, epipolar error, inliers, points, clouds.

        Methods whose weights, adapters or models are not here are reported as not run.

        Args:
            clips: videos or folders of stills.
            out: where the methods' run folders, images of the clouds and the tables go: sfm.md, .csv, .json and .tex.
            given: the methods and their files.
            references: a folder with NAME.json (a cameras.json) of clips whose poses are known; synthetic dives bring
                their own.
            preset: what the other defaults aim at.
            frames: which frames to take; the paper's are evenly spaced and of their own size.
            colmap: how COLMAP works, and depth, water and cloud of all methods without a network.
            mast3r: how the network's methods work.
            jobs: clips in parallel.
        """
        from swimm3r.bench.protocols.sfm import compare_sfm

        settings = RunSettings(frames, colmap, defaults.splat, defaults.test)
        kept = (frames, colmap, mast3r) == (as_filmed, found_poses, MAST3R_PRESETS[name])
        _show(
            out,
            lambda progress: compare_sfm(clips, out, given, settings, mast3r, references, jobs, progress),
            _preset(preset, kept),
        )

    def flsea(
        root: Positional[Path],
        /,
        out: Path,
        given: _Methods = _ALL_METHODS,
        stride: Count = 1,
        sequences: tuple[str, ...] = (),
        preset: Preset = "fast",
        colmap: ColmapSettings = found_poses,
        mast3r: Mast3rSettings = MAST3R_PRESETS[name],
        jobs: _Jobs = _ONE_BY_ONE,
    ) -> None:
        """Depth and poses of every method on FLSea's test sequences.

        Judged against the set's own depth, and COLMAP on its restored images.

        Args:
            root: FLSea-VI as unpacked.
            out: where frames, references, the methods' results and the tables go: flsea.md, .csv, .json and .tex.
            given: the methods and their files.
            stride: take every so-manieth frame, the same for all methods and for the reference.
            sequences: by the names of their folders; the paper's test split where none is named.
            preset: what the other defaults aim at.
            colmap: how COLMAP works, for the reference, too.
            mast3r: how the network's methods work.
            jobs: sequences in parallel.
        """
        from swimm3r.bench.protocols.flsea import compare_on_flsea

        _show(
            out,
            lambda progress: compare_on_flsea(root, out, given, colmap, mast3r, stride, sequences, jobs, progress),
            _preset(preset, (colmap, mast3r) == (found_poses, MAST3R_PRESETS[name])),
        )

    def ablation_sfm(
        root: Positional[Path],
        /,
        out: Path,
        adapters: Path | None = None,
        stride: Count = 1,
        sequences: tuple[str, ...] = (),
        preset: Preset = "fast",
        colmap: ColmapSettings = found_poses,
        mast3r: Mast3rSettings = MAST3R_PRESETS[name],
        jobs: _Jobs = _ONE_BY_ONE,
    ) -> None:
        """The same of the trainings that leave out a part of medium-aware distillation.

        Their restored images: bench sfm --methods swimm3r without-forward ..., then bench restoration.

        Args:
            root: FLSea-VI as unpacked.
            out: where frames, references, results and the tables go: ablation-sfm.md, .csv, .json and .tex.
            adapters: trainings of swimm3r train-sfm by their recipes: DIR/without-forward/adapter.safetensors ...
            stride: take every so-manieth frame.
            sequences: by the names of their folders; the paper's test split where none is named.
            preset: what the other defaults aim at.
            colmap: how the reference is made.
            mast3r: how the network's methods work.
            jobs: sequences in parallel.
        """
        from swimm3r.bench.protocols.flsea import compare_on_flsea

        given = SfmMethods(ABLATION, adapters)
        _show(
            out,
            lambda progress: compare_on_flsea(
                root, out, given, colmap, mast3r, stride, sequences, jobs, progress, "ablation-sfm"
            ),
            _preset(preset, (colmap, mast3r) == (found_poses, MAST3R_PRESETS[name])),
        )

    protocols = {
        "flsea": flsea,
        "sfm": sfm,
        "restoration": restoration,
        "render": render,
        "localization": localization,
        "ablation-sfm": ablation_sfm,
        "ablation-uwbs": ablation_uwbs,
    }
    action = None
    for protocol, command in protocols.items():
        one = Annotated[None, subcommand(protocol, constructor=with_ranges(command))]
        action = one if action is None else action | one

    def bench(action: Annotated[action, arg(name="")]) -> None:  # pyright: ignore[reportInvalidTypeForm]
        """The paper's tables on your own dives. Results stay in --out; the same command goes on where it stopped."""

    return bench


def restoration(
    runs: Positional[tuple[Path, ...]],
    /,
    out: Path,
    jobs: _Jobs = _ONE_BY_ONE,
) -> None:
    """Score the restored frames of runs without reference: UIQM, UCIQE, and URanker or why it is not there.

    Rows are of physical colors, before the white balance of the shown images, which has rows of its own.

    Args:
        runs: run folders with finished structure from motion, such as bench sfm leaves; they are only read.
        out: where images side by side and the tables go: restoration.md, .csv, .json and .tex.
        jobs: scenes in parallel.
    """
    from swimm3r.bench.protocols.restoration import score_restoration

    _show(out, lambda progress: score_restoration(runs, out, jobs, progress))


def localization(
    runs: Positional[tuple[Path, ...]],
    /,
    out: Path,
    maps: Path | None = None,
    references: Path | None = None,
    settings: LocalizationSettings = GS_CPR,
    jobs: _Jobs = _ONE_BY_ONE,
) -> None:
    """Place every test frame of finished runs in their maps, judged by structure from motion of all frames.

    Several runs of one clip, their poses found in different ways, are rows of one table.

    Args:
        runs: run folders; they are only read.
        out: where match images, references and the tables go: localization.md, .csv, .json and .tex.
        maps: a folder of swimm3r bench render; its maps of these runs take the place of the runs' own.
        references: a folder with CLIP.json (a cameras.json) of all frames of each clip, test frames included; by
            default their poses are found by COLMAP.
        settings: the protocol; SIFT where no MASt3R weights are here.
        jobs: scenes in parallel.
    """
    from swimm3r.bench.protocols.localization import localize

    _show(out, lambda progress: localize(runs, out, settings, maps, references, jobs, progress))


def _preset(name: Preset, kept: bool) -> str:
    """The preset as a table names it."""
    return name if kept else f"{name}, changed by options"


def _show(out: Path, protocol: "Callable[[Progress], Table]", preset: str = "") -> None:
    from swimm3r.bench import tables
    from swimm3r.io.files.folder_lock import folder_lock
    from swimm3r.io.files.outputs import output_folder

    with output_folder(out), folder_lock(out), drawn_progress() as progress:
        table = protocol(progress)
        print(tables.write(out, replace(table, preset=preset)))
