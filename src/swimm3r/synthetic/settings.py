"""Every number of a synthetic dive; torch-free, so that --help is instant."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from swimm3r.errors import UsageError
from swimm3r.refraction.settings import HousingKind, PortSettings
from swimm3r.settings import ImageSide, Range, Seed, Settings, Share

_Beta = Annotated[float, Range(0, 100)]
_Light = Annotated[float, Range(0.1, 10)]
_Offset = Annotated[float, Range(-10, 10)]


@dataclass(frozen=True)
class Coefficients(Settings):
    """A given water, per RGB channel, on pixel values as stored."""

    Binf: tuple[Share, Share, Share] = (0.09, 0.53, 0.52)
    """Veiling light of the open water, 0..1 per channel."""
    beta_D: tuple[_Beta, _Beta, _Beta] = (0.48, 0.15, 0.12)
    """Attenuation of the scene's light per channel, 1/m of ray depth."""
    beta_B: tuple[_Beta, _Beta, _Beta] = (0.36, 0.26, 0.24)
    """Build-up of backscatter per channel, 1/m of ray depth."""


@dataclass(frozen=True)
class Season(Settings):
    """Changes of the seafloor since the first visit."""

    grown: Share = 0.0
    """Share of the corals that have grown, 30 % wider and 50 % higher."""
    bleached: Share = 0.0
    """Share of the corals that have bleached."""
    broken: Share = 0.0
    """Share of the corals that have lost 70 % of their height."""
    moved: Share = 0.0
    """Share of the corals that lie 42 cm further to the right."""
    algae: Share = 0.0
    """Share of the square meters on which a patch of algae has grown."""
    sand: Annotated[float, Range(0, 0.3)] = 0.0
    """Height in meters of the highest bank of sand that has built up, and depth of the deepest hollow."""

    def __post_init__(self) -> None:
        super().__post_init__()
        total = self.grown + self.bleached + self.broken + self.moved
        if total > 1 + 1e-9:
            raise UsageError(
                f"the shares of corals that have grown, bleached, broken and moved are {total:g} together",
                cause="each coral has one fate at most",
                hint="shares whose sum is at most 1",
            )


@dataclass(frozen=True)
class LampSettings(Settings):
    """A lamp that the camera carries, in deep water without daylight; it acts on pixel values as stored."""

    position: tuple[_Offset, _Offset, _Offset] = (0.35, -0.3, 0.0)
    """Position of the lamp in meters: to the right of the camera, below it, and ahead of it."""
    beam: Annotated[float, Range(5, 170)] = 90.0
    """Full angle of the beam in degrees, between the directions of half the axis's light."""
    fall_off: Annotated[float, Range(0, 4)] = 0.91
    """Power of the distance that the light falls with on values as stored: 2 in linear light, 2 / 2.2 as stored."""
    reference: Annotated[float, Range(0.1, 20)] = 2.0
    """Distance on the optical axis, in meters, at which the light without water is `strength`."""
    strength: Annotated[float, Range(0.01, 100)] = 1.3
    """Light at the reference distance; 1 shows a surface in its clear colors."""
    glow: Share = 0.35
    """Backscatter of the lamp in open water, as a share of the veiling light of the same water in daylight."""


@dataclass(frozen=True)
class DiveSettings(Settings):
    """A synthetic dive over a procedural seafloor: a diver's loop over a terrace, or a survey of a plain."""

    path: Literal["loop", "transect", "lawnmower"] = "loop"
    """Path of the camera: a loop of a few meters over a terrace; or, over a plain of any size, a straight transect or
    parallel lines with a last line across them (lawnmower)."""
    frames: Annotated[int, Range(1, 10_000)] = 32
    """Number of frames of a loop; a survey has as many as its length, speed and frame rate make."""
    length: Annotated[float, Range(1, 10_000)] = 50.0
    """Length of a survey's path in meters."""
    speed: Annotated[float, Range(0.05, 3)] = 0.3
    """Speed of a survey in m/s."""
    fps: Annotated[float, Range(0.1, 60)] = 5.0
    """Frames per second."""
    altitude: Annotated[float, Range(1, 1.8)] = 1.5
    """Mean height of a survey's camera above the sand in meters."""
    width: ImageSide = 480
    """Width of the frames in pixels."""
    height: ImageSide = 320
    """Height of the frames in pixels."""
    fov: Annotated[float, Range(10, 170)] = 56.0
    """Field of view in degrees in air: horizontal, or diagonal of a fisheye lens."""
    squeeze: Annotated[float, Range(0.5, 2)] = 1.0
    """Factor by which the image is narrower than the lens drew it: 4/3 for a film of 16:9 that is stored as 4:3."""
    readout: Annotated[float, Range(0, 0.1)] = 0.0
    """Seconds between the exposures of the first and the last row (rolling shutter); 0 exposes all at once."""
    fisheye: bool = False
    """Film through an equidistant fisheye lens, whose image grows evenly with the angle from the axis."""
    housing: HousingKind = "none"
    """Port of the camera housing, through which every ray is traced."""
    port: PortSettings = field(default_factory=PortSettings)
    stereo: Annotated[float, Range(0, 2)] = 0.0
    """Distance in meters of a second camera to the right of the first; 0 for a single camera. Images are in left/ and
    right/ then."""
    stereo_delay: Annotated[float, Range(0, 10)] = 0.0
    """Seconds by which the second camera takes its images later: a pair that is not synchronized."""
    seed: Seed = 0
    """Seed of seafloor, path, water and disturbances."""
    family: Literal["cyan", "teal", "green", "warm"] | None = None
    """Family of the paper's water types to draw from, instead of `coefficients`."""
    coefficients: Coefficients = Coefficients()
    visit: Annotated[int, Range(0, 1000)] = 0
    """Number of the visit to the seafloor of `seed`; each has a path and disturbances of its own."""
    corals: Share = 0.0
    """Share of the square meters on which a massive coral stands."""
    season: Season = Season()
    daylight: tuple[_Light, _Light, _Light] = (1.0, 1.0, 1.0)
    """Light on the scene per channel, by that of a plain day, in linear light."""
    lit_by: Literal["sun", "lamp"] = "sun"
    """Light of the dive: the sun, or a lamp on the camera."""
    lamp: LampSettings = LampSettings()
    caustics: Annotated[float, Range(0, 10)] = 0.0
    """Strength of the moving light pattern; 0.5 is a bright day in 3 m of water."""
    marine_snow: Annotated[int, Range(0, 100_000)] = 0
    """Number of drifting particles in the view of one frame."""
    noise: Share = 0.004
    """Standard deviation of the sensor noise, in pixel values 0..1."""
    vignetting: Share = 0.0
    """Share of light lost in the corners of the image."""
    exposure: Annotated[float, Range(0, 3)] = 0.0
    """Largest change of the camera's exposure from frame to frame, in stops up or down."""
    white_balance: Annotated[float, Range(0, below=1)] = 0.0
    """Largest change of the camera's gains of red and blue from frame to frame, as a share."""
    local_exposure: Annotated[float, Range(0, 3)] = 0.0
    """Change of the exposure over a single frame, as local tone mapping makes it, in stops (standard deviation)."""
    moving_object: bool = False
    """Let a fish swim across the view once during the dive."""
    printed_markers: Annotated[int, Range(0, 50)] = 0
    """Number of printed markers (aruco-4x4-50) that lie on plates along the path."""
    printed_marker_size: Annotated[float, Range(0.02, 1)] = 0.2
    """Outer side of the markers' black square in meters."""
    give_masks: bool = False
    """Write the masks of the moving object beside images/, where the pipeline uses them, not only under truth/."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path != "loop" and self.moving_object:
            raise UsageError(
                "the moving object swims in loops only",
                cause=f"moving_object was asked for together with path={self.path!r}",
                hint="path='loop', or no moving object",
            )
        if self.lit_by == "lamp" and (self.moving_object or self.marine_snow or self.caustics):
            raise UsageError(
                "the moving object, marine snow and caustics are of dives in daylight",
                cause="one of them was asked for together with lit_by='lamp'",
                hint="lit_by='sun', or a lamp's dive without them",
            )

        self._check_lens()

    def _check_lens(self) -> None:
        if self.fisheye and self.path != "loop":
            raise UsageError(
                "a fisheye lens would see further than the synthetic plain shows",
                cause=f"fisheye was asked for together with path={self.path!r}",
                hint="path='loop', or no fisheye lens",
            )
        if (self.fisheye or self.housing != "none") and self.squeeze != 1:
            raise UsageError(
                "squeezed films are of plain lenses",
                cause="squeeze was asked for together with a fisheye lens or a port",
                hint="squeeze=1, or neither of them",
            )
        if self.printed_markers and self.readout:
            raise UsageError(
                "printed markers are seen by cameras that expose all rows at once",
                cause="printed_markers was asked for together with readout",
                hint="readout=0, or no printed markers",
            )
        if self.housing != "none" and (self.moving_object or self.printed_markers or self.lit_by == "lamp"):
            raise UsageError(
                "the moving object, printed markers and lamps are of dives without a port",
                cause=f"one of them was asked for together with housing={self.housing!r}",
                hint="housing='none', or a dive without them",
            )

    def stream(self, *of: int) -> list[int]:
        """Seed of random numbers of a kind: every visit but the first has streams of its own."""
        return [self.seed, *of] if self.visit == 0 else [self.seed, *of, self.visit + (1 << 20)]

    @property
    def sides(self) -> tuple[str, ...]:
        """Names of the cameras of a stereo dive; none of a single camera."""
        return ("left", "right") if self.stereo else ()

    @property
    def frame_count(self) -> int:
        """Number of frames of the dive, of each of its cameras."""
        return self.frames if self.path == "loop" else int(self.length / self.speed * self.fps) + 1
