"""A scene of a BOP data set as an observation over a table, and the annotated poses beside it.

BOP's world can be any frame: it counts as the table's (z up, table at z = 0) only if cameras are above it and objects
near it, and else can be replaced by the table that the objects tell.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation
from osfcore.photo.other_programs.bop_images import SCENE_CAMERA, BopChoice, BopImage, read_images
from osfcore.photo.poses.table_from_objects import table_from_objects
from osfcore.photo.poses.table_prior import TablePrior

_HIGHEST_M, _DEEPEST_M, _WIDEST_M = 1.0, 0.05, 1.5  # where objects on a table can be
_HOW = "'osf import bop --table objects' finds the table by how the objects lie"


@dataclass(frozen=True, eq=False, slots=True)
class BopScene:
    """A scene as it is understood.

    Attributes:
        observation: cameras bear the numbers of their images.
        poses: `T_world_object` by name, as the first chosen image that shows the object annotates it.
        left_out: other objects that are annotated in these images.
    """

    observation: Observation
    poses: Mapping[str, Pose]
    left_out: tuple[str, ...]


def read_bop_scene(
    folder: Path,
    choice: BopChoice | None = None,
    names: tuple[str, ...] | None = None,
    table_prior: Callable[[str], TablePrior] | None = None,
    known: Collection[str] | None = None,
) -> BopScene:
    """Read a scene.

    Args:
        folder: of the scene.
        choice: which images, and how they are read.
        names: of the objects; None for all that are annotated and known.
        table_prior: how a known object can lie, to find the table by how they do; None to take BOP's world for it.
        known: objects that can be estimated; None for all.

    Raises:
        CorruptFile: if a file is missing or broken.
        InvalidInput: if images or objects are chosen that are not there, the cameras' places are not told, or BOP's
            world is not the table's frame.
    """
    images = read_images(folder, choice)
    there = tuple(sorted({name for image in images for name in image.poses}))
    names = _names(names, there, known)
    cameras = _in_bop_world(images) if table_prior is None else _over_found_table(images, table_prior, known)
    poses = {
        name: next(c @ i.poses[name] for c, i in zip(cameras, images, strict=True) if name in i.poses) for name in names
    }
    if table_prior is None:
        _check_over_table(images, cameras, poses)
    if len({image.picture.shape for image in images}) > 1:
        raise InvalidInput("sizes of the images", "not the same", "the same; choose images of one camera")
    hidden = np.zeros(images[0].picture.shape[:2], bool)
    observation = Observation(
        tuple(replace(image.camera, T_world_camera=pose) for image, pose in zip(images, cameras, strict=True)),
        np.stack([image.picture for image in images]),
        names,
        np.stack([[image.masks.get(name, hidden) for name in names] for image in images]),
        None,
        0.0,
    )
    return BopScene(observation, poses, tuple(name for name in there if name not in names))


def _names(asked: tuple[str, ...] | None, there: tuple[str, ...], known: Collection[str] | None) -> tuple[str, ...]:
    if asked is None:
        return tuple(name for name in there if known is None or name in known)
    if missing := [name for name in asked if name not in there]:
        raise InvalidInput("object", missing[0], f"one that scene_gt.json has: {', '.join(there) or 'none'}")
    return asked


def _in_bop_world(images: Sequence[BopImage]) -> list[Pose]:
    """`T_world_camera` of each image."""
    poses: list[Pose] = []
    for image in images:
        if image.T_camera_world is None:
            raise InvalidInput(f"cam_R_w2c and cam_t_w2c of image {image.number}", "missing", f"given; {_HOW}")
        poses.append(image.T_camera_world.inverse())
    return poses


def _over_found_table(
    images: Sequence[BopImage], table_prior: Callable[[str], TablePrior], known: Collection[str] | None
) -> list[Pose]:
    """`T_world_camera` of each image over the table on which the objects of the first one lie."""
    lost = [image.number for image in images if image.T_camera_world is None]
    if lost and len(images) > 1:
        what = f"cam_R_w2c and cam_t_w2c of image {lost[0]}"
        raise InvalidInput(what, "missing", "given for several images; choose one with --images")
    annotated = {name: pose for name, pose in images[0].poses.items() if known is None or name in known}
    found = table_from_objects([table_prior(name) for name in annotated], list(annotated.values()))
    if found is None:
        raise InvalidInput("table under the objects", "not to be found", "one that two or more objects stand on")
    if len(images) == 1:
        return [found.T_world_camera]
    in_bop = _in_bop_world(images)
    return [found.T_world_camera @ in_bop[0].inverse() @ pose for pose in in_bop]


def _check_over_table(images: Sequence[BopImage], cameras: Sequence[Pose], poses: Mapping[str, Pose]) -> None:
    """Cameras above z = 0, objects near it; a world that is one of the cameras fails."""
    why = f"{SCENE_CAMERA} seems to mean another world or unit than mm: {_HOW}"
    for image, camera in zip(images, cameras, strict=True):
        height = camera.position[2]
        if not height > _DEEPEST_M:
            what = f"height of image {image.number}'s camera in BOP's world [m]"
            raise InvalidInput(what, f"{height:.3f}", f"above a table at z = 0; {why}")
    for name, pose in poses.items():
        x, y, z = pose.position
        if not -_DEEPEST_M <= z <= _HIGHEST_M or max(abs(x), abs(y)) > _WIDEST_M:
            place = f"({x:.2f}, {y:.2f}, {z:.2f})"
            raise InvalidInput(f"place of {name} in BOP's world [m]", place, f"on a table at z = 0; {why}")
