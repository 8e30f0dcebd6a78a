"""The packages of the extra `geo`, which map products are written with."""

from importlib import import_module
from types import ModuleType

from swimm3r.errors import DeviceError

PACKAGES = ("rasterio", "pyproj", "laspy", "trimesh")


def require_packages() -> None:
    """Raise DeviceError where one of them is missing: before the work, not after it."""
    for name in PACKAGES:
        geo_package(name)


def geo_package(name: str) -> ModuleType:
    """A package of the extra `geo`. Raises DeviceError that says what to install."""
    try:
        return import_module(name)
    except ImportError as error:
        raise DeviceError(
            f"map products need {name}, which is not installed",
            cause="the packages that write maps come with the extra geo",
            hint="pip install 'swimm3r[geo]'",
        ) from error
