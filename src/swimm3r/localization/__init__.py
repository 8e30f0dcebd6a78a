"""Localization of images in a map by the paper's protocol: `localize` for one image, `Localizer` for many."""

from typing import TYPE_CHECKING

from swimm3r.progress import Progress, watched

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from swimm3r.cameras import Cameras
    from swimm3r.localization.settings import LocalizationSettings
    from swimm3r.scene.frames import Frames
    from swimm3r.scene.reconstruction import Reconstruction
    from swimm3r.splat.rendering import SplatMap


def localize(
    image: "Float[Tensor, 'h w 3']",
    scene: "SplatMap",
    rec: "Reconstruction",
    frames: "Frames | None" = None,
    lens: "Cameras | None" = None,
    settings: "LocalizationSettings | None" = None,
    time: float | None = None,
    progress: Progress | None = None,
) -> "Float[Tensor, '4 4']":
    """cam2world of one image, in the axes and unit of `rec`. Raises RegistrationError where it cannot be placed.

    The query is first matched with training images: `frames` has them; without, the map's renderings from the same
    poses take their place. `lens` is the image's camera (its pose unused), by default that of the reconstruction;
    `time`, seconds of the clip, is the moment at which a dynamic map is shown. A terminal or a notebook shows how far
    it is, unless `progress` is given (`swimm3r.silent`: nothing). Many images are placed faster by one
    `localization.localizer.Localizer`.
    """
    from swimm3r.localization.localizer import Localizer

    with watched(progress) as told:
        localizer = Localizer(scene, rec, frames, settings, progress=told)
    return localizer.in_axes_of_sfm(localizer.locate(image, lens=lens, time=time).cam2world)
