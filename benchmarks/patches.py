"""The water by the size of the patches of surface that its attenuation is read from, beside the truth.

    python benchmarks/patches.py RUN[:TRUTH] ... --pixels 12 20 30 --share 0.6 --grids 4

RUN are run folders of synthetic dives with finished structure from motion (the demo's TRUTH is found). The water of
each is fitted again to patches of every size, under the light that it was made for, and compared on the test frames:

    patches    observations of patches
    T_D, B     mean absolute errors, by channel
    clear      PSNR of restored frames, dB
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace

from dive_runs import dive_run

from swimm3r.pipeline.finished_sfm import FinishedSfm
from swimm3r.pipeline.scores.truth import truth_section
from swimm3r.sfm.medium.dense_tracks import fuse_depth
from swimm3r.sfm.medium.samples import collect_samples
from swimm3r.sfm.medium.seathru import fit_medium
from swimm3r.sfm.medium.settings import SeathruSettings


def rows(sfm: FinishedSfm, sizes: list[float], like: SeathruSettings) -> Iterator[tuple[float, int, dict]]:
    """Size in pixels, number of observations, and errors of the water fitted to them."""
    rec, truth = sfm.rec, sfm.truth
    if truth is None or rec.medium is None:
        raise SystemExit("a dive without a known water tells nothing here")
    frames = rec.still(sfm.frames)
    tracks = fuse_depth(rec, frames, like.tracks)
    for size in sizes:
        of_size = replace(like, patch_pixels=size)
        samples = collect_samples(rec, frames, tracks, of_size)
        light = "sun" if rec.medium.lamp is None else "lamp"
        fit = fit_medium(samples, of_size, rec.medium.encoding, light)
        errors = truth_section(replace(rec, medium=fit), sfm.frames, truth)["sfm"]
        assert isinstance(errors, dict)
        yield size, int((samples.track >= 0).sum()), errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=dive_run, metavar="RUN[:TRUTH]")
    parser.add_argument("--pixels", nargs="+", type=float, default=[12.0, 20.0, 30.0])
    parser.add_argument("--share", type=float, default=SeathruSettings().patch_share, help="of a patch, to be shown")
    parser.add_argument("--grids", type=int, default=SeathruSettings().patch_grids, help="of patches")
    arguments = parser.parse_args()
    like = SeathruSettings(patch_share=arguments.share, patch_grids=arguments.grids)
    print("| run | pixels | patches | T_D | B | clear |")
    print("| --- | --- | --- | --- | --- | --- |")
    for sfm in arguments.runs:
        for size, count, errors in rows(sfm, arguments.pixels, like):
            T_D, B = (", ".join(f"{value:.3f}" for value in errors[key]) for key in ("T_D_abs", "B_abs"))
            print(f"| {sfm.folder.name} | {size:g} | {count} | {T_D} | {B} | {errors['clear_psnr']:.2f} |", flush=True)


if __name__ == "__main__":
    main()
