"""Splatting: a reconstruction in, a map that renders with its water, without it, and as depth out."""

from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING

from swimm3r.progress import Progress, watched
from swimm3r.splat.settings import MapDevice, SplatSettings, UwbsSettings
from swimm3r.tasks.settings import EngineSettings

if TYPE_CHECKING:
    import swimm3r.scene.frames
    import swimm3r.scene.reconstruction
    import swimm3r.splat.rendering
    import swimm3r.splat.training.observer

__all__ = ["SplatSettings", "UwbsSettings", "train"]


def train(
    reconstruction: "swimm3r.scene.reconstruction.Reconstruction",
    frames: "swimm3r.scene.frames.Frames",
    settings: SplatSettings | None = None,
    folder: str | Path | None = None,
    progress: Progress | None = None,
    device: MapDevice = "auto",
    observer: "swimm3r.splat.training.observer.Observer | None" = None,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
) -> "swimm3r.splat.rendering.SplatMap":
    """A map of the reconstruction, trained on the registered of `frames.train`.

    `settings` choose size and method: `swimm3r.PRESETS["fast"].splat` takes minutes on a laptop, and
    `dataclasses.replace` changes single ones; without any they are the paper's, which take hours without a GPU.

    Works in `folder` (a new temporary one by default) and goes on exactly from what an interrupted call left there.
    It is trained on `device`, where the map then stays: CUDA where it is here and NVIDIA Warp installed, by default.
    A terminal or a notebook shows how far it is, unless `progress` is given (`swimm3r.silent`: nothing); `observer` is
    called after every step and changes nothing of the map. The map of a large dive is trained in blocks
    (`UwbsSettings.blocks`), which `engine` can spread over processes or a cluster.
    Raises InputError where no training frame is registered, DeviceError where `device` is not here.
    """
    from swimm3r import devices
    from swimm3r.splat import train_map

    place = devices.for_maps(device)
    folder = Path(folder or mkdtemp(prefix="swimm3r-splat-"))
    with watched(progress) as told:
        return train_map.train(
            reconstruction, frames, settings or UwbsSettings(), folder, told, place, observer, engine
        )
