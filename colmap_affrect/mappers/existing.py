"""A finished model that new photographs are to be registered into.

It may be of another program, or of an earlier run with other ids: images are told by their names,
and cameras, poses and points are moved into a reconstruction with the ids of the database.
"""

import hashlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.colmap.model_files import model_folder, read_given_model
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.options import Options
from colmap_affrect.project.paths import GivenPath, resolved
from colmap_affrect.project.regular_files import read_regular

SAME_POSE = 1e-6  # largest difference of elements of two poses that are the same: quaternions round


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
                f"--extend {self.model_path}: --overwrite would discard it; leave that out, or use "
                "another --output-path"
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
        native.load_all_images = True  # also those of the model that no match ties to others
        if not self.refine:
            native.fix_existing_frames = True
            native.constant_cameras |= {image.camera_id for image in self.images}
            native.constant_rigs = {
                self.reconstruction.frame(image.frame_id).rig_id for image in self.images
            }

    def copy_database(self, path: Path, copy: Path) -> None:
        """Copy a database with the model's cameras: COLMAP demands the same camera models."""
        copy_database(path, copy)
        with open_database(copy) as database:
            for camera_id in {image.camera_id for image in self.images}:
                database.update_camera(self.reconstruction.camera(camera_id))

    def restore(self, model: pycolmap.Reconstruction) -> None:
        """Give an extended model the poses that it had before, to the bit, and images it lost.

        The model as a whole is moved back onto them: COLMAP gives it another scale.
        """
        kept = [image for image in self.images if model.image(image.image_id).has_pose]
        now = _points_of([model.image(image.image_id) for image in kept])
        if moved := pycolmap.estimate_sim3d(now, _points_of(kept)):
            model.transform(moved)
        for image in self.images:
            frame = model.frame(image.frame_id)
            if not (frame.has_pose() and self.refine):
                frame.set_cam_from_world(image.camera_id, image.cam_from_world())
            if image.frame_id not in model.reg_frame_ids():
                model.register_frame(image.frame_id)


def existing_names(model_path: Path, known: Collection[str]) -> list[str]:
    """Return the sorted names of the images of a model that is to be extended.

    OptionError when there is no such folder, or no model in it; AffrectError when it has no images,
    or some that are not among the ``known`` names of photographs.
    """
    return _known_names(read_given_model(model_path, "--extend "), model_path, known)


def read_existing(extension: Extension, database_path: Path) -> ExistingModel:
    """Read the poses and cameras of a model and give them the ids of a database.

    OptionError as :func:`existing_names`; AffrectError when it does not fit the database.
    """
    path = extension.model_path
    old = read_given_model(path, "--extend ")
    with open_database(database_path) as database:
        options = pycolmap.DatabaseCacheOptions(load_all_images=True)
        cache = pycolmap.DatabaseCache.create(database, options)
    new = pycolmap.Reconstruction()
    new.load(cache)
    ids = {image.name: image_id for image_id, image in new.images.items()}
    _known_names(old, path, ids)
    images = [(image, new.image(ids[image.name])) for image in _registered(old)]
    _take_cameras(images, old, new, path)
    _take_poses(images, new, path)
    return ExistingModel(new, extension.refine_existing)


ImagePairs = list[tuple[pycolmap.Image, pycolmap.Image]]  # of the old model, and of the database


def _registered(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return [model.image(image_id) for image_id in model.reg_image_ids()]


def _known_names(model: pycolmap.Reconstruction, path: Path, known: Collection[str]) -> list[str]:
    names = sorted(image.name for image in _registered(model))
    missing = [name for name in names if name not in known]
    if missing:
        raise AffrectError(
            f"--extend {path}: {len(missing)} of its {len(names)} images, such as {missing[0]}, "
            "are not among the photographs; give the folder with old and new ones"
        )
    return names


def _take_cameras(
    images: ImagePairs, old: pycolmap.Reconstruction, new: pycolmap.Reconstruction, path: Path
) -> None:
    """Replace the cameras of the database by those of the model."""
    taken: dict[int, tuple[str, pycolmap.Camera]] = {}
    for mine, now in images:
        camera, mapped = old.camera(mine.camera_id), new.camera(now.camera_id)
        if (camera.width, camera.height) != (mapped.width, mapped.height):
            raise AffrectError(
                f"--extend {path}: {mine.name} is {camera.width} x {camera.height} px there and "
                f"{mapped.width} x {mapped.height} px here"
            )
        name, other = taken.setdefault(now.camera_id, (mine.name, camera))
        if camera.model != other.model or not np.array_equal(camera.params, other.params):
            raise AffrectError(
                f"--extend {path}: {name} and {mine.name} have different cameras there and share "
                "one here; use the camera mode that the model was made with, or per-image"
            )
        mapped.model, mapped.params = camera.model, list(camera.params)
        mapped.has_prior_focal_length = camera.has_prior_focal_length


def _take_poses(images: ImagePairs, new: pycolmap.Reconstruction, path: Path) -> None:
    """Set the poses of frames, and of the sensors of a rig relative to its reference."""
    poses = {now.data_id: mine.cam_from_world() for mine, now in images}
    for _, now in images:
        frame, sensor = new.frame(now.frame_id), new.camera(now.camera_id).sensor_id
        rig = new.rig(frame.rig_id)
        reference = [i for i in frame.data_ids if rig.is_ref_sensor(i.sensor_id)]
        if not rig.is_ref_sensor(sensor) and reference and reference[0] in poses:
            rig.set_sensor_from_rig(sensor, poses[now.data_id] * poses[reference[0]].inverse())
    for image, now in images:
        frame = new.frame(now.frame_id)
        if not frame.has_pose():
            frame.set_cam_from_world(now.camera_id, image.cam_from_world())
            new.register_frame(now.frame_id)
    for image, now in images:
        pose = image.cam_from_world().matrix()
        difference = np.abs(pose - now.cam_from_world().matrix()).max()
        if difference > SAME_POSE * (1 + np.abs(pose[:, 3]).max()):
            raise AffrectError(
                f"--extend {path}: the pose of {image.name} does not fit the rig it has here"
            )


def _points_of(images: list[pycolmap.Image]) -> Array:
    """Return (N, 3) points that tell poses: centres, and the ends of axes as long as they spread.

    Centres alone tell no rotation where they lie on a line.
    """
    centers = np.array([image.projection_center() for image in images])
    spread = np.linalg.norm(centers - centers.mean(axis=0)) or 1.0
    axes = np.array([image.cam_from_world().rotation.matrix() for image in images])
    return np.concatenate([centers, (centers[:, None] + spread * axes).reshape(-1, 3)])
