"""Mesh files: GLB (textured, y up, as glTF has it), OBJ with its material and texture, PLY with a color per vertex."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from swimm3r.io import images
from swimm3r.io.files.atomic import atomic_path, write_text
from swimm3r.products.packages import geo_package
from swimm3r.products.solids.cloud import origin_comments
from swimm3r.products.solids.mesh import Mesh
from swimm3r.products.solids.texture import Texture
from swimm3r.scene.georeference import Georeference

_TO_GLTF = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up to y up


def write_glb(path: Path, mesh: Mesh, texture: Texture) -> None:
    """Write a GLB file, whole or not at all.

    Triangles share no vertices there, as each has a place of its own in the texture.
    """
    trimesh: Any = geo_package("trimesh")
    from PIL import Image

    corners = mesh.triangles.ravel()
    uv = texture.uv.reshape(-1, 2) * [1, -1] + [0, 1]  # trimesh counts from the lower left, and glTF from the upper
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(texture.image), metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
    )
    model = trimesh.Trimesh(
        vertices=mesh.vertices[corners] @ _TO_GLTF.T,
        faces=np.arange(len(corners)).reshape(-1, 3),
        vertex_normals=mesh.normals[corners] @ _TO_GLTF.T,
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )
    with atomic_path(path) as draft:
        draft.write_bytes(model.export(file_type="glb", include_normals=True))


def write_obj(path: Path, mesh: Mesh, texture: Texture, place: Georeference) -> None:
    """Write an OBJ file with NAME.mtl and NAME.png beside it, in local coordinates."""
    images.write_rgb(path.with_suffix(".png"), texture.image)
    material = f"newmtl surface\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {path.stem}.png\n"
    write_text(path.with_suffix(".mtl"), material)
    uv = texture.uv.reshape(-1, 2) * [1, -1] + [0, 1]  # from the lower left
    corner = np.arange(1, 1 + 3 * len(mesh.triangles)).reshape(-1, 3)
    vertex = mesh.triangles + 1
    with atomic_path(path) as draft, draft.open("w", encoding="ascii") as file:
        file.writelines(f"# {line}\n" for line in origin_comments(place))
        file.write(f"mtllib {path.stem}.mtl\nusemtl surface\n")
        file.writelines(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in mesh.vertices.tolist())
        file.writelines(f"vn {x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in mesh.normals.tolist())
        file.writelines(f"vt {u:.6f} {v:.6f}\n" for u, v in uv.tolist())
        for (a, b, c), (s, t, u) in zip(vertex.tolist(), corner.tolist(), strict=True):
            file.write(f"f {a}/{s}/{a} {b}/{t}/{b} {c}/{u}/{c}\n")


def write_ply(path: Path, mesh: Mesh, rgb: Float[np.ndarray, "v 3"], place: Georeference) -> None:
    """Write a binary PLY file with a color per vertex, in local coordinates, whole or not at all."""
    names = ("x", "y", "z", "nx", "ny", "nz")
    vertices = np.empty(
        len(mesh.vertices), [(name, "<f4") for name in names] + [(name, "u1") for name in ("red", "green", "blue")]
    )
    for k, name in enumerate(names):
        vertices[name] = np.concatenate([mesh.vertices, mesh.normals], 1)[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        vertices[name] = np.clip(rgb[:, k], 0, 1) * 255 + 0.5
    faces = np.empty(len(mesh.triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.triangles
    header = [
        "ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in origin_comments(place)),
        f"element vertex {len(vertices)}", *(f"property float {name}" for name in names),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    with atomic_path(path) as draft, draft.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())
