"""Options that the commands of the pipeline share, beside the settings of its stages."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from swimm3r.cli.terminal.options import FLAT, OutOrDefault
from swimm3r.pipeline.presets import Preset
from swimm3r.sfm.settings import BackendName
from swimm3r.splat.settings import MapDevice, RecipeName
from swimm3r.tasks.settings import EngineSettings
from swimm3r.viewer.settings import Port, ViewerSettings


@dataclass(frozen=True)
class OriginOptions:
    """The origin of the other options' defaults."""

    preset: Preset | None = None
    """Preset that supplies the other defaults. Without it and --config they are those of the run folder, else
    `default`."""
    config: Path | None = None
    """Settings file, such as the settings.yaml of another run, that supplies the other defaults."""
    redo: bool = False
    """Repeat stages that were made with other settings; the earlier results move to RUN/old."""


@dataclass(frozen=True)
class FolderOptions(OriginOptions):
    """The run folder, and the origin of the other options' defaults."""

    out: OutOrDefault = None
    """Run folder that receives all results; may be left out where SOURCE is a run folder."""


@dataclass(frozen=True)
class PoseOptions:
    """The way to poses and depth, and poses to compare with."""

    backend: BackendName = "colmap"
    """Method for poses and depth. mast3r needs weights, swimm3r an adapter too; `--backend mast3r --help-all` lists
    its options."""
    reference: Path | None = None
    """File cameras.json with known poses to score the result against."""


@dataclass(frozen=True)
class ViewOptions:
    """The page that shows a run while it is made."""

    view: bool = False
    """Show the run in the browser while it is made: the map growing, the losses, a test frame beside its render."""
    host: str = ViewerSettings().host
    """Network address of --view: 127.0.0.1 for this computer alone, 0.0.0.0 for everyone who can reach it."""
    port: Port = ViewerSettings().port
    """Port of --view; the next free one where it is taken."""


@dataclass(frozen=True)
class ProductOptions:
    """Products of a finished run."""

    products: bool = False
    """Make maps, habitat figures, mesh and cloud at the end, as swimm3r products does by default."""


Engine = Annotated[EngineSettings, FLAT]
HERE = EngineSettings()


@dataclass(frozen=True)
class MapOptions:
    """The kind of map, and the device that trains it."""

    recipe: RecipeName = "uwbs-static"
    """Kind of map: uwbs-static, uwbs-dynamic for scenes that change with time, or another published method.
    `--recipe NAME --help-all` lists its options."""
    map_device: MapDevice = "auto"
    """Device that trains and renders the map; auto uses CUDA if a GPU and NVIDIA Warp are present."""
