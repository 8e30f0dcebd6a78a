"""Other programs' files, made here from one known scene by their own conventions, and read back."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras, cameras_of, project
from swimm3r.errors import InputError
from swimm3r.io import images, ply
from swimm3r.io.cameras_json import CameraTable
from swimm3r.io.colmap import model as colmap
from swimm3r.io.colmap.model import ColmapModel
from swimm3r.io.imports.nerfstudio import images_folder
from swimm3r.io.imports.read import read_foreign
from swimm3r.io.imports.record import ForeignModel

WIDTH, HEIGHT, N = 400, 300, 4
K = np.array([[310.0, 0, 203], [0, 308.0, 148], [0, 0, 1]])
OPENCV = np.array([-0.08, 0.012, 0.001, -0.002])  # k1, k2, p1, p2
NAMES = tuple(f"dive_{i:02d}.jpg" for i in range(N))


@dataclass(frozen=True)
class Scene:
    cam2world: np.ndarray
    xyz: np.ndarray

    def observations(self, lens: str = "OPENCV", distortion: np.ndarray = OPENCV, k: np.ndarray = K) -> np.ndarray:
        """Pixels [c, p, 2] of the points by our own camera model."""
        cameras = Cameras(
            torch.from_numpy(k).repeat(N, 1, 1), torch.from_numpy(distortion).repeat(N, 1),
            torch.from_numpy(self.cam2world), WIDTH, HEIGHT, lens,
        )  # fmt: skip
        return project(cameras, torch.from_numpy(self.xyz).expand(N, -1, -1))[0].numpy()


@pytest.fixture
def scene() -> Scene:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (N, 1, 1))
    for i, pose in enumerate(poses):
        angle = 0.1 * i
        pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        pose[:3, 3] = [0.3 * i, 0.05 * i * i, -0.1 * i]
    return Scene(poses, rng.uniform([-1, -1, 3], [1.5, 1, 5], (20, 3)))


def same_cameras(found: ForeignModel, scene: Scene, scale: float = 1.0) -> None:
    """Names, poses, and where our camera model puts the scene's points, are those of the scene."""
    model = found.model
    assert model.names == NAMES
    assert (model.width, model.height) == (WIDTH, HEIGHT)
    expected = scene.cam2world.copy()
    expected[:, :3, 3] *= scale
    np.testing.assert_allclose(model.cam2world, expected, atol=1e-9)


def same_pixels(found: ForeignModel, scene: Scene, pixels: np.ndarray, scale: float = 1.0) -> None:
    model = found.model
    K, distortion, cam2world = (torch.from_numpy(a) for a in (model.K, model.distortion, model.cam2world))
    cameras = Cameras(K, distortion, cam2world, model.width, model.height, model.model)
    uv = project(cameras, torch.from_numpy(scene.xyz * scale).expand(N, -1, -1))[0].numpy()
    np.testing.assert_allclose(uv, pixels, atol=1e-6)


def write_colmap(folder: Path, scene: Scene) -> None:
    pixels = scene.observations()
    points, frames = np.repeat(np.arange(20), N), np.tile(np.arange(N), 20)
    colmap.write_model(
        folder,
        ColmapModel(
            names=NAMES,
            model="OPENCV",
            width=WIDTH,
            height=HEIGHT,
            K=np.tile(K, (N, 1, 1)),
            distortion=np.tile(OPENCV, (N, 1)),
            cam2world=scene.cam2world,
            xyz=scene.xyz,
            rgb=np.full((20, 3), 90, np.uint8),
            error=np.zeros(20),
            track_point=points,
            track_frame=frames,
            track_xy=pixels[frames, points],
        ),
    )


def test_a_colmap_model(scene: Scene, tmp_path: Path):
    write_colmap(tmp_path / "sparse" / "0", scene)  # GLOMAP and GLUEMAP write the same
    found = read_foreign(tmp_path)
    assert found.program == "COLMAP model"
    same_cameras(found, scene)
    same_pixels(found, scene, scene.observations())
    np.testing.assert_allclose(found.model.xyz, scene.xyz)


def test_our_own_cameras_json_is_read_by_name_and_never_hides_the_model_beside_it(scene: Scene, tmp_path: Path):
    write_colmap(tmp_path / "sparse", scene)
    table = CameraTable(
        NAMES, WIDTH, HEIGHT, "OPENCV", np.tile(K, (N, 1, 1)), np.tile(OPENCV, (N, 1)), scene.cam2world, "metres"
    )
    cameras_of(table).save(tmp_path / "cameras.json", table.names, table.times, table.units)
    found = read_foreign(tmp_path / "cameras.json")
    assert found.metric
    assert len(found.model.xyz) == 0
    same_cameras(found, scene)
    same_pixels(found, scene, scene.observations())
    assert len(read_foreign(tmp_path).model.xyz) == 20  # a run's folder holds both


def transforms(scene: Scene, **changes: object) -> dict:
    """As ns-process-data writes it: the world turned and scaled, OpenGL cameras."""
    turn = np.array([[1.0, 0, 0, 0.5], [0, 0, 1, 0], [0, -1, 0, 2], [0, 0, 0, 1]])
    poses = scene.cam2world.copy()
    poses[:, :3, 3] *= 2.0
    poses = turn @ poses @ np.diag([1.0, -1, -1, 1])
    k1, k2, p1, p2 = OPENCV.tolist()
    return {
        "camera_model": "OPENCV", "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2],
        "w": WIDTH, "h": HEIGHT, "k1": k1, "k2": k2, "p1": p1, "p2": p2,
        "applied_transform": turn[:3].tolist(), "applied_scale": 2.0,
        "frames": [{"file_path": f"images/{name}", "transform_matrix": pose.tolist()}
                   for name, pose in zip(NAMES, poses, strict=True)],
        **changes,
    }  # fmt: skip


def write_json(path: Path, document: dict) -> Path:
    path.write_text(json.dumps(document))
    return path


def test_nerfstudio_transforms_come_back_in_the_original_world(scene: Scene, tmp_path: Path):
    document = transforms(scene, ply_file_path="sparse_pc.ply")
    turn = np.array(document["applied_transform"])
    ply.write_points(tmp_path / "sparse_pc.ply", 2 * scene.xyz @ turn[:, :3].T + turn[:, 3], np.full((20, 3), 0.4))
    write_json(tmp_path / "transforms.json", document)
    found = read_foreign(tmp_path)
    same_cameras(found, scene)
    same_pixels(found, scene, scene.observations())
    np.testing.assert_allclose(found.model.xyz, scene.xyz, atol=1e-5)
    assert (found.model.rgb == 102).all()
    assert not found.metric


def test_nerfstudio_frames_may_bring_their_own_intrinsics(scene: Scene, tmp_path: Path):
    document = transforms(scene)
    for name in ("camera_model", "fl_x", "fl_y", "k1", "k2", "p1", "p2"):
        del document[name]
    for i, frame in enumerate(document["frames"]):
        frame["fl_x"] = 300.0 + i
    document["frames"][0] |= {"fl_y": 290.0, "cx": 10.0}
    found = read_foreign(write_json(tmp_path / "t.json", document)).model
    assert found.model == "PINHOLE"
    np.testing.assert_allclose(found.K[:, 0, 0], [300, 301, 302, 303])
    np.testing.assert_allclose(found.K[:, 1, 1], [290, 301, 302, 303])
    np.testing.assert_allclose(found.K[:, 0, 2], [10, 203, 203, 203])


def test_instant_ngp_says_its_focal_length_as_an_angle(scene: Scene, tmp_path: Path):
    document = transforms(scene, camera_angle_x=float(2 * np.arctan(WIDTH / 2 / 310)))
    del document["fl_x"], document["fl_y"]
    found = read_foreign(write_json(tmp_path / "transforms.json", document)).model
    np.testing.assert_allclose(found.K[:, [0, 1], [0, 1]], 310)


def metashape(scene: Scene, calibration: str, kind: str = "frame", extra: str = "") -> str:
    cameras = "".join(
        f'<camera id="{i}" sensor_id="0" component_id="0" label="{Path(name).stem}">'
        f"<transform>{' '.join(map(repr, pose.ravel().tolist()))}</transform></camera>"
        for i, (name, pose) in enumerate(zip(NAMES, scene.cam2world, strict=True))
    )
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="1"><sensor id="0" label="GoPro" type="{kind}"><resolution width="{WIDTH}" height="{HEIGHT}"/>
<calibration type="{kind}" class="initial"><resolution width="{WIDTH}" height="{HEIGHT}"/><f>1</f></calibration>
<calibration type="{kind}" class="adjusted"><resolution width="{WIDTH}" height="{HEIGHT}"/>{calibration}</calibration>
</sensor></sensors>
<components next_id="1" active_id="0"><component id="0" label="Component 1">{extra}</component></components>
<cameras next_id="5"><group id="0">{cameras}</group><camera id="9" sensor_id="0" label="lost"/></cameras>
</chunk></document>"""


ROTATED = (
    "<transform><rotation>0 1 0 -1 0 0 0 0 1</rotation><translation>4e6 1e6 5e6</translation>"
    "<scale>2.5</scale></transform>"
)


def test_metashape_cameras_keep_their_scale(scene: Scene, tmp_path: Path):
    k1, k2, p1, p2 = OPENCV
    f, b1 = K[1, 1], K[0, 0] - K[1, 1]
    lens = f"<f>{f}</f><cx>{K[0, 2] - WIDTH / 2}</cx><cy>{K[1, 2] - HEIGHT / 2}</cy><b1>{b1}</b1>"
    lens += f"<k1>{k1}</k1><k2>{k2}</k2><p1>{p2}</p1><p2>{p1}</p2>"  # Metashape counts the other way round
    (tmp_path / "cameras.xml").write_text(metashape(scene, lens, extra=ROTATED))
    found = read_foreign(tmp_path)
    assert found.metric
    assert found.model.names == tuple(Path(name).stem for name in NAMES)
    expected = scene.cam2world.copy()
    expected[:, :3, 3] *= 2.5
    np.testing.assert_allclose(found.model.cam2world, expected, atol=1e-9)
    np.testing.assert_allclose(found.model.distortion, np.tile(OPENCV, (N, 1)), atol=1e-9)
    same_pixels(found, scene, scene.observations(), scale=2.5)


def test_metashape_higher_terms_are_fitted_or_refused(scene: Scene, tmp_path: Path):
    base = f"<f>{K[1, 1]}</f><cx>3</cx><cy>-2</cy><k1>-0.08</k1><k2>0.012</k2>"
    path = tmp_path / "cameras.xml"
    path.write_text(metashape(scene, base + "<k3>0.002</k3>"))
    found = read_foreign(path)
    assert not found.metric
    r = np.linspace(0, 0.7, 30)
    ours = 1 + found.model.distortion[0, 0] * r**2 + found.model.distortion[0, 1] * r**4
    assert (np.abs(ours - (1 - 0.08 * r**2 + 0.012 * r**4 + 0.002 * r**6)) * r * 308).max() < 0.5
    path.write_text(metashape(scene, base + "<k3>2.0</k3>"))
    with pytest.raises(InputError, match="pixels away from any that is supported"):
        read_foreign(path)


def test_metashape_fisheye(scene: Scene, tmp_path: Path):
    k = np.array([0.02, -0.01, 0.003, 0.0])
    lens = f"<f>{K[1, 1]}</f><b1>2.0</b1><cx>3</cx><cy>-2</cy><k1>0.02</k1><k2>-0.01</k2><k3>0.003</k3>"
    (tmp_path / "c.xml").write_text(metashape(scene, lens, kind="fisheye"))
    found = read_foreign(tmp_path / "c.xml")
    assert found.model.model == "OPENCV_FISHEYE"
    same_pixels(found, scene, scene.observations("OPENCV_FISHEYE", k))


def openmvg(scene: Scene, lens: dict) -> dict:
    pixels = scene.observations("OPENCV", OPENCV, np.array([[310.0, 0, 203], [0, 310, 148], [0, 0, 1]]))
    first = {"polymorphic_id": 2147483649, "polymorphic_name": "pinhole_brown_t2"}
    entries = [
        {"key": i, "value": {**(first if i == 0 else {"polymorphic_id": 1}), "ptr_wrapper": {"id": i, "data": lens}}}
        for i in range(2)
    ]
    return {
        "sfm_data_version": "0.3", "root_path": "/data/images", "intrinsics": entries, "control_points": [],
        "views": [
            {"key": i, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"id": i, "data": {
                "local_path": "/", "filename": name, "width": WIDTH, "height": HEIGHT,
                "id_view": i, "id_intrinsic": i % 2, "id_pose": 10 + i}}}}
            for i, name in enumerate((*NAMES, "lost.jpg"))
        ],
        "extrinsics": [{"key": 10 + i, "value": {"rotation": pose[:3, :3].T.tolist(), "center": pose[:3, 3].tolist()}}
                       for i, pose in enumerate(scene.cam2world)],
        "structure": [
            {"key": 7 * p, "value": {"X": xyz.tolist(), "observations": [
                {"key": i, "value": {"id_feat": p, "x": pixels[i, p].tolist()}} for i in range(N)]}}
            for p, xyz in enumerate(scene.xyz)
        ],
    }  # fmt: skip


def test_openmvg_keeps_points_and_observations(scene: Scene, tmp_path: Path):
    k1, k2, p1, p2 = OPENCV.tolist()
    lens = {"width": WIDTH, "height": HEIGHT, "focal_length": 310.0, "principal_point": [203.0, 148.0]}
    document = openmvg(scene, {"value0": lens, "disto_t2": [k1, k2, 0.0, p1, p2]})
    write_json(tmp_path / "sfm_data.json", document)
    found = read_foreign(tmp_path)
    same_cameras(found, scene)
    assert not found.colored
    np.testing.assert_allclose(found.model.xyz, scene.xyz)
    assert len(found.model.track_point) == 20 * N
    m = found.model
    K, distortion, cam2world = (torch.from_numpy(a) for a in (m.K, m.distortion, m.cam2world))
    cameras = Cameras(K, distortion, cam2world, WIDTH, HEIGHT, m.model)
    uv = project(cameras, torch.from_numpy(scene.xyz).expand(N, -1, -1))[0].numpy()
    seen = uv[found.model.track_frame, found.model.track_point]
    np.testing.assert_allclose(seen, found.model.track_xy, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "data", "model", "distortion"),
    [
        ("pinhole", {}, "PINHOLE", []),
        ("pinhole_radial_k1", {"disto_k1": [-0.05]}, "OPENCV", [-0.05, 0, 0, 0]),
        ("pinhole_radial_k3", {"disto_k3": [-0.05, 0.01, 0.0]}, "OPENCV", [-0.05, 0.01, 0, 0]),
        ("fisheye", {"fisheye": [0.1, 0.2, 0.3, 0.4]}, "OPENCV_FISHEYE", [0.1, 0.2, 0.3, 0.4]),
    ],
)
def test_openmvg_lenses(name: str, data: dict, model: str, distortion: list[float], scene: Scene, tmp_path: Path):
    lens = {"width": WIDTH, "height": HEIGHT, "focal_length": 310.0, "principal_point": [203.0, 148.0], **data}
    document = openmvg(scene, lens)
    document["intrinsics"][0]["value"]["polymorphic_name"] = name
    found = read_foreign(write_json(tmp_path / "sfm_data.json", document)).model
    assert found.model == model
    np.testing.assert_allclose(found.distortion, np.tile(distortion, (N, 1)).reshape(N, -1), atol=1e-9)


@pytest.mark.parametrize(("width", "height"), [(400, 300), (300, 400)])
def test_vggt_predictions_go_back_to_the_images_pixels(width: int, height: int, scene: Scene, tmp_path: Path):
    for name in NAMES:
        images.write_rgb(
            tmp_path / "images" / Path(name).with_suffix(".png").name, np.zeros((height, width, 3), np.float32)
        )
    resized = round(height * 518 / width / 14) * 14
    rows = min(resized, 518)
    top = (resized - rows) // 2
    into = np.array([[518 / width, 0, 0], [0, resized / height, -top], [0, 0, 1]])
    np.savez(
        tmp_path / "predictions.npz",
        extrinsic=np.linalg.inv(scene.cam2world)[:, :3].astype(np.float32),
        intrinsic=np.tile(into @ K, (N, 1, 1)).astype(np.float32),
        depth=np.full((N, rows, 518, 1), 3.0, np.float32),
        depth_conf=np.full((N, rows, 518), 5.0, np.float32),
        images=np.full((N, 3, rows, 518), 0.5, np.float32),
    )
    found = read_foreign(tmp_path)
    assert found.model.names == tuple(str(Path(name).with_suffix(".png")) for name in NAMES)
    np.testing.assert_allclose(found.model.K, np.tile(K, (N, 1, 1)), atol=1e-4)
    np.testing.assert_allclose(found.model.cam2world, scene.cam2world, atol=1e-5)
    assert found.depth is not None
    assert found.depth.z_depth.shape == (N, rows, 518)
    np.testing.assert_allclose(found.depth.confidence, 0.8)


def test_vggt_without_its_images_is_refused(scene: Scene, tmp_path: Path):
    np.savez(tmp_path / "predictions.npz", extrinsic=np.zeros((N, 3, 4)), intrinsic=np.zeros((N, 3, 3)),
             depth=np.zeros((N, 2, 2, 1)), depth_conf=np.zeros((N, 2, 2)), images=np.zeros((N, 3, 2, 2)))  # fmt: skip
    with pytest.raises(InputError, match="speaks of 4 images"):
        read_foreign(tmp_path)


def test_pickles_in_an_npz_are_not_opened(tmp_path: Path):
    np.savez(tmp_path / "predictions.npz", extrinsic=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError, match="cannot be read as a reconstruction"):
        read_foreign(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("transforms.json", "{", "cannot be read as a reconstruction"),
        ("transforms.json", "[1]", "a JSON object is expected"),
        ("transforms.json", '{"frames": []}', "names no frames"),
        ("transforms.json", '{"w": 4}', "there is no frames"),
        ("sfm_data.json", '{"sfm_data_version": "0.3"}', "there is no views"),
        ("cameras.xml", "<document>", "cannot be read as a reconstruction"),
        ("cameras.xml", "<document/>", "no Metashape chunk"),
        ("predictions.npz", "PK\x03\x04half", "cannot be read as a reconstruction"),
    ],
)
def test_damaged_files_are_input_errors(name: str, text: str, message: str, tmp_path: Path):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_foreign(tmp_path)
    assert caught.value.exit_code == 3


def test_names_that_lead_out_of_their_folder_are_refused(scene: Scene, tmp_path: Path):
    lens = {"width": WIDTH, "height": HEIGHT, "focal_length": 310.0, "principal_point": [203.0, 148.0]}
    document = openmvg(scene, lens)
    document["intrinsics"][0]["value"]["polymorphic_name"] = "pinhole"
    document["views"][0]["value"]["ptr_wrapper"]["data"]["filename"] = "../../etc/passwd"
    with pytest.raises(InputError, match="names a file outside its folder"):
        read_foreign(write_json(tmp_path / "sfm_data.json", document))
    with pytest.raises(InputError, match="names a file outside its folder"):
        read_foreign(write_json(tmp_path / "transforms.json", transforms(scene, ply_file_path="../../secret.ply")))


def test_images_that_are_not_there_are_refused_before_any_search(scene: Scene, tmp_path: Path):
    (tmp_path / "images").mkdir()
    path = write_json(tmp_path / "transforms.json", transforms(scene))
    first = json.loads(path.read_text())["frames"][0]["file_path"]
    with pytest.raises(InputError, match="which is not there"):
        images_folder(path)
    (tmp_path / first).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / first).touch()
    assert images_folder(path) == (tmp_path / first).parent
