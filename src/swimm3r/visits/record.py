"""OUT/visits.json: visits of one site in one frame, how they were aligned, and the changes between them."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import Remedy
from swimm3r.io.files.json_file import read_json
from swimm3r.products.record import MapGrid
from swimm3r.rounding import rounded

RECORD = "visits.json"
SCHEMA = 2
_REMEDY = Remedy("swimm3r visits RUN_A RUN_B --out DIR, which writes it again")


@dataclass(frozen=True)
class AlignmentRecord:
    """The way a visit came into the frame of an earlier one."""

    onto: str  # name of the other visit
    source: str  # images, markers or georeference
    matches: int
    agreeing: int  # matches that agree on one similarity
    merged: int  # matches that joint mapping took for one point of both visits
    error_px: float | None  # median reprojection error of these
    scale: float  # units of the first visit's files per unit of this one's
    rotation: tuple[tuple[float, float, float], ...]  # from this visit's axes to the first one's
    shift: tuple[float, float, float]  # in the unit of the first visit's files
    check_points: int  # shared points that joint mapping left out
    level_std: float  # of the place of this visit on the other one's ground, horizontal, per axis
    up_std: float


@dataclass(frozen=True)
class VisitRecord:
    """One visit."""

    name: str
    run: str  # path of the run folder, as given
    frames: int  # registered
    area: float  # of the ground that it saw, unit^2
    clear_colors: bool
    alignment: AlignmentRecord | None  # None for the first visit


@dataclass(frozen=True)
class ChangeRecord:
    """The change from one visit to the next."""

    earlier: str
    later: str
    folder: str  # of the layers, inside OUT
    compared_area: float  # that both visits saw
    gained_area: float
    lost_area: float
    paler_area: float
    darker_area: float
    gained_volume: float
    gained_volume_std: float
    lost_volume: float
    lost_volume_std: float
    height_std: float | None  # of a typical cell's difference
    height_inflation: float  # factor that deviations were multiplied by, as the spread of all cells says
    shifted: float  # median difference of heights, taken for the alignment's
    color_std: float | None  # of a typical cell's difference, CIELAB
    color_inflation: float | None
    gains: tuple[float, float, float]  # on the later visit's linear colors
    places: int
    files: tuple[str, ...]


@dataclass(frozen=True)
class VisitsRecord(MapGrid):
    """All visits and changes."""

    threshold: float  # standard deviations from which a change is significant
    visits: tuple[VisitRecord, ...]
    changes: tuple[ChangeRecord, ...]
    notes: tuple[str, ...] = ()
    schema: int = SCHEMA

    def save(self, folder: Path) -> None:
        """Write visits.json, whole or not at all."""
        write_text(folder / RECORD, json.dumps(asdict(self), indent=2) + "\n")

    def __str__(self) -> str:
        u, lines = self.unit, []
        for visit in self.visits:
            text = f"{visit.name}: {visit.frames} frames, {rounded(visit.area, 4)} {u}² of ground"
            if visit.alignment is not None:
                by = visit.alignment
                text += f"; onto {by.onto} by {by.source}"
                if by.error_px is not None:
                    text += f", {by.merged} of {by.matches} matched points are one to {by.error_px:.2g} px"
                text += f"; ± {rounded(by.level_std, 2)} {u} level, ± {rounded(by.up_std, 2)} {u} up"
            lines.append(text)
        lines += [line for change in self.changes for line in change_lines(change, u, self.threshold)]
        return "\n".join([*lines, *(f"Note: {note}" for note in self.notes)])


def change_lines(change: ChangeRecord, unit: str, threshold: float) -> list[str]:
    """The figures of a change in words."""
    compared = max(change.compared_area, 1e-12)
    both = rounded(change.compared_area, 4)
    lines = [f"{change.earlier} to {change.later}: {change.places} changed places on {both} {unit}² that both saw"]
    for name, area, volume, std in (
        ("gained", change.gained_area, change.gained_volume, change.gained_volume_std),
        ("lost", change.lost_area, change.lost_volume, change.lost_volume_std),
    ):
        moved = f"{rounded(volume, 3)} ± {rounded(std, 1)} {unit}³"
        lines.append(f"  {name}: {rounded(area, 3)} {unit}² ({area / compared:.1%}), {moved}")
    if change.color_std is not None:
        for name, area in (("paler", change.paler_area), ("darker", change.darker_area)):
            lines.append(f"  {name}: {rounded(area, 3)} {unit}² ({area / compared:.1%})")
    if change.height_std is not None:
        least = f"  a cell's height has changed from {rounded(threshold * change.height_std, 2)} {unit} on"
        if change.color_std is not None:
            least += f", its color from a CIELAB difference of {rounded(threshold * change.color_std, 2)} on"
        lines.append(f"{least} ({threshold:g} standard deviations of a typical cell)")
    return lines


def read_record(folder: Path) -> VisitsRecord:
    """The record in a folder of visits. Raises InputError where it is missing or damaged."""
    return read_json(folder / RECORD, VisitsRecord, _REMEDY)
