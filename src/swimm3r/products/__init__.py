"""Maps of a run from above: orthophotos with water and without, elevation, and what they rest on."""

from pathlib import Path
from typing import TYPE_CHECKING

from swimm3r.products.settings import ProductSettings
from swimm3r.progress import Progress

if TYPE_CHECKING:
    import swimm3r.products.record

__all__ = ["ProductSettings", "write_products"]


def write_products(
    run: str | Path,
    out: str | Path | None = None,
    settings: ProductSettings | None = None,
    progress: Progress | None = None,
) -> "swimm3r.products.record.ProductsRecord":
    """Write the map products of a finished run into `out`, by default RUN/products, and return their record.

    Raises InputError where the run has no depth maps, UsageError where the grid would be larger than any memory,
    DeviceError where a package of `swimm3r[geo]` is missing.
    """
    from swimm3r.products.write import write_products

    return write_products(Path(run), None if out is None else Path(out), settings or ProductSettings(), progress)
