"""Dense depth of posed frames without learned weights: a multi-view plane sweep and what survives a second opinion.

For every frame: source views by baseline and shared points; a cost volume over planes even in inverse depth (1 - NCC,
which neither contrast lost with distance nor veil added changes); semi-global smoothing (Hirschmueller 2008); slanted
windows refined from neighbor to neighbor (Bleyer et al. 2011) at full size. Then, over all frames, a depth stays
where it is well correlated, where moving it makes it worse, and where other frames' depths agree; open water and bare
sand come out unknown (0), not invented. The work is done on undistorted images, the result lies on the frame's grid.
"""

import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.devices import for_depth
from swimm3r.imaging.undistortion import frame_rays
from swimm3r.io.files.array_file import Layout, read_arrays
from swimm3r.io.files.atomic import atomic_path, write_text
from swimm3r.io.files.cache import ArrayCache
from swimm3r.io.files.cache_key import bytes_digest, cache_key
from swimm3r.io.files.damage import remake
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.plane_sweep import consistency
from swimm3r.sfm.plane_sweep.facets import facets_of, in_facets, merged
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings
from swimm3r.sfm.plane_sweep.specks import without_specks
from swimm3r.sfm.plane_sweep.sweep import RawDepth, sweep, transfer
from swimm3r.sfm.plane_sweep.views import (
    SweepView,
    choose_sources,
    depth_range,
    make_view,
    on_frame_grid,
    points_by_frame,
)
from swimm3r.tasks import run_tasks
from swimm3r.tasks.settings import EngineSettings
from swimm3r.tasks.threads import thread_count

Step = Literal["depth", "depth agreement"]

_RAW = ".raw"  # beside the finished maps: each frame's own opinion, removed once every frame is finished
_RAW_LAYOUTS = {"inverse_depth": Layout("h w"), "correlation": Layout("h w")}
_STAMP = ".made_from"  # of which cameras, points and settings the folder's maps were made
_OF_A_TASK = 16  # frames
_NEIGHBORS = 8  # frames asked whether they agree


def estimate_depth(
    rec: Reconstruction,
    frames: Frames,
    settings: PlaneSweepSettings,
    progress: Progress = silent,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
) -> DepthMaps:
    """The depth maps of every registered frame, written to `rec.depth` on the frames' own pixel grid.

    Maps of an interrupted call with the same cameras, points and settings are kept, others are made anew. A frame that
    sees fewer than 8 points, or has no source views, gets a map without depth. `engine` can spread the frames over
    processes or a cluster, which read the reconstruction from the folder that it was saved in. Raises the error of the
    first frame that failed.
    """
    folder = rec.depth.folder
    _claim(folder, _stamp(rec, frames, settings))
    passes = _Passes(rec, frames, settings)
    todo = [i for i, name in enumerate(rec.names) if name not in rec.depth]
    wanted = sorted({j for i in todo for view in passes.facets.of_frame(i) for j in (view, *passes.sources[view])})
    missing = [i for i in wanted if not passes.raw_path(i).is_file()]
    steps: tuple[tuple[Step, list[int], int], ...] = (
        ("depth", missing, len(wanted)),
        ("depth agreement", todo, len(rec.names)),
    )
    for name, left, total in steps:
        if engine.is_in_this_process:
            _each(passes.step(name), left, total, settings.threads, partial(progress, name))
            continue
        parts = [
            PartOfPass(
                f"{name} of frames {k + 1} to {min(k + _OF_A_TASK, len(left))}", name, tuple(left[k : k + _OF_A_TASK])
            )
            for k in range(0, len(left), _OF_A_TASK)
        ]
        work = partial(make_part, folder=folder.parent.resolve(), frames=frames, settings=settings)
        if failures := run_tasks(work, parts, engine, progress, name, logs=folder.parent.resolve() / "logs"):
            raise failures[0].error
    shutil.rmtree(folder / _RAW, ignore_errors=True)
    return rec.depth


@dataclass(frozen=True)
class PartOfPass:
    """Frames, by their index in the reconstruction, that one task sweeps or compares."""

    name: str
    step: Step
    frames: tuple[int, ...]


def make_part(part: PartOfPass, *, folder: Path, frames: Frames, settings: PlaneSweepSettings) -> None:
    """The task of some frames, with the reconstruction that a folder holds; finished ones are left as they are."""
    passes = _passes_over(folder, frames, settings)
    left = [i for i in part.frames if not passes.is_done(part.step, i)]
    _each(passes.step(part.step), left, len(part.frames), settings.threads, lambda done, total: None)


@lru_cache(maxsize=1)  # several tasks in one process
def _passes_over(folder: Path, frames: Frames, settings: PlaneSweepSettings) -> "_Passes":
    return _Passes(load_reconstruction(folder, frames), frames, settings)


class _Passes:
    """The two passes over the frames of a reconstruction, with the views and maps they read kept in memory."""

    def __init__(self, rec: Reconstruction, frames: Frames, settings: PlaneSweepSettings) -> None:
        self._rec, self._frames, self._settings = rec, frames, settings
        self._device = for_depth(settings.device)
        self.facets = facets_of(rec.cameras, settings.long_side)
        self._canvas, self._views_of = self.facets.cameras, in_facets(rec, self.facets)
        self.sources = choose_sources(self._views_of, max(settings.sources, _NEIGHBORS), settings.angle_deg)
        self._points, self._pose_error = points_by_frame(self._views_of), _pose_error(rec, self._canvas)
        self._position = {name: k for k, name in enumerate(frames.names)}
        self._views, self._raws = ArrayCache(max_bytes=256 << 20), ArrayCache(max_bytes=256 << 20)

    def raw_path(self, i: int) -> Path:
        return self._rec.depth.folder / _RAW / f"{self._views_of.names[i]}.npz"

    def step(self, name: Step) -> Callable[[int], None]:
        return self._sweep_one if name == "depth" else self._agree_one

    def is_done(self, name: Step, i: int) -> bool:
        return self.raw_path(i).is_file() if name == "depth" else self._rec.names[i] in self._rec.depth

    def _view(self, i: int) -> SweepView:
        def load() -> tuple[np.ndarray, ...]:
            frame = self.facets.frame_of(i)
            k = self._position[self._rec.names[frame]]
            image, mask = self._frames.image(k), self._frames.mask(k)
            made = make_view(image, mask, self._rec.cameras[frame], self._canvas[i], self.facets.turn_of(i))
            return made.gray.numpy(), made.detail.numpy(), made.seen.numpy()

        gray, detail, seen = (torch.from_numpy(a.copy()) for a in self._views.get(i, load))
        return SweepView(gray, detail, seen, self._canvas.K[i], self._canvas[i].world2cam[0])

    def _raw_of(self, i: int) -> RawDepth:
        def load() -> tuple[np.ndarray, ...]:
            stored = read_arrays(self.raw_path(i), _RAW_LAYOUTS, remake(self._rec.depth.folder))
            return stored["inverse_depth"], stored["correlation"]

        return RawDepth(*(torch.from_numpy(a.copy()) for a in self._raws.get(i, load)))

    def _sweep_one(self, i: int) -> None:
        canvas, settings = self._canvas, self._settings
        span, compared = depth_range(self._views_of, i, self._points[i]), self.sources[i][: settings.sources]
        raw = RawDepth(torch.zeros(canvas.height, canvas.width), torch.zeros(canvas.height, canvas.width))
        if span is not None and compared:
            raw = sweep(self._view(i), [self._view(j) for j in compared], span, settings, self._device)
        with atomic_path(self.raw_path(i)) as draft:
            np.savez(draft, inverse_depth=raw.inverse_depth.numpy(), correlation=raw.correlation.numpy())

    def _agree_one(self, i: int) -> None:
        rec, frames = self._rec, self._frames
        k = self._position[rec.names[i]]
        on_grid = [self._agreed(view, frames.image(k), rec.cameras[i]) for view in self.facets.of_frame(i)]
        rays = frame_rays(rec.cameras[i])
        q, confidence = merged([q for q, _ in on_grid], [share for _, share in on_grid], rays, self.facets)
        usable = (q > 0) & frames.mask(k)
        z_depth = torch.where(usable, 1 / q.clamp(min=1e-12), 0.0)
        rec.depth.write(rec.names[i], DepthMap(z_depth, torch.where(usable, confidence, 0.0)))

    def _agreed(
        self, view: int, image: Float[Tensor, "h w 3"], lens: Cameras
    ) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
        """Inverse depth along a view's axis that others share, and its confidence, on the grid of the view's frame."""
        others, canvas = self.sources[view], self._canvas
        raws = [self._raw_of(j) for j in others]
        fused = consistent(self._raw_of(view), raws, canvas[[view, *others]], self._pose_error, self._settings)
        gray, turn = self._view(view).gray, self.facets.turn_of(view)
        return on_frame_grid(fused.inverse_depth, fused.correlation, gray, image, lens, canvas[view], turn)


def consistent(
    raw: RawDepth, others: Sequence[RawDepth], cameras: Cameras, pose_error: float, settings: PlaneSweepSettings
) -> RawDepth:
    """The depths that at least `settings.agreeing` other frames share, averaged with theirs, `without_specks`.

    Of a point that fewer others have in their images, all of these must, one at least. `cameras` are the frame's own
    and then those of the others; `pose_error` is the usual reprojection error, pixels. The confidence, in place of
    `correlation`, is how far the NCC exceeds its threshold times how many agree (3 = 1).
    """
    if not others:
        return RawDepth(torch.zeros_like(raw.inverse_depth), torch.zeros_like(raw.correlation))
    (K, *Ks), (pose, *poses) = cameras.K.numpy(), cameras.world2cam.numpy()
    there = [transfer(K, pose, K_other, other) for K_other, other in zip(Ks, poses, strict=True)]
    back = [transfer(K_other, other, K, pose) for K_other, other in zip(Ks, poses, strict=True)]
    fused, count, possible = consistency.agreement(
        raw.inverse_depth.numpy(), np.stack([other.inverse_depth.numpy() for other in others]),
        np.stack([H for H, _ in there]), np.stack([e for _, e in there]),
        np.stack([H for H, _ in back]), np.stack([e for _, e in back]), settings.tolerance, pose_error,
    )  # fmt: skip
    needed = np.minimum(settings.agreeing, np.maximum(possible, 1))
    fused = without_specks(np.where(count >= needed, fused, 0), count > settings.agreeing, settings.speck)
    above = (raw.correlation.numpy() - settings.min_ncc) / (1 - settings.min_ncc)
    confidence = np.where(fused > 0, above.clip(0.05, 1) * np.minimum(count / 3, 1), 0).astype(np.float32)
    return RawDepth(torch.from_numpy(fused), torch.from_numpy(confidence))


def _pose_error(rec: Reconstruction, canvas: Cameras) -> float:
    """The median reprojection error of the sparse points in canvas pixels, at most 1.5."""
    error = rec.points.error[rec.points.error.isfinite()]
    if not len(error):
        return 0.0
    return min(1.5, float(error.median() * canvas.K[0, 0, 0] / rec.cameras.K[0, 0, 0]))


def _stamp(rec: Reconstruction, frames: Frames, settings: PlaneSweepSettings) -> str:
    names = set(rec.names)
    masks = [frame.mask for frame in frames if frame.name in names]
    seen = (rec.cameras.K, rec.cameras.distortion, rec.cameras.cam2world, rec.points.xyz, rec.tracks.point)
    numbers = bytes_digest(*(np.ascontiguousarray(tensor.numpy()).tobytes() for tensor in seen))
    return cache_key(settings, rec.names, rec.cameras.width, rec.cameras.height, masks, numbers)


def _claim(folder: Path, stamp: str) -> None:
    """Empty the folder of maps unless they were made from the same cameras, points and settings."""
    path = folder / _STAMP
    if path.is_file() and path.read_bytes() == stamp.encode():
        return
    shutil.rmtree(folder / _RAW, ignore_errors=True)
    for stale in folder.rglob("*.npz"):
        stale.unlink()
    write_text(path, stamp)


def _each(
    work: Callable[[int], None], items: Sequence[int], total: int, threads: int, tell: Callable[[int, int], None]
) -> None:
    """Do the work for every item on several threads (the kernels release the interpreter); `tell` may stop it."""
    done = total - len(items)
    with ThreadPoolExecutor(threads or min(8, thread_count())) as pool:
        pending = [pool.submit(work, item) for item in items]
        try:
            for future in as_completed(pending):
                future.result()
                done += 1
                tell(done, total)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
