"""A blotchy plane at z = 2, filmed from known places, and the reconstruction that is exactly right."""

from pathlib import Path

import torch

from swimm3r.cameras import Cameras, pixel_grid, unproject
from swimm3r.geometry import pose_from, so3_exp
from swimm3r.io.images import write_rgb
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.features.sift import extract_features

WIDTH, HEIGHT = 480, 360
FEATURES = FeatureSettings(count=1200)
_HALF = 3.2  # the texture spans x, y in -3.2..3.2


def texture(seed: int = 0) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    blotches = torch.zeros(3, 1600, 1600) + sum(
        torch.nn.functional.interpolate(torch.rand(1, 3, n, n, generator=rng), (1600, 1600), mode="bicubic")[0] / n**0.3
        for n in (24, 80, 240)
    )
    return (blotches - blotches.min()) / (blotches.max() - blotches.min())


def camera(x: float, turn: float = 0.0) -> Cameras:
    """A camera that looks at the plane from (x, 0, 0), turned a little about all axes."""
    K = torch.tensor([[[440.0, 0, 240], [0, 440, 180], [0, 0, 1]]], dtype=torch.float64)
    angles = torch.tensor([0.02 + 0.05 * turn, 0.1 * turn, -0.02 + 0.1 * turn], dtype=torch.float64)
    center = torch.tensor([x, 0.05 * turn, 0.1 * turn], dtype=torch.float64)
    return Cameras(K, torch.zeros(1, 0, dtype=torch.float64), pose_from(so3_exp(angles), center)[None], WIDTH, HEIGHT)


def on_plane(seen_by: Cameras, pixels: torch.Tensor) -> torch.Tensor:
    """The points of the plane that pixels show."""
    near = unproject(seen_by, pixels[None], torch.ones(1, len(pixels), dtype=torch.float64))[0]
    ray = near - seen_by.centers[0]
    return seen_by.centers[0] + ray * ((2 - seen_by.centers[0, 2]) / ray[:, 2])[:, None]


def photo(seen_by: Cameras, shown: torch.Tensor) -> torch.Tensor:
    """The image of the plane from a camera."""
    at = on_plane(seen_by, pixel_grid(HEIGHT, WIDTH).reshape(-1, 2).double())[:, :2] / _HALF
    grid = at.float().reshape(1, HEIGHT, WIDTH, 2)
    return torch.nn.functional.grid_sample(shown[None], grid, align_corners=False)[0].permute(1, 2, 0).clamp(0, 1)


def reconstruction(folder: Path, places: list[float]) -> tuple[Reconstruction, Frames]:
    """Frames from these places (`filmed`)."""
    return filmed(folder, [camera(x, turn=x) for x in places])


def filmed(folder: Path, cameras: list[Cameras]) -> tuple[Reconstruction, Frames]:
    """Frames by these cameras; each keypoint is the observation of a point of its own."""
    shown, frames, points, rows = texture(), [], [], []
    for i, one in enumerate(cameras):
        path = folder / f"{i}.png"
        image = photo(one, shown)
        write_rgb(path, image.numpy())
        frames.append(Frame(path.name, path, float(i), 1.0, "train"))
        stored = Frames((frames[-1],), WIDTH, HEIGHT, ordered=True)
        found = extract_features(stored.image(0), torch.ones(HEIGHT, WIDTH).bool(), FEATURES)
        pixels = torch.from_numpy(found.keypoints[:, :2]).double()
        rows += [(len(points) + k, i, *xy) for k, xy in enumerate(pixels.tolist())]
        points += list(on_plane(one, pixels))
    table, none = torch.tensor(rows, dtype=torch.float64), torch.zeros(0, dtype=torch.int64)
    rec = Reconstruction(
        names=tuple(frame.name for frame in frames),
        cameras=Cameras(
            torch.cat([one.K for one in cameras]),
            torch.zeros(len(cameras), 0, dtype=torch.float64),
            torch.cat([one.cam2world for one in cameras]),
            WIDTH,
            HEIGHT,
        ),
        points=Points(torch.stack(points), torch.zeros(len(points), 3), torch.zeros(len(points))),
        tracks=Tracks(table[:, 0].long(), table[:, 1].long(), table[:, 2:].float()),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=DepthMaps(folder),
        backend="truth",
    )
    return rec, Frames(tuple(frames), WIDTH, HEIGHT, ordered=True)
