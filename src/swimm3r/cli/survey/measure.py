"""`swimm3r measure`: distances, areas and volumes in a finished run."""

from typing import Annotated

from tyro.conf import arg

from swimm3r.cli.terminal.options import Run

Points = Annotated[tuple[str, ...], arg(metavar="POINT [POINT ...]")]


def measure(run: Run, /, distance: Points = (), area: Points = (), volume: Points = ()) -> None:
    """Measure between points, with the standard deviation of each figure.

    A point is FRAME:x,y, a pixel of a frame of RUN/prepare (the middle of the first one is 0.5,0.5), or @x,y or
    @x,y,z in the coordinates of the maps that swimm3r products makes.

    Args:
        run: Run folder with finished structure from motion.
        distance: Points along a line: length of every segment and of the whole.
        area: Outline of an area: in its own plane, from above, and of the surface where there is an elevation map.
        volume: Outline of a volume, between the plane through its points and the elevation map.
    """
    from swimm3r.products.measure import measure_run

    for line in measure_run(run, distance, area, volume):
        print(line)
