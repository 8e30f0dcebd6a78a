"""Dense depth of posed frames without learned weights: a multi-view plane sweep and what survives a second opinion.

For every frame: source views by baseline and shared points; a cost volume over planes even in inverse depth (1 - NCC,
which neither contrast lost with distance nor veil added changes); semi-global smoothing (Hirschmueller 2008); slanted
windows refined from neighbor to neighbor (Bleyer et al. 2011) at full size. Then, over all frames, a depth stays
where it is well correlated, where moving it makes it worse, where other frames' depths agree, and where those that look
from elsewhere do not see through it; open water and bare sand come out unknown (0), not invented. The work is done on
undistorted images, the result lies on the frame's grid.
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
from swimm3r.sfm.plane_sweep.seen_through import without_seen_through
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings
from swimm3r.sfm.plane_sweep.specks import without_specks
from swimm3r.sfm.plane_sweep.sweep import RawDepth, sweep, transfer
from swimm3r.sfm.plane_sweep.views import (
    SweepView,
    choose_sources,
    depth_range,
    gray_weights,
    make_view,
    on_frame_grid,
    points_by_frame,
)
from swimm3r.tasks import run_tasks
from swimm3r.tasks.settings import EngineSettings
from swimm3r.tasks.threads import thread_count

Step = Literal["depth", "depth agreement", "depth seen through"]
"""Each view's own opinion, what other views share of it, and of each frame what no other view looks through."""

_DRAFTS: dict[Step, str] = {"depth": ".raw", "depth agreement": ".agreed"}
"""Folders beside the finished maps, of what a step leaves for the next one, and removed after that."""
_LAYOUTS = {"inverse_depth": Layout("h w"), "correlation": Layout("h w")}
_STAMP = ".made_from"  # of which cameras, points and settings the folder's maps were made
_OF_A_TASK = 16  # frames
_NEIGHBORS = 8  # views asked whether they agree
_WITNESSES = 24  # views asked whether they see through


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
    stamp = _stamp(rec, frames, settings)
    _claim(folder, stamp)
    passes = _Passes(rec, frames, settings)
    before: Step | None = None
    for step, wanted in passes.wanted().items():
        left = [k for k in wanted if not passes.is_done(step, k)]
        if engine.is_in_this_process:
            _each(passes.step(step), left, len(wanted), settings.threads, partial(progress, step))
        else:
            firsts = range(0, len(left), _OF_A_TASK)
            groups = [tuple(left[k : k + _OF_A_TASK]) for k in firsts]
            parts = [
                PartOfPass(f"{step} of frames {k + 1} to {k + len(group)}", step, group)
                for k, group in zip(firsts, groups, strict=True)
            ]
            work = partial(make_part, folder=folder.parent.resolve(), frames=frames, settings=settings, stamp=stamp)
            if failures := run_tasks(work, parts, engine, progress, step, logs=folder.parent.resolve() / "logs"):
                raise failures[0].error
        if before is not None:
            shutil.rmtree(folder / _DRAFTS[before], ignore_errors=True)
        before = step
    return rec.depth


@dataclass(frozen=True)
class PartOfPass:
    """Views, or of the last step frames, by their index, that one task sweeps or compares."""

    name: str
    step: Step
    items: tuple[int, ...]


def make_part(part: PartOfPass, *, folder: Path, frames: Frames, settings: PlaneSweepSettings, stamp: str) -> None:
    """The task of some frames, with the reconstruction that a folder holds; finished ones are left as they are.

    `stamp` tells it from those that the folder held before.
    """
    passes = _passes_over(folder, frames, settings, stamp)
    left = [k for k in part.items if not passes.is_done(part.step, k)]
    _each(passes.step(part.step), left, len(part.items), settings.threads, lambda done, total: None)


@lru_cache(maxsize=1)  # several tasks in one process, which may outlive the reconstruction
def _passes_over(folder: Path, frames: Frames, settings: PlaneSweepSettings, stamp: str) -> "_Passes":
    return _Passes(load_reconstruction(folder, frames), frames, settings)


class _Passes:
    """The passes over the frames of a reconstruction, with the views and maps they read kept in memory."""

    def __init__(self, rec: Reconstruction, frames: Frames, settings: PlaneSweepSettings) -> None:
        self._rec, self._frames, self._settings = rec, frames, settings
        self._device = for_depth(settings.device)
        self._facets = facets_of(rec.cameras, settings.long_side)
        self._canvas, self._views_of = self._facets.cameras, in_facets(rec, self._facets)
        most = max(settings.sources, _NEIGHBORS, _WITNESSES)
        self._sources = choose_sources(self._views_of, most, settings.angle_deg)
        self._neighbors = [best[: max(settings.sources, _NEIGHBORS)] for best in self._sources]
        self._points, self._pose_error = points_by_frame(self._views_of), _pose_error(rec, self._canvas)
        self._position = {name: k for k, name in enumerate(frames.names)}
        self._gray = gray_weights(frames, rec.names, settings.long_side)
        self._views = ArrayCache(max_bytes=256 << 20)
        self._drafts: dict[Step, ArrayCache] = {step: ArrayCache(max_bytes=256 << 20) for step in _DRAFTS}

    def wanted(self) -> dict[Step, list[int]]:
        """The views that each step is for, and of the last step the frames, in order: what unfinished ones need."""
        names = self._rec.names
        unfinished = [
            view for i, name in enumerate(names) if name not in self._rec.depth for view in self._facets.of_frame(i)
        ]
        agreed = _with_their(self._sources, unfinished)
        return {
            "depth": _with_their(self._neighbors, [v for v in agreed if not self.is_done("depth agreement", v)]),
            "depth agreement": agreed,
            "depth seen through": list(range(len(names))),
        }

    def step(self, step: Step) -> Callable[[int], None]:
        """The work of a step on one view, or of the last step on one frame."""
        steps = {"depth": self._sweep, "depth agreement": self._agree, "depth seen through": self._finish}
        return steps[step]

    def is_done(self, step: Step, k: int) -> bool:
        """True where the result of a step is there."""
        return self._draft_path(step, k).is_file() if step in _DRAFTS else self._rec.names[k] in self._rec.depth

    def _draft_path(self, step: Step, view: int) -> Path:
        return self._rec.depth.folder / _DRAFTS[step] / f"{self._views_of.names[view]}.npz"

    def _keep(self, step: Step, view: int, depth: RawDepth) -> None:
        with atomic_path(self._draft_path(step, view)) as draft:
            np.savez(draft, inverse_depth=depth.inverse_depth.numpy(), correlation=depth.correlation.numpy())

    def _kept(self, step: Step, view: int) -> RawDepth:
        def load() -> tuple[np.ndarray, ...]:
            stored = read_arrays(self._draft_path(step, view), _LAYOUTS, remake(self._rec.depth.folder))
            return stored["inverse_depth"], stored["correlation"]

        return RawDepth(*(torch.from_numpy(a.copy()) for a in self._drafts[step].get(view, load)))

    def _view(self, view: int) -> SweepView:
        def load() -> tuple[np.ndarray, ...]:
            frame = self._facets.frame_of(view)
            k = self._position[self._rec.names[frame]]
            image, mask, lens = self._frames.image(k), self._frames.mask(k), self._rec.cameras[frame]
            made = make_view(image @ self._gray, mask, lens, self._canvas[view], self._facets.turn_of(view))
            return made.gray.numpy(), made.detail.numpy(), made.seen.numpy()

        gray, detail, seen = (torch.from_numpy(a.copy()) for a in self._views.get(view, load))
        return SweepView(gray, detail, seen, self._canvas.K[view], self._canvas[view].world2cam[0])

    def _sweep(self, view: int) -> None:
        canvas, settings = self._canvas, self._settings
        compared = self._sources[view][: settings.sources]
        span = depth_range(self._views_of, view, self._points[view])
        raw = RawDepth(torch.zeros(canvas.height, canvas.width), torch.zeros(canvas.height, canvas.width))
        if span is not None and compared:
            raw = sweep(self._view(view), [self._view(j) for j in compared], span, settings, self._device)
        self._keep("depth", view, raw)

    def _agree(self, view: int) -> None:
        others = self._neighbors[view]
        raws, canvas = [self._kept("depth", j) for j in others], self._canvas[[view, *others]]
        agreed = consistent(self._kept("depth", view), raws, canvas, self._pose_error, self._settings)
        self._keep("depth agreement", view, agreed)

    def _finish(self, i: int) -> None:
        rec, lens = self._rec, self._rec.cameras[i]
        k = self._position[rec.names[i]]
        wanted = self._frames.image(k) @ self._gray
        on_grid = [self._on_grid(view, wanted, lens) for view in self._facets.of_frame(i)]
        q, confidence = merged([q for q, _ in on_grid], [share for _, share in on_grid], frame_rays(lens), self._facets)
        usable = (q > 0) & self._frames.mask(k)
        z_depth = torch.where(usable, 1 / q.clamp(min=1e-12), 0.0)
        rec.depth.write(rec.names[i], DepthMap(z_depth, torch.where(usable, confidence, 0.0)))

    def _on_grid(
        self, view: int, wanted: Float[Tensor, "h w"], lens: Cameras
    ) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
        """Inverse depth along a view's axis that none looks through, and its confidence, on its frame's grid."""
        others, canvas = self._sources[view], self._canvas
        agreed = (self._kept("depth agreement", j) for j in (view, *others))
        kept = without_seen_through(next(agreed), agreed, canvas[[view, *others]], self._settings)
        gray, turn = self._view(view).gray, self._facets.turn_of(view)
        return on_frame_grid(kept.inverse_depth, kept.correlation, gray, wanted, lens, canvas[view], turn)


def _with_their(others: list[list[int]], views: list[int]) -> list[int]:
    """Views and the others of each, in order."""
    return sorted({j for view in views for j in (view, *others[view])})


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
    for name in _DRAFTS.values():
        shutil.rmtree(folder / name, ignore_errors=True)
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
