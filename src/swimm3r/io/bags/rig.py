"""Poses of several cameras as their bag states them: in their camera_info, else in static transforms.

camera_info        P_k of a rectified pair has -f B_k in its last column (`io.calibration.rig`)
/tf_static         T_parent_child of every fixed part, so that T_a_b = T_root_a^-1 T_root_b of cameras a and b
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float

from swimm3r.geometry import invert_poses, pose_from, rotation_from_quaternion
from swimm3r.io.bags.bag import Bag, open_bag, unreadable
from swimm3r.io.bags.clip import BagClip
from swimm3r.io.bags.topics import STATIC
from swimm3r.io.calibration.documents import from_yaml
from swimm3r.io.calibration.rig import check_rig_poses, rectified_poses

Poses = Float[np.ndarray, "s 4 4"]


def stated_poses(clips: Sequence[BagClip]) -> tuple[Poses, str] | None:
    """camera_from_rig in metres, the first the identity, and the topics of the bag that state them; None without any.

    Cameras that topics put in one place have no stated poses there. Raises InputError where transforms are damaged.
    """
    texts = [clip.lens for clip in clips if clip.lens is not None]
    if len(texts) == len(clips) and (poses := _projected(texts)) is not None:
        return poses, "camera_info"
    with open_bag(clips[0].path) as bag:
        parents = _static_transforms(bag)
    roots, root_from = zip(*(_to_root(clip.frame_id.strip("/"), parents) for clip in clips), strict=True)
    if len(set(roots)) > 1:
        return None
    poses = invert_poses(torch.from_numpy(np.stack(root_from))).numpy() @ root_from[0]
    return (poses, STATIC) if np.linalg.norm(poses[1:, :3, 3], axis=1).all() else None


def _projected(texts: Sequence[str]) -> Poses | None:
    """The poses of a rectified pair; None of lenses that were calibrated one by one."""
    try:
        poses = rectified_poses([from_yaml(text) for text in texts])
        check_rig_poses(poses)
    except ValueError:
        return None
    return poses


def _static_transforms(bag: Bag) -> dict[str, tuple[str, Float[np.ndarray, "4 4"]]]:
    """Parent and T_parent_child of every fixed part, by its name; of one that is stated twice the last."""
    found = {}
    for message in bag.messages(STATIC):
        try:
            transforms = bag.content(message).transforms
        except ValueError as error:
            raise unreadable(bag.path, str(error)) from error
        for each in transforms:
            q, t = each.transform.rotation, each.transform.translation
            R = rotation_from_quaternion(torch.tensor([q.w, q.x, q.y, q.z], dtype=torch.float64))
            pose = pose_from(R, torch.tensor([t.x, t.y, t.z], dtype=torch.float64)).numpy()
            found[each.child_frame_id.strip("/")] = each.header.frame_id.strip("/"), pose
    return found


def _to_root(
    name: str, parents: Mapping[str, tuple[str, Float[np.ndarray, "4 4"]]]
) -> tuple[str, Float[np.ndarray, "4 4"]]:
    """The part that a part hangs on in the end, and T_root_part."""
    pose, passed = np.eye(4), {name}
    while name in parents:
        name, step = parents[name]
        pose = step @ pose
        if name in passed:  # a circle is no tree
            break
        passed.add(name)
    return name, pose
