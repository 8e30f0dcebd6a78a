"""The cloud and the mesh of a run, written beside its maps."""

from pathlib import Path

from swimm3r.errors import InputError
from swimm3r.products.settings import ProductSettings
from swimm3r.products.solids import cloud as clouds
from swimm3r.products.solids import mesh_files
from swimm3r.products.solids.mesh import poisson_mesh
from swimm3r.products.solids.texture import colored, textured
from swimm3r.products.survey import Colors, Survey
from swimm3r.progress import Progress

_SPACING = 4  # cells of the map along a triangle's side: about the width of the windows that depth is matched by
_NO_CLOUD = "no cloud and no mesh: the run has no dense cloud"


def write_solids(
    survey: Survey, gsd: float, folder: Path, settings: ProductSettings, files: list[str], progress: Progress
) -> list[str]:
    """Write what the settings ask for; notes about what could not be made."""
    if not (settings.cloud or settings.mesh):
        return []
    progress("orienting the cloud", 0, 1)
    cloud = clouds.oriented_cloud(survey)
    progress("orienting the cloud", 1, 1)
    if cloud is None:
        return [_NO_CLOUD]
    if settings.cloud:
        clouds.write_ply(folder / "cloud.ply", cloud, survey.place)
        clouds.write_laz(folder / "cloud.laz", cloud, survey.place)
        files += ["cloud.ply", "cloud.laz"]
    if not settings.mesh:
        return []
    try:
        progress("making the mesh", 0, 1)
        mesh = poisson_mesh(cloud, settings.mesh_spacing or _SPACING * gsd, survey.place)
        progress("making the mesh", 1, 1)
    except InputError as error:
        if settings.mesh_spacing is not None:  # the spacing was asked for
            raise
        return [f"no mesh: {error.what}"]
    kind: Colors = "restored" if survey.has("restored") else "filmed"
    texture = textured(survey, mesh, cloud, gsd, kind, progress)
    mesh_files.write_glb(folder / "mesh.glb", mesh, texture)
    mesh_files.write_obj(folder / "mesh.obj", mesh, texture, survey.place)
    rgb = colored(survey, mesh.vertices, mesh.normals, cloud, gsd, kind)
    mesh_files.write_ply(folder / "mesh.ply", mesh, rgb, survey.place)
    files += ["mesh.glb", "mesh.obj", "mesh.mtl", "mesh.png", "mesh.ply"]
    return []
