"""A map's views on disk: images of one camera, and a flight along the path of the dive.

NAME_rgb.png             with the water                NAME_clear.png            without it, white-balanced for display
NAME_backscatter.png     the light of the water alone  NAME_clear_physical.png   before the white balance, 16 bits
NAME_z_depth.png         depth in colors               NAME_z_depth.tif          z_depth, scene units, 32-bit floats
NAME_alpha.png           opacity, 16 bits                NAME_observed.png         white where a training frame saw it

Surfaces that no training frame saw are hatched in NAME_rgb.png, NAME_clear.png, NAME_z_depth.png and the flight: the
map guesses.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from swimm3r import devices
from swimm3r.cameras import Cameras, cameras_of, image_directions, ray_depth_from_z
from swimm3r.errors import InputError
from swimm3r.imaging.depth_colors import depth_image, depth_span
from swimm3r.io import cameras_json, images
from swimm3r.io.cameras_json import CameraTable
from swimm3r.io.depth import write_depth
from swimm3r.io.files.atomic import atomic_path
from swimm3r.io.view_names import view_stems
from swimm3r.medium import transmittances
from swimm3r.pipeline.camera_paths import CameraPath, Dive, camera_path, smooth_path, times_along
from swimm3r.pipeline.presets import from_yaml
from swimm3r.pipeline.view_settings import ViewSettings
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.medium.restore import keep_open_water
from swimm3r.sfm.medium.settings import RestoreSettings
from swimm3r.sfm.rectified.run import run_frames
from swimm3r.splat.map_file import load_map
from swimm3r.splat.projection.observed import COVERED
from swimm3r.splat.rendering import RenderOutput, SplatMap
from swimm3r.splat.settings import MapDevice
from swimm3r.splat.training_poses import axes_of_map

KINDS = ("rgb", "clear", "clear_physical", "backscatter", "z_depth")
"""The PNG files of one view, NAME_KIND.png."""
_HATCH = 16  # pixels between the lines over what no training frame saw
_RATE = 15  # images per second of the flight
_X264 = {"crf": "23", "preset": "medium", "x264-params": "mbtree=0"}
"""Options of the video encoder, which gives the same bits for the same images: the vector code of its macroblock tree
reads beyond its rows where half a width is no multiple of a vector, and what it finds there moves its decisions."""


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
    physical, and what scores are taken of. Pixels that primitives cover by less than half are open water, and
    from there on the surface counts 2 alpha - 1: faint primitives that draw the nuances of open water may be brighter
    than any surface, and would shine along silhouettes.
    """
    rays = image_directions(camera).nan_to_num(nan=0.0).to(out.z_depth)  # 0 of a fisheye's pixels without a ray
    ray_depth = ray_depth_from_z(out.z_depth, rays)
    T_D, _ = transmittances(ray_depth, out.medium)
    sea = ((1 - out.alpha) / (1 - COVERED)).clamp(max=1)
    return keep_open_water(out.clear * style.gains, T_D, out.rgb, sea, style.restore)


def physical_clear(out: RenderOutput, camera: Cameras, style: DisplayStyle) -> Float[Tensor, "h w 3"]:
    """The same before the white balance: colors that scores without a reference may be taken of."""
    return shown_clear(out, camera, replace(style, gains=torch.ones(3)))


def marked(image: Float[Tensor, "h w 3"], observed: Bool[Tensor, "h w"] | None) -> Float[Tensor, "h w 3"]:
    """An image for people whose unobserved parts are gray and hatched; as it is of maps that do not know them."""
    if observed is None:
        return image
    row, column = torch.meshgrid(*(torch.arange(side) for side in observed.shape), indexing="ij")
    hatch = torch.where((row + column) % _HATCH < _HATCH // 4, 0.35, 0.55)[..., None]
    return torch.where(observed[..., None], image, 0.3 * image.mean(-1, keepdim=True) + 0.7 * hatch)


def write_view(folder: Path, stem: str, out: RenderOutput, camera: Cameras, style: DisplayStyle) -> None:
    """The files of one view, as the head of this module lists them."""
    in_colors = torch.from_numpy(depth_image(out.z_depth.numpy(), *style.near_far) / np.float32(255))
    shown = {"rgb": out.rgb, "clear": shown_clear(out, camera, style), "z_depth": in_colors}
    shown = {kind: marked(image, out.observed) for kind, image in shown.items()}
    if out.backscatter is not None:
        shown["backscatter"] = out.backscatter
    for kind, image in shown.items():
        images.write_rgb(folder / f"{stem}_{kind}.png", image.numpy())
    images.write_rgb_16(folder / f"{stem}_clear_physical.png", physical_clear(out, camera, style).numpy())
    write_depth(folder / f"{stem}_z_depth.tif", out.z_depth.numpy())
    if out.observed is not None:
        images.write_levels(folder / f"{stem}_observed.png", out.observed.numpy().astype(np.uint16) * 65535)
    images.write_levels(folder / f"{stem}_alpha.png", (out.alpha.numpy().clip(0, 1) * 65535 + 0.5).astype(np.uint16))


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
    """An H.264 video of `count` views along the cameras' smoothed path: with the water, and beside it without.

    `times` are the cameras' own, seconds of the clip; the flight takes as many of its own on the way.
    """
    write_video(path, scene, canvas, smooth_path(cam2world, count), times_along(times, count), style, progress)


def write_video(
    path: Path,
    scene: SplatMap,
    canvas: Cameras,
    cam2world: Float[Tensor, "f 4 4"],
    times: Sequence[float],
    style: DisplayStyle,
    progress: Progress = silent,
) -> None:
    """An H.264 video of one camera at these poses and times: with the water, and beside it without."""

    def views() -> Iterable[UInt8[np.ndarray, "h w 3"]]:
        for i, pose in enumerate(cam2world):
            progress("filming the flight", i, len(times))
            camera = replace(canvas, cam2world=pose[None])
            out = scene.render(camera, times[i], backscatter=False)
            both = torch.cat([marked(image, out.observed) for image in (out.rgb, shown_clear(out, camera, style))], 1)
            yield (both.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        progress("filming the flight", len(times), len(times))

    with atomic_path(path) as draft:
        _encode(draft, views())


def render_run(
    folder: Path,
    settings: ViewSettings | None = None,
    out: Path | None = None,
    restore: RestoreSettings | None = None,
    progress: Progress = silent,
    *,
    map_device: MapDevice = "auto",
) -> Path:
    """Images of a finished run's map, or a video, along a path of cameras (`camera_paths`); into `out`.

    Clear images look like the frames that `restore` made, by default the run's own settings. A dynamic map shows the
    settings' time (seconds of the clip), by default the cameras' own times, else when the frames of their names were
    taken. Views through a fisheye are of the same fisheye, those through other lenses without their distortion. The
    cameras of the images are written beside them, in the axes of RUN/sfm. Raises InputError where the run has no map
    or no moment is known.
    """
    settings = settings or ViewSettings()
    open_run(folder, "splat")
    restore = restore or from_yaml(folder / "settings.yaml").sfm.restore
    scene = load_map(folder / "splat" / "map.safetensors").to(devices.for_maps(map_device))
    frames = run_frames(folder)
    rec = load_reconstruction(folder / "sfm", frames)
    dive, out = _dive(folder, scene, rec, frames), out or folder / "renders" / "views"
    path = camera_path(dive, settings)
    times, drawn = moments_of(scene, path, frames, settings.time), path.cameras.drawn(settings.long_side)
    style = display_style(scene, rec, restore)
    _write_cameras(out / "rendered_cameras.json", replace(path, cameras=drawn), times, dive, rec)
    stems = view_stems(path.names)
    if settings.video != "only":
        for i, name in enumerate(path.names):
            progress("rendering", i, len(path.names))
            camera = drawn[i]
            write_view(out, stems[name], scene.render(camera, times[i]), camera, style)
        progress("rendering", len(path.names), len(path.names))
    if settings.video != "no":
        write_video(out / "flythrough.mp4", scene, drawn[0], drawn.cam2world, times, style, progress)
    return out


def _dive(folder: Path, scene: SplatMap, rec: Reconstruction, frames: Frames) -> Dive:
    refined = folder / "splat" / "cameras.json"
    own = refined if refined.is_file() else folder / "sfm" / "cameras.json"
    table, to_map = cameras_json.read_cameras(own), axes_of_map(rec, scene.poses)
    ground = rec.points.xyz if to_map is None else to_map.points(rec.points.xyz.double())
    return Dive(CameraPath(table.names, cameras_of(table), table.times), frames, ground, scene.span, own, to_map)


def _write_cameras(path: Path, shown: CameraPath, times: Sequence[float], dive: Dive, rec: Reconstruction) -> None:
    """The cameras in the axes of RUN/sfm, from where `--path` reads them."""
    poses = shown.cameras.cam2world.double()
    poses = poses if dive.to_map is None else dive.to_map.inverse().poses(poses)
    units = "metres" if rec.metric else "scene units"
    replace(shown.cameras, cam2world=poses).save(path, shown.names, times, units)


def moments_of(scene: SplatMap, path: CameraPath | CameraTable, frames: Frames, time: float | None) -> Sequence[float]:
    """Times of the views, seconds of the clip: `time`, the camera's, or that of the frame of its name.

    Raises InputError where a dynamic map is to be shown at a moment that is not known.
    """
    if time is not None:
        return [time] * len(path.names)
    if path.times is not None:
        return path.times
    unknown = [name for name in path.names if name not in set(frames.names)]
    if not scene.dynamic:
        return [0.0] * len(path.names)
    if unknown:
        start, end = scene.span
        raise InputError(
            f"{unknown[0]} is no frame of the dive, so it is not known when it would have been taken",
            cause="the map changes with time, and the cameras are not those of its frames",
            hint=f"--time SECONDS, {start:g} to {end:g}, or a time for every frame of the file",
        )
    return frames.times_of(path.names)


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
