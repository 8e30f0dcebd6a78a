"""A map's views on disk: images of one camera, and a flight along the path of the dive.

NAME_rgb.png             with the water                NAME_clear.png            without it, white-balanced for display
NAME_backscatter.png     the light of the water alone  NAME_clear_physical.png   before the white balance, 16 bits
NAME_z_depth.png         depth in colors               NAME_z_depth.npz          z_depth, scene units, and alpha
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from swimm3r import devices
from swimm3r.cameras import Cameras, cameras_of, image_directions, ray_depth_from_z
from swimm3r.errors import InputError
from swimm3r.geometry import pose_from, quaternion_from_rotation, rotation_from_quaternion
from swimm3r.imaging.depth_colors import depth_image, depth_span
from swimm3r.io import cameras_json, images
from swimm3r.io.cameras_json import CameraTable
from swimm3r.io.files.atomic import atomic_path
from swimm3r.io.view_names import view_stems
from swimm3r.medium import transmittances
from swimm3r.pipeline.presets import from_yaml
from swimm3r.prepare import load_frames
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.settings import ClipSecond, CountOrZero, LongSideOrOwn, accepted
from swimm3r.sfm.medium.restore import keep_open_water
from swimm3r.sfm.settings import RestoreSettings
from swimm3r.splat.map_file import load_map
from swimm3r.splat.rendering import RenderOutput, SplatMap
from swimm3r.splat.settings import MapDevice
from swimm3r.splat.training_poses import axes_of_map

KINDS = ("rgb", "clear", "clear_physical", "backscatter", "z_depth")
"""The PNG files of one view, NAME_KIND.png."""
_RATE = 15  # images per second of the flight
_X264 = {"crf": "23", "preset": "medium", "x264-params": "mbtree=0"}
"""Options of the video encoder, which gives the same bits for the same images: the vector code of its macroblock tree
reads beyond its rows where half a width is no multiple of a vector, and what it finds there moves its decisions."""
_SMOOTH = 1.5  # frames of the dive over which the flight's hand steadies


@dataclass(frozen=True)
class DisplayStyle:
    """Display of a dive's restored frames, and of the clear views and depths of its map."""

    gains: Float[Tensor, "3"]  # white balance of clear images (`scene.white_balance`)
    near_far: tuple[float, float]  # z depths that are red and blue, scene units
    restore: RestoreSettings


def display_style(scene: SplatMap, rec: Reconstruction, restore: RestoreSettings | None = None) -> DisplayStyle:
    """The look that the restored frames of a reconstruction have, for views of its map."""
    gains = rec.white_balance.factors if scene.has_water else torch.ones(3)
    return DisplayStyle(gains, depth_span(rec.point_depths()), restore or RestoreSettings())


def shown_clear(out: RenderOutput, camera: Cameras, style: DisplayStyle) -> Float[Tensor, "h w 3"]:
    """A map's clear view as the restored frames are shown, white-balanced; open water keeps the color it has.

    So does what the water lets no channel see: the clear color of such a surface is noise. `out.clear` itself is
    physical, and what scores are taken of.
    """
    ray_depth = ray_depth_from_z(out.z_depth, image_directions(camera).to(out.z_depth))
    T_D, _ = transmittances(ray_depth, out.medium)
    return keep_open_water(out.clear * style.gains, T_D, out.rgb, 1 - out.alpha, style.restore)


def physical_clear(out: RenderOutput, camera: Cameras, style: DisplayStyle) -> Float[Tensor, "h w 3"]:
    """The same before the white balance: colors that scores without a reference may be taken of."""
    return shown_clear(out, camera, replace(style, gains=torch.ones(3)))


def write_view(folder: Path, stem: str, out: RenderOutput, camera: Cameras, style: DisplayStyle) -> None:
    """The files of one view, as the head of this module lists them."""
    shown = {"rgb": out.rgb, "clear": shown_clear(out, camera, style), "backscatter": out.backscatter}
    for kind, image in shown.items():
        images.write_rgb(folder / f"{stem}_{kind}.png", image.numpy())
    images.write_rgb_16(folder / f"{stem}_clear_physical.png", physical_clear(out, camera, style).numpy())
    images.write_rgb(folder / f"{stem}_z_depth.png", depth_image(out.z_depth.numpy(), *style.near_far))
    with atomic_path(folder / f"{stem}_z_depth.npz") as draft:
        np.savez_compressed(draft, z_depth=out.z_depth.numpy(), alpha=out.alpha.numpy())


def smooth_path(cam2world: Float[Tensor, "c 4 4"], count: int) -> Float[Tensor, "f 4 4"]:
    """`count` poses along a path of cameras, without the shaking of the hand that held them."""
    q = quaternion_from_rotation(cam2world[:, :3, :3].double()).numpy().copy()
    for i in range(1, len(q)):  # q and -q are one rotation, but not on the way in between
        if q[i] @ q[i - 1] < 0:
            q[i] *= -1
    stations = np.concatenate([cam2world[:, :3, 3].double().numpy(), q], 1)
    at = np.linspace(0, len(stations) - 1, count)
    dense = np.stack([np.interp(at, np.arange(len(stations)), column) for column in stations.T], 1)
    per_frame = (count - 1) / max(1, len(stations) - 1)
    width = _SMOOTH * per_frame
    steady = torch.from_numpy(gaussian_filter1d(dense, width, axis=0, mode="nearest") if width else dense)
    return pose_from(rotation_from_quaternion(steady[:, 3:]), steady[:, :3])


def write_flythrough(
    path: Path,
    scene: SplatMap,
    canvas: Cameras,
    cam2world: Float[Tensor, "c 4 4"],
    times: Sequence[float],
    count: int,
    style: DisplayStyle,
    progress: Progress = silent,
) -> None:
    """An H.264 video of `count` views along the cameras' path: with the water, and beside it without.

    `times` are the cameras' own, seconds of the clip; the flight takes as many of its own on the way.
    """
    clock = np.interp(np.linspace(0, len(times) - 1, count), np.arange(len(times)), times)

    def views() -> Iterable[UInt8[np.ndarray, "h w 3"]]:
        for i, pose in enumerate(smooth_path(cam2world, count)):
            progress("filming the flight", i, count)
            camera = replace(canvas, cam2world=pose[None])
            out = scene.render(camera, float(clock[i]))
            both = torch.cat([out.rgb, shown_clear(out, camera, style)], 1)
            yield (both.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        progress("filming the flight", count, count)

    with atomic_path(path) as draft:
        _encode(draft, views())


def render_run(
    folder: Path,
    cameras: Path | None = None,
    out: Path | None = None,
    long_side: int = 0,
    flight: int = 0,
    time: float | None = None,
    restore: RestoreSettings | None = None,
    progress: Progress = silent,
    *,
    map_device: MapDevice = "auto",
) -> Path:
    """Images of a finished run's map from the cameras of a cameras.json, by default those of training; into `out`.

    `cameras` are in the axes of RUN/sfm, or the map's own, RUN/splat/cameras.json.

    Clear images look like the frames that `restore` made, by default the run's own settings. A dynamic map shows `time`
    (seconds of the clip), by default the cameras' own times, else when the frames of their names were taken. Raises
    InputError where the run has no map or no moment is known.
    """
    accepted("long_side", long_side, LongSideOrOwn)
    accepted("flight", flight, CountOrZero)
    accepted("time", time, ClipSecond | None)
    open_run(folder, "splat")
    restore = restore or from_yaml(folder / "settings.yaml").sfm.restore
    scene = load_map(folder / "splat" / "map.safetensors").to(devices.for_maps(map_device))
    frames = load_frames(folder / "prepare")
    rec = load_reconstruction(folder / "sfm", frames)
    refined = folder / "splat" / "cameras.json"
    own = refined if refined.is_file() else folder / "sfm" / "cameras.json"
    table = cameras_json.read_cameras(cameras or own)
    stations, out = cameras_of(table), out or folder / "renders" / "views"
    to_map = axes_of_map(rec, scene.poses)
    if to_map is not None and cameras is not None and cameras.resolve() != own.resolve():
        stations = replace(stations, cam2world=to_map.poses(stations.cam2world.double()))
    times = moments_of(scene, table, frames, time)
    style = display_style(scene, rec, restore)
    stems = view_stems(table.names)
    for i, name in enumerate(table.names):
        progress("rendering", i, len(table.names))
        camera = stations[i].pinhole(long_side)
        write_view(out, stems[name], scene.render(camera, times[i]), camera, style)
    progress("rendering", len(table.names), len(table.names))
    if flight:
        canvas = stations[0].pinhole(long_side)
        write_flythrough(out / "flythrough.mp4", scene, canvas, stations.cam2world, times, flight, style, progress)
    return out


def moments_of(scene: SplatMap, table: CameraTable, frames: Frames, time: float | None) -> Sequence[float]:
    """Times of the views, seconds of the clip: `time`, the camera's, or that of the frame of its name.

    Raises InputError where a dynamic map is to be shown at a moment that is not known.
    """
    if time is not None or not scene.primitives.dynamic:
        return [time or 0.0] * len(table.names)
    if table.times is not None:
        return table.times
    unknown = [name for name in table.names if name not in set(frames.names)]
    if unknown:
        start, end = scene.span
        raise InputError(
            f"{unknown[0]} is no frame of the dive, so it is not known when it would have been taken",
            cause="the map changes with time, and the cameras are not those of its frames",
            hint=f"--time SECONDS, {start:g} to {end:g}, or a time for every frame of the file",
        )
    return frames.times_of(table.names)


def _encode(path: Path, images: Iterable[UInt8[np.ndarray, "h w 3"]]) -> None:
    import av

    tick = Fraction(1, _RATE)
    # the header goes first, so that a browser shows the video before it has it all
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as file:
        stream = file.add_stream("libx264", rate=_RATE, options=_X264)
        stream.pix_fmt, stream.codec_context.time_base = "yuv420p", tick
        stream.codec_context.thread_count = 1  # x264 cuts frames by the number of threads: other cores, other bits
        for i, image in enumerate(images):
            height, width = (size // 2 * 2 for size in image.shape[:2])  # 4:2:0 halves both
            if i == 0:
                stream.height, stream.width = height, width
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]), "rgb24")
            frame.pts, frame.time_base = i, tick
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
