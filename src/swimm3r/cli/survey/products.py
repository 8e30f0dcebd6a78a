"""`swimm3r products`: maps, habitat figures, mesh and cloud of a finished run."""

from pathlib import Path
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
    """Make maps of a run from above, orthophotos with water and without and elevation; habitat figures, mesh and cloud.

    Args:
        run: Run folder with finished structure from motion.
        out: Folder for the products; RUN/products by default.
        settings: Cell size and extent of the work.
    """
    make_products(run, out, settings)


def make_products(run: Path, out: Path | None = None, settings: ProductSettings | None = None) -> None:
    """Write the products of a run and its report anew, and print their figures."""
    from swimm3r.products import write_products
    from swimm3r.report import write_report

    with drawn_progress() as progress:
        record = write_products(run, out, settings, progress)
    print(record)
    print(f"Products: {out or run / 'products'}")
    if out is None:
        write_report(run)
