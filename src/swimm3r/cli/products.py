"""`swimm3r products`: maps of a finished run."""

from typing import Annotated

from swimm3r.cli.terminal.console import drawn_progress
from swimm3r.cli.terminal.options import FLAT, OutOrDefault, Run
from swimm3r.products.settings import ProductSettings


def products(
    run: Run,
    /,
    out: OutOrDefault = None,
    settings: Annotated[ProductSettings, FLAT] = ProductSettings(),  # noqa: B008 - records are frozen
) -> None:
    """Make maps of a run from above: orthophotos with water and without, elevation, views and confidence of each cell.

    Args:
        run: Run folder with finished structure from motion.
        out: Folder for the products; RUN/products by default.
        settings: Cell size and extent of the work.
    """
    from swimm3r.products import write_products

    with drawn_progress() as progress:
        record = write_products(run, out, settings, progress)
    print(record)
    print(f"Products: {out or run / 'products'}")
