"""Navigation for mapping: where models of a clip lie in common local metres (`scene.placement`).

Positions get the standard deviations that the alignment found for them, each widened by the weight it had there, and
all by the correlation of neighbors: bundle adjustment takes priors for independent.
"""

from dataclasses import dataclass, replace

import numpy as np

from swimm3r.errors import InputError
from swimm3r.scale.navigation.fit import NavigationFit, fit_navigation
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scene.frames import Frames
from swimm3r.scene.placement import Navigator, Placement
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sim3 import Sim3

_SCALE_STD = 0.05  # of a part that navigation may hold: a tenth of its depth in two of three dives
_ROTATION_STD = 8.0  # degrees


@dataclass(frozen=True)
class NavigationFile(Navigator):
    """The navigation that settings name."""

    settings: ScaleSettings

    def place(self, rec: Reconstruction, frames: Frames) -> Placement:
        """See `Navigator`."""
        return _placement(rec, fit_navigation(rec, frames, self.settings))

    def place_part(self, rec: Reconstruction, frames: Frames, beside: Placement) -> Placement | None:
        """See `Navigator`; a part is held where its scale is known to 5 % and its attitude to 8 degrees."""
        try:
            fit = fit_navigation(rec, frames, self._at_offset_of(beside))
        except InputError:  # too few positions, or a part that is bent: it stays a model of its own, which is warned of
            return None
        found = _placement(rec, fit)
        return found if found.scale_std < _SCALE_STD and found.rotation_std_deg < _ROTATION_STD else None

    def _at_offset_of(self, beside: Placement) -> ScaleSettings:
        if beside.offset is None or self.settings.nav_offset is not None:
            return self.settings
        return replace(self.settings, nav_offset=beside.offset)


def _placement(rec: Reconstruction, fit: NavigationFit) -> Placement:
    found, frame = fit.alignment, fit.matched.frame
    used = ~found.outliers
    centers = rec.cameras.centers.double().numpy()[frame[used]]
    widened = found.std[used] * np.sqrt(found.correlation / found.weight[used])[:, None]
    local_from_model = Sim3(found.scale, found.R, found.t)
    return Placement(
        local_from_model=local_from_model,
        scale_std=found.scale_std,
        rotation_std_deg=float(found.rotation_std_deg.max()),
        names=tuple(rec.names[i] for i in frame[used]),
        position=local_from_model(centers) - found.residual[used],
        std=widened,
        offset=None if fit.offset is None else fit.offset.seconds,
    )
