"""A survey without images: cameras on parallel lines over rough ground, in axes and a unit that differ from metres."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from swimm3r.cameras import Cameras, project_visible
from swimm3r.io.navigation.record import Navigation, vehicle_attitude
from swimm3r.scale.navigation.alignment import MOUNTS
from swimm3r.scale.navigation.geodesy import Origin, geodetic_from_local
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import DepthMaps, Matches, Points, Reconstruction, Tracks

SCALE = 0.4  # metres per unit of the run
TURN = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()  # from metres to the axes of the run
ORIGIN = Origin(-21.98, -176.56, -30.0)
WIDTH, HEIGHT, FOCAL = 640, 480, 500.0
START = 1_800_000_000.0  # seconds since 1970 of the first frame


@dataclass(frozen=True)
class Survey:
    """The run, and the truth in metres east, north and up of `ORIGIN`."""

    rec: Reconstruction
    frames: Frames
    position: np.ndarray  # of the cameras
    attitude: np.ndarray  # of the vehicle
    angles: np.ndarray  # heading, pitch and roll, degrees
    seconds: np.ndarray  # since 1970

    def geodetic(self, position: np.ndarray | None = None) -> np.ndarray:
        """Latitudes, longitudes and heights."""
        return geodetic_from_local(self.position if position is None else position, ORIGIN)

    def navigation(self, position: np.ndarray | None = None, **options) -> Navigation:
        """Its navigation as a record in local metres."""
        given = self.position if position is None else position
        whole = Navigation(Path("nav.csv"), "local", given, "utc", self.seconds, attitude=self.attitude)
        return replace(whole, **options)

    def in_run(self, metres: np.ndarray) -> np.ndarray:
        """Points in the coordinates of the run."""
        return metres @ TURN.T / SCALE

    def pixels(self, metres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of points in all frames, and which see them."""
        points = torch.from_numpy(self.in_run(metres))
        xy, _, seen = project_visible(self.rec.cameras, points[None].expand(len(self.rec.names), -1, -1))
        return xy.numpy(), seen.numpy()


def lines(count: int = 3, each: int = 16, step: float = 0.3, side: float = 0.8) -> np.ndarray:
    """Places of the cameras: lines to and fro at a height of about 2 m over ground at 0."""
    out = []
    for line in range(count):
        along = np.arange(each) * step
        x = along if line % 2 == 0 else along[::-1]
        out.append(np.stack([x, np.full(each, line * side), 2 + 0.2 * np.sin(2 * x + line)], -1))
    return np.concatenate(out)


def survey_along(position: np.ndarray, seed: int = 0, spacing: float = 1.0) -> Survey:
    """A survey whose camera looks down and wobbles."""
    rng = np.random.default_rng(seed)
    count = len(position)
    ahead = np.gradient(position[:, :2], axis=0)
    heading = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1]))
    angles = np.stack([heading, 4 * np.sin(np.arange(count) / 3), 5 * np.cos(np.arange(count) / 4)], -1)
    attitude = vehicle_attitude(*angles.T)
    mount = MOUNTS["down"] @ Rotation.from_rotvec([0.03, -0.02, 0.01]).as_matrix()
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = TURN @ attitude @ mount
    poses[:, :3, 3] = position @ TURN.T / SCALE
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    cameras = Cameras(K.repeat(count, 1, 1), torch.zeros(count, 0).double(), torch.from_numpy(poses), WIDTH, HEIGHT)
    low, high = position.min(0) - 1, position.max(0) + 1
    ground = np.stack([*rng.uniform(low[:2], high[:2], (2000, 2)).T, 0.05 * rng.normal(size=2000)], -1)
    xyz = torch.from_numpy(ground @ TURN.T / SCALE)
    xy, _, seen = project_visible(cameras, xyz[None].expand(count, -1, -1))
    frame, point = seen.nonzero().T
    names = tuple(f"{i:04d}.png" for i in range(count))
    none = torch.zeros(0, dtype=torch.int64)
    rec = Reconstruction(
        names=names,
        cameras=cameras,
        points=Points(xyz, torch.full((len(xyz), 3), 0.5), torch.full((len(xyz),), 0.3).double()),
        tracks=Tracks(point, frame, xy[frame, point].float()),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=DepthMaps(Path("none")),
        backend="truth",
    )
    times = np.arange(count) * spacing
    listed = tuple(Frame(n, Path(n), float(t), 1.0, "train") for n, t in zip(names, times, strict=True))
    begin = np.datetime64(int(START), "s").astype(str)
    frames = Frames(listed, WIDTH, HEIGHT, True, recorded=f"{begin}+00:00")
    return Survey(rec, frames, position, attitude, angles, START + times)


@pytest.fixture(scope="session")
def survey() -> Survey:
    return survey_along(lines())


def write_csv(path: Path, survey: Survey, **changed: object) -> Path:
    """The navigation as a CSV; `changed` replaces or, with None, removes columns."""
    latitude, longitude, height = survey.geodetic().T
    heading, pitch, roll = survey.angles.T
    columns: dict[str, object] = {
        "time": survey.seconds, "latitude": latitude, "longitude": longitude, "depth": -height,
        "heading": heading, "pitch": pitch, "roll": roll, **changed,
    }  # fmt: skip
    columns = {name: values for name, values in columns.items() if values is not None}
    rows = zip(*columns.values(), strict=True)  # type: ignore[call-overload]
    lines_ = [",".join(columns), *(",".join(v if isinstance(v, str) else repr(float(v)) for v in row) for row in rows)]
    path.write_text("\n".join(lines_) + "\n")
    return path
