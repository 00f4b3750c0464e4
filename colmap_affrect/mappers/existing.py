"""A finished model that new photographs are to be registered into.

It may be of another program, or of an earlier run with other ids: images are told by their names,
and cameras, poses and points are moved into a reconstruction with the ids of the database.
"""

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.colmap.model_files import (
    model_folder,
    read_given_model,
    refuse_panoramas,
)
from colmap_affrect.errors import AffrectError, Option, OptionError
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.options import Options
from colmap_affrect.project.paths import GivenPath, resolved
from colmap_affrect.project.regular_files import read_regular

SAME_POSE = 1e-6
"""Largest difference of elements of two poses that are the same, relative to the translation: files
round quaternions; numeric."""


class Extension(Options):
    """A finished model that photographs are registered into."""

    model_path: GivenPath
    """Folder of a COLMAP model, text or binary."""
    refine_existing: bool = False
    """Whether its poses and cameras may move; else they stay as they are."""

    def refuse_discarding(self, output_path: Path) -> None:
        """Raise OptionError for a model in a folder whose results are to be discarded first."""
        if resolved(self.model_path).is_relative_to(resolved(output_path)):
            raise OptionError(
                (Option("overwrite"), " would discard it"),
                where=Option("extend", self.model_path),
                advice=("leave that out, or use another ", Option("output-path")),
            )

    def digest(self) -> str:
        """Return a sha256 of the files of the model and of how it is extended."""
        found = hashlib.sha256(str(self.refine_existing).encode())
        for path in sorted(model_folder(self.model_path).glob("*.[bt][ix][nt]")):
            found.update(read_regular(path))
        return found.hexdigest()


def as_extension(given: Any) -> Any:
    """Return what a function is given as ``extend``; a path is that of the model."""
    if isinstance(given, Mapping):
        return Extension(**given)
    if given is None or isinstance(given, Extension):
        return given
    return Extension(model_path=given)


@dataclass(frozen=True)
class ExistingModel:
    """A finished model with the ids of a database."""

    reconstruction: pycolmap.Reconstruction
    """All images of the database, those of the model registered; without points, which are to be
    triangulated anew, as the keypoints may be others."""
    refine: bool  # its poses and cameras may move

    @property
    def images(self) -> list[pycolmap.Image]:
        """The images of the model."""
        return _registered(self.reconstruction)

    def constrain(self, native: pycolmap.IncrementalPipelineOptions) -> None:
        """Have pycolmap's mapper keep poses, cameras and rigs, unless they may move."""
        # Also those of the model that no match ties to others
        native.load_all_images = True
        if self.refine:
            return
        native.fix_existing_frames = True
        frames = [self.reconstruction.frame(image.frame_id) for image in self.images]
        native.constant_rigs = {frame.rig_id for frame in frames}
        native.constant_cameras |= {image.camera_id for image in self.images}

    def copy_database(self, path: Path, copy: Path) -> None:
        """Copy a database with the model's cameras: COLMAP demands the same camera models.

        Args:
            path: The database.
            copy: File of the copy, which does not exist.
        """
        copy_database(path, copy)
        with open_database(copy) as database:
            for camera_id in {image.camera_id for image in self.images}:
                database.update_camera(self.reconstruction.camera(camera_id))

    def restore(self, model: pycolmap.Reconstruction) -> None:
        """Move an extended model back onto the poses that it had, and give it images it lost.

        COLMAP gives it another scale. Without refinement the poses are those from before, to the
        bit.
        """
        before = [
            image for image in self.images if model.image(image.image_id).has_pose
        ]
        after = [model.image(image.image_id) for image in before]
        old_from_new = pycolmap.estimate_sim3d(
            _pose_points(after), _pose_points(before)
        )
        if old_from_new:
            model.transform(old_from_new)
        for image in self.images:
            frame = model.frame(image.frame_id)
            if not (frame.has_pose() and self.refine):
                frame.set_cam_from_world(image.camera_id, image.cam_from_world())
            if image.frame_id not in model.reg_frame_ids():
                model.register_frame(image.frame_id)


def read_to_extend(model_path: Path) -> pycolmap.Reconstruction:
    """Read the model that is to be extended.

    OptionError when there is no such folder, no model in it, or one of panoramas; StoreError when
    it is damaged.
    """
    model = read_given_model(model_path, "extend")
    refuse_panoramas(model, Option("extend", model_path))
    return model


@dataclass(frozen=True)
class _SameImage:
    """An image of the model that is extended, and the image of the same name in the database."""

    old: pycolmap.Image
    new: pycolmap.Image


def existing_names(model_path: Path, known: Collection[str]) -> list[str]:
    """Return the sorted names of the images of a model that is to be extended.

    OptionError when there is no such folder, or no model in it; AffrectError when it has no images,
    or some that are not among the ``known`` names of photographs.
    """
    return _known_names(read_to_extend(model_path), model_path, known)


def read_existing(extension: Extension, database_path: Path) -> ExistingModel:
    """Read the poses and cameras of a model and give them the ids of a database.

    OptionError as :func:`existing_names`; AffrectError when it does not fit the database.
    """
    path = extension.model_path
    old = read_to_extend(path)
    with open_database(database_path) as database:
        options = pycolmap.DatabaseCacheOptions(load_all_images=True)
        cache = pycolmap.DatabaseCache.create(database, options)
    new = pycolmap.Reconstruction()
    new.load(cache)
    ids = {image.name: image_id for image_id, image in new.images.items()}
    _known_names(old, path, ids)
    images = [
        _SameImage(image, new.image(ids[image.name])) for image in _registered(old)
    ]
    _take_cameras(images, old, new, path)
    _take_rigs(images, new)
    _take_poses(images, new, path)
    return ExistingModel(new, extension.refine_existing)


def _registered(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return [model.image(image_id) for image_id in model.reg_image_ids()]


def _known_names(
    model: pycolmap.Reconstruction, path: Path, known: Collection[str]
) -> list[str]:
    names = sorted(image.name for image in _registered(model))
    missing = [name for name in names if name not in known]
    if missing:
        raise AffrectError(
            f"{len(missing)} of its {len(names)} images, such as {missing[0]}, are "
            "not among the photographs",
            where=Option("extend", path),
            advice="give the folder with old and new ones",
        )
    return names


def _take_cameras(
    images: Sequence[_SameImage],
    old: pycolmap.Reconstruction,
    new: pycolmap.Reconstruction,
    path: Path,
) -> None:
    """Replace the cameras of the database by those of the model.

    Args:
        images: The images of the model.
        old: The model.
        new: Changed in place.
        path: Folder of the model, for errors.

    Raises:
        AffrectError: When sizes differ, or images with different cameras share one in the database.
    """
    taken: dict[int, _SameImage] = {}
    for image in images:
        name = image.old.name
        camera = old.camera(image.old.camera_id)
        target = new.camera(image.new.camera_id)
        if (camera.width, camera.height) != (target.width, target.height):
            raise AffrectError(
                f"{name} is {camera.width} x {camera.height} px there and "
                f"{target.width} x {target.height} px here",
                where=Option("extend", path),
            )
        first = taken.setdefault(image.new.camera_id, image)
        if not _is_same_camera(camera, old.camera(first.old.camera_id)):
            raise AffrectError(
                f"{first.old.name} and {name} have different cameras there and share "
                "one here",
                where=Option("extend", path),
                advice="use the camera mode that the model was made with, or per-image",
            )
        target.model = camera.model
        target.params = list(camera.params)
        target.has_prior_focal_length = camera.has_prior_focal_length


def _is_same_camera(first: pycolmap.Camera, second: pycolmap.Camera) -> bool:
    return first.model == second.model and np.array_equal(first.params, second.params)


def _take_rigs(images: Sequence[_SameImage], new: pycolmap.Reconstruction) -> None:
    """Set the poses of the sensors of rigs relative to their reference sensors.

    Args:
        images: The images of the model.
        new: Changed in place.
    """
    poses = {image.new.data_id: image.old.cam_from_world() for image in images}
    for image in images:
        data_id = image.new.data_id
        frame = new.frame(image.new.frame_id)
        rig = new.rig(frame.rig_id)
        if rig.is_ref_sensor(data_id.sensor_id):
            continue
        references = [i for i in frame.data_ids if rig.is_ref_sensor(i.sensor_id)]
        if references and references[0] in poses:
            sensor_from_rig = poses[data_id] * poses[references[0]].inverse()
            rig.set_sensor_from_rig(data_id.sensor_id, sensor_from_rig)


def _take_poses(
    images: Sequence[_SameImage], new: pycolmap.Reconstruction, path: Path
) -> None:
    """Set the poses of frames.

    Args:
        images: The images of the model.
        new: Changed in place.
        path: Folder of the model, for errors.

    Raises:
        AffrectError: When an image does not fit the rig that it has in the database.
    """
    for image in images:
        frame = new.frame(image.new.frame_id)
        if not frame.has_pose():
            frame.set_cam_from_world(image.new.camera_id, image.old.cam_from_world())
            new.register_frame(frame.frame_id)
    for image in images:
        pose = image.old.cam_from_world().matrix()
        difference = np.abs(pose - image.new.cam_from_world().matrix()).max()
        if difference > SAME_POSE * (1 + np.abs(pose[:, 3]).max()):
            raise AffrectError(
                f"the pose of {image.old.name} does not fit the rig it has here",
                where=Option("extend", path),
            )


def _pose_points(images: Sequence[pycolmap.Image]) -> Array:
    """Return points that tell poses: projection centres, and the ends of the axes of the cameras.

    Axes are as long as the centres spread. Centres alone tell no rotation where they lie on a line.

    Args:
        images: N images with poses.

    Returns:
        (4 N, 3) points.
    """
    centers = np.array([image.projection_center() for image in images])
    spread = np.linalg.norm(centers - centers.mean(axis=0)) or 1.0
    axes = np.array([image.cam_from_world().rotation.matrix() for image in images])
    ends = centers[:, None] + spread * axes
    return np.concatenate([centers, ends.reshape(-1, 3)])
