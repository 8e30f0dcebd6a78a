"""Starting settings of the protocols, options that they share, and the table that each of them prints."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from swimm3r.bench.settings import SfmMethods
from swimm3r.cli.terminal.console import drawn_progress
from swimm3r.cli.terminal.options import FLAT
from swimm3r.pipeline.presets import MAST3R_PRESETS, PRESETS, Preset
from swimm3r.progress import Progress
from swimm3r.scene.settings import FrameSettings
from swimm3r.sfm.settings import ColmapSettings, Mast3rSettings
from swimm3r.splat.settings import PoseRefinementSettings, UwbsSettings
from swimm3r.tasks.settings import EngineSettings

if TYPE_CHECKING:
    from swimm3r.bench.tables import Table

Jobs = Annotated[EngineSettings, FLAT]
Methods = Annotated[SfmMethods, FLAT]
Frames = Annotated[FrameSettings, FLAT]
ONE_BY_ONE, ALL_METHODS = EngineSettings(), SfmMethods()


@dataclass(frozen=True)
class Defaults:
    """A preset's settings as the protocols start from them: frames evenly spaced, as the paper's are."""

    preset: Preset
    frames: FrameSettings
    colmap: ColmapSettings
    mast3r: Mast3rSettings
    splat: UwbsSettings
    test: PoseRefinementSettings

    def label(self, preset: Preset, *given: object) -> str:
        """The preset as a table names it; `given` are the settings of the command, whatever their order."""
        own = (self.frames, replace(self.frames, long_side=0), self.colmap, self.mast3r, self.splat, self.test)
        return preset if all(one in own for one in given) else f"{preset}, changed by options"


def defaults_of(preset: Preset) -> Defaults:
    """The starting settings under a preset."""
    found = PRESETS[preset]
    assert isinstance(found.sfm, ColmapSettings)
    assert isinstance(found.splat, UwbsSettings)
    frames = replace(found.frames, pick="uniform")
    return Defaults(preset, frames, found.sfm, MAST3R_PRESETS[preset], found.splat, found.test)


def show_table(out: Path, protocol: "Callable[[Progress], Table]", preset: str = "") -> None:
    """Run a protocol while nobody else works in its folder; write its table there and print it."""
    from swimm3r.bench import tables
    from swimm3r.io.files.folder_lock import folder_lock
    from swimm3r.io.files.outputs import output_folder

    with output_folder(out), folder_lock(out), drawn_progress() as progress:
        table = protocol(progress)
        print(tables.write(out, replace(table, preset=preset)))
