"""Calibrated rigs: the same pair as Kalibr, OpenCV and ROS write it, and files that are none."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from swimm3r.errors import InputError
from swimm3r.io.calibration.rig import read_rig

BASELINE = 0.1
R = Rotation.from_rotvec([0.01, -0.03, 0.02]).as_matrix()  # from the left camera's axes to the right one's
T = -R @ [BASELINE, 0.002, -0.003]
POSE = np.vstack([np.column_stack([R, T]), [0, 0, 0, 1]])
SIDES = ("left", "right")


def write(path: Path, document: object) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(yaml.safe_dump(document))
    return path


def kalibr(folder: Path, **changes: object) -> Path:
    lens = {
        "camera_model": "pinhole",
        "distortion_model": "radtan",
        "intrinsics": [500.0, 501.0, 320.0, 240.0],
        "distortion_coeffs": [0.01, 0.0, 0.0, 0.0],
        "resolution": [640, 480],
    }
    return write(folder / "camchain.yaml", {"cam0": lens, "cam1": {**lens, "T_cn_cnm1": POSE.tolist(), **changes}})


def opencv(folder: Path) -> Path:
    K, zeros = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], [0.0] * 5
    document = {"image_size": [640, 480], "M1": K, "D1": zeros, "M2": K, "D2": zeros, "R": R.tolist()}
    return write(folder / "stereo.yaml", {**document, "T": [[value] for value in T.tolist()]})


def ros(folder: Path) -> Path:
    """Two camera_info files: rectified axes have x along the baseline, as stereo calibration makes them."""
    center = -R.T @ T
    x = center / np.linalg.norm(center)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    first = np.stack([x, y, np.cross(x, y)])
    for name, rectified, offset in (("left", first, 0.0), ("right", first @ R.T, np.linalg.norm(center))):
        P = [[450.0, 0, 320, -450.0 * offset], [0, 450.0, 240, 0], [0, 0, 1, 0]]
        document = {
            "image_width": 640,
            "image_height": 480,
            "camera_name": name,
            "distortion_model": "plumb_bob",
            "camera_matrix": {"rows": 3, "cols": 3, "data": [500.0, 0, 320, 0, 500.0, 240, 0, 0, 1]},
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
            "rectification_matrix": {"rows": 3, "cols": 3, "data": rectified.ravel().tolist()},
            "projection_matrix": {"rows": 3, "cols": 4, "data": [float(v) for v in np.ravel(P)]},
        }
        write(folder / "ros" / f"{name}.yaml", document)
    return folder / "ros"


def echoed(folder: Path) -> Path:
    """The same as messages of ROS 2, as ros2 topic echo prints them."""
    for path in ros(folder).iterdir():
        file = yaml.safe_load(path.read_text())
        names = {"k": "camera_matrix", "d": "distortion_coefficients", "r": "rectification_matrix"}
        message = {letter: file[name]["data"] for letter, name in {**names, "p": "projection_matrix"}.items()}
        size = {"width": file["image_width"], "height": file["image_height"]}
        write(path, {"header": {"frame_id": "camera"}, **size, "distortion_model": "plumb_bob", **message})
    return folder / "ros"


@pytest.mark.parametrize("make", [kalibr, opencv, ros, echoed])
def test_every_program_states_the_same_pose(make, tmp_path):
    found = read_rig(make(tmp_path), SIDES)
    np.testing.assert_allclose(found.camera_from_rig[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(found.camera_from_rig[1], POSE, atol=1e-9)
    assert len(found.lenses) == 2
    assert found.lenses[0].K[0, 2] == 320.5  # the center of the first pixel is (0.5, 0.5)


def test_lenses_belong_to_their_cameras_whatever_the_order_of_a_file(tmp_path):
    document = yaml.safe_load(opencv(tmp_path).read_text())
    document["M1"] = [[510.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]]
    second_first = {name: document[name] for name in sorted(document, reverse=True)}
    path = tmp_path / "second_first.yaml"
    path.write_text(yaml.safe_dump(second_first, sort_keys=False))
    assert [lens.K[0, 0] for lens in read_rig(path, SIDES).lenses] == [510.0, 500.0]


def test_three_cameras_of_a_chain_are_poses_from_the_first(tmp_path):
    document = yaml.safe_load(kalibr(tmp_path).read_text())
    path = write(tmp_path / "three.yaml", {**document, "cam2": document["cam1"]})
    found = read_rig(path, ("a", "b", "c"))
    np.testing.assert_allclose(found.camera_from_rig[2], POSE @ POSE, atol=1e-12)


def test_another_number_of_cameras_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"it has 2 cameras, and the rig 3 \(a, b, c\)"):
        read_rig(kalibr(tmp_path), ("a", "b", "c"))


def test_a_mirrored_pose_is_refused(tmp_path):
    with pytest.raises(InputError, match="no rotation"):
        read_rig(kalibr(tmp_path, T_cn_cnm1=np.diag([1.0, 1, -1, 1]).tolist()), SIDES)


def test_cameras_in_one_place_are_refused(tmp_path):
    with pytest.raises(InputError, match="in one place"):
        read_rig(kalibr(tmp_path, T_cn_cnm1=np.eye(4).tolist()), SIDES)


def test_a_lens_without_a_pose_is_no_rig(tmp_path):
    document = yaml.safe_load(kalibr(tmp_path).read_text())
    del document["cam1"]["T_cn_cnm1"]
    with pytest.raises(InputError, match="T_cn_cnm1"):
        read_rig(write(tmp_path / "one.yaml", document), SIDES)


def test_a_folder_lacks_a_camera(tmp_path):
    with pytest.raises(InputError, match=r"it has no top\.yaml"):
        read_rig(ros(tmp_path), ("left", "top"))
