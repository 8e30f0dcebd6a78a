"""The maps of a run from above, as `swimm3r products` wrote them: small images and their figures."""

from pathlib import Path

from swimm3r.io import images
from swimm3r.products.preview import PREVIEWS
from swimm3r.products.record import FOLDER, read_record


def map_section(run: Path) -> dict[str, object] | None:
    """Images with captions, and lines of figures; None where no products were made. Raises InputError on damage."""
    folder = run / FOLDER
    record = read_record(folder)
    if record is None:
        return None
    shown = [
        (images.jpeg_uri(images.read_rgb(folder / name), 760, 88), caption)
        for name, caption in PREVIEWS.items()
        if (folder / name).is_file()
    ]
    return {"images": shown, "lines": str(record).splitlines()}
