"""Cameras before any pair is verified: which images share one, and what is known of it.

pycolmap reads the images, and their positions by GPS. Which cameras they have is decided here.
"""

import logging
import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path, PurePosixPath

from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import (
    TRUSTED,
    CameraRecord,
    Given,
    GivenCamera,
    Source,
    read_camera_records,
    read_given_cameras,
    write_camera_records,
)
from colmap_affrect.colmap.cancellable import run_cancellable
from colmap_affrect.colmap.database import (
    camera_matrix,
    cameras_of_images,
    image_ids,
    open_database,
    require_database_space,
    write_frame,
)
from colmap_affrect.errors import OptionError, lacks_memory, such_as
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.images.exif import (
    MAX_CONTRADICTION,
    PLAUSIBLE_FOCALS,
    CameraTags,
    ExifFocal,
    exif_focal,
    read_camera_tags,
)
from colmap_affrect.images.photographs import (
    CameraOptions,
    photograph_files,
    require_folder,
)
from colmap_affrect.images.reading import IMAGE_SUFFIXES, why_unusable
from colmap_affrect.project.outputs import database_files, remove_own, temporary_folder

MAX_LINES = 5  # that are logged; report.json says all
MAX_ASPECT = 4.0  # longer by shorter side of a photograph, that of film for panoramas

logger = logging.getLogger(__name__)

Size = tuple[int, int]
Group = tuple[object, ...]  # images of one group share a camera


class InitialCameras:
    """Which images share a camera, and which one."""

    def __init__(self, image_path: Path, options: CameraOptions) -> None:
        """Read what the user gives; OptionError when it is wrong."""
        self.image_path = image_path
        self.options = options
        self._given = read_given_cameras(options)
        self._tags = cache(lambda name: read_camera_tags(image_path / name))

    def given(self, name: str) -> GivenCamera:
        """Return what the user says of the camera of an image."""
        return self._given.get(name, self._given[""])

    def size(self, name: str) -> Size | None:
        """Return the (width, height) that the header of an image tells; None if it is damaged."""
        tags = self._tags(name)
        return tags.size if tags else None

    def group(self, name: str) -> Group:
        """Return what is the same for images that share a camera, which all have one size."""
        together = self._together(name)
        if together:
            return (*together, self.size(name))
        if self.options.mode == "per-image":
            return ("per-image", name)
        tags = None if self.options.ignore_exif else self._tags(name)
        if tags and tags.identity and not self._may_be_crop(tags):
            return ("exif", *tags.identity, self.given(name).said)
        return ("image", name)

    def _together(self, name: str) -> Group:
        """Return what is the same for images of which the user says that they share a camera.

        Scans and crops of what one camera took may have several sizes. Empty where nothing is said.
        """
        label = self.given(name).camera
        match self.options.mode:
            case "single":
                return ("single",)
            case "per-folder":
                return ("per-folder", str(PurePosixPath(name).parent))
            case "auto" if label:
                return ("given", label)
        return ()

    def groups(self, names: Sequence[str]) -> dict[Group, list[str]]:
        """Return the names of each group, in the order in which the groups begin."""
        found: defaultdict[Group, list[str]] = defaultdict(list)
        for name in names:
            found[self.group(name)].append(name)
        return dict(found)

    def check(self, names: Sequence[str]) -> str:
        """Refuse images that cannot have the cameras that they should.

        OptionError names the option, or file and line, and what to do. Returns a line where images
        are to share a camera that cannot, for their sizes; else an empty one.
        """
        unknown = [n for n in self._given if n and not (self.image_path / n).is_file()]
        self._refuse(unknown, names, str(self.image_path))
        for same in self.groups(names).values():
            given = self._given_of(same)
            for name in same:
                size = self.size(name)
                if given.size and size and size != given.size:
                    raise OptionError(
                        f"{given.where}: is {_px(given.size)}, {name} is {_px(size)}; give "
                        "photographs of that size, or leave the model out"
                    )
        return self._several_sizes(names)

    def _several_sizes(self, names: Sequence[str]) -> str:
        """Say which images have several sizes that are to share a camera, the first ones found.

        OptionError where all parameters are given: these are of one size.
        """
        firsts: dict[Group, str] = {}
        sizes: defaultdict[Group, set[Size]] = defaultdict(set)
        note = ""
        for name in names:
            size = self.size(name)
            together = self._together(name)
            if not (size and together):
                continue
            sizes[together].add(size)
            first = firsts.setdefault(together, name)
            if size == self.size(first):
                continue
            both = f"{first} is {_px(self.size(first) or size)}, {name} is {_px(size)}"
            if (
                self.given(first).params
                and self.given(first).params == self.given(name).params
            ):
                raise OptionError(
                    f"{self._who(first)}: {both}, and the given parameters are of one size; give "
                    "those of each size as params in a table (--cameras-path), or leave them out"
                )
            note = note or both
        most = max(map(len, sizes.values()), default=0)
        if not note:
            return ""
        have = f"images that should share a camera have {most} sizes, and those of each share one"
        return f"{note}; {have}"

    def _who(self, name: str) -> str:
        """Return what says that an image shares a camera with others."""
        mode = self.options.mode
        return self.given(name).where if mode == "auto" else f"--camera-mode {mode}"

    def check_known(self, names: Sequence[str], where: str) -> None:
        """Refuse cameras of images that are not among some, unless a model has more images."""
        known = set(names)
        self._refuse([n for n in self._given if n and n not in known], names, where)

    def _refuse(self, unknown: Sequence[str], names: Sequence[str], where: str) -> None:
        """Refuse cameras of unknown images; a model may have more images."""
        is_model = any(given.size for given in self._given.values())
        if unknown and not (is_model and self._given.keys() & set(names)):
            given = self.given(unknown[0])
            raise OptionError(f"{given.where}: {unknown[0]} is not in {where}")

    def replace_cameras(self, database: pycolmap.Database) -> dict[int, CameraRecord]:
        """Write what the user gives into the cameras that images of a database have.

        Which images share a camera stays as it is, and of a camera whose focal length alone is
        given, model and distortion. Returns the records of these cameras.
        """
        names: defaultdict[int, list[str]] = defaultdict(list)
        for image in database.read_all_images():
            names[image.camera_id].append(image.name)
        records = {}
        for camera_id, same in sorted(names.items()):
            given = self._given_of(same)
            before = database.read_camera(camera_id)
            size = (before.width, before.height)
            if not (
                given.params
                or given.focal_px
                or given.focal_mm
                or self.options.focal_mm
            ):
                continue
            if given.size and tuple(given.size) != size:
                raise OptionError(
                    f"{given.where}: is {given.size[0]} x {given.size[1]} px, and {same[0]} is "
                    f"{size[0]} x {size[1]} px in the database"
                )
            camera, records[camera_id] = self.camera(sorted(same), size)
            if not given.params and given.model == CameraOptions().model:
                camera = _with_focal(before, camera, has_center=given.cx is not None)
            camera.camera_id = camera_id
            database.update_camera(camera)
        return records

    def _given_of(self, names: Sequence[str]) -> GivenCamera:
        named = [self._given[name] for name in names if name in self._given]
        first = named[0] if named else self._given[""]
        for other in named:
            if other.said != first.said:
                raise OptionError(
                    f"{other.where}: says something else than {first.where.rpartition(', ')[2]}, "
                    f"and --camera-mode {self.options.mode} lets these images share a camera; "
                    "leave that out, or give both the same"
                )
        return first

    def camera(
        self, names: Sequence[str], size: Size
    ) -> tuple[pycolmap.Camera, CameraRecord]:
        """Return the camera that images of one size share, and what is known of it."""
        given = self._given_of(names)
        longer = max(size)
        camera = pycolmap.Camera.create_from_model_name(
            1, given.model, self.options.default_focal_length_factor * longer, *size
        )
        source, why = self._set_focal(camera, given, names)
        parts: list[Given] = ["focal"] if source == "given" else []
        if given.params:
            camera.params = list(given.params)
        elif (
            given.cx is not None
            and given.cy is not None
            and len(camera.principal_point_idxs())
        ):
            camera.principal_point_x = given.cx
            camera.principal_point_y = given.cy
        if given.params or given.cx is not None:
            parts.append("principal-point")
        if given.params or (parts and not len(camera.extra_params_idxs())):
            parts.append("distortion")
        camera.has_prior_focal_length = source in TRUSTED
        focal = _focal(camera)
        low, high = PLAUSIBLE_FOCALS
        if longer > MAX_ASPECT * min(size):
            why = "a panorama, which no camera model fits? give the photographs that it is made of"
        if source == "given" and focal and not low <= focal / longer <= high:
            why = f"{focal / longer:.2g} longer sides; is it in px of the stored files?"
        record = CameraRecord(
            tuple(sorted(names)), source, focal, why, size, tuple(parts)
        )
        if source == "guess":
            found = self._exif_focal(names)
            record = replace(
                record, lens_mm=found.lens_mm, uncropped_px=found.uncropped_px
            )
        return camera, record

    def _set_focal(
        self, camera: pycolmap.Camera, given: GivenCamera, names: Sequence[str]
    ) -> tuple[Source, str]:
        if given.params:
            return "given", ""
        source: Source = "given"
        focal = given.focal_px
        why = ""
        if given.focal_mm and given.plate_width_mm:
            focal = given.focal_mm / given.plate_width_mm * camera.width
        if not focal:
            found = self._exif_focal(names)
            source = "exif-rescaled" if found.is_rescaled else "exif"
            focal = found.focal_px
            why = found.why
        if not focal and self.options.focal_mm:
            source = "given"
            why = ""
            longer = max(camera.width, camera.height)
            focal = self.options.focal_mm / self.options.film_width_mm * longer
        if not focal:
            return "guess", why
        for index in camera.focal_length_idxs():
            camera.params[index] = focal
        return source, why

    def _may_be_crop(self, tags: CameraTags) -> bool:
        """Tell whether a photograph that has kept its shape may be a crop, as others of its body.

        All of the folder are looked at, but only where one is smaller than when it was taken.
        """
        return tags.scale < 1.0 and tags.body in self._cropped_bodies

    @cached_property
    def _cropped_bodies(self) -> set[tuple[str, str, str]]:
        """Bodies of cameras of which photographs were cropped."""
        all_tags = [
            self._tags(name)
            for name in photograph_files(self.image_path, IMAGE_SUFFIXES)
        ]
        return {
            tags.body
            for tags in all_tags
            if tags and tags.was_cropped and any(tags.body)
        }

    def _exif_focal(self, names: Sequence[str]) -> ExifFocal:
        """Return the focal length that EXIF gives images of one camera; first that has one."""
        if self.options.ignore_exif:
            return ExifFocal(None, why="EXIF is ignored")
        found = []
        for tags in filter(None, map(self._tags, names)):
            make, model, _ = tags.body
            width_mm = sensor_width_mm(make, model) if tags.focal_mm else None
            found.append(exif_focal(tags, width_mm, has_crops=self._may_be_crop(tags)))
        trusted = [focal for focal in found if focal.focal_px]
        if not trusted:
            return found[0] if found else ExifFocal(None, why="no readable header")
        values = [focal.focal_px or 0.0 for focal in trusted]
        if max(values) > MAX_CONTRADICTION * min(values):
            why = f"EXIF of its images says {min(values):.0f} to {max(values):.0f} px"
            return ExifFocal(None, why=why)
        return trusted[0]

    def matrix(self, name: str, names: Sequence[str]) -> Array | None:
        """Return the (3, 3) intrinsics that an image will have, without distortion.

        They are in pixel-centre px; None for a file that cannot be read. Of all ``names`` some may
        share its camera.
        """
        size = self.size(name)
        if not size:
            return None
        same = self.groups(names).get(self.group(name), [name])
        return camera_matrix(self.camera(same, size)[0])


def _with_focal(
    camera: pycolmap.Camera, given: pycolmap.Camera, *, has_center: bool
) -> pycolmap.Camera:
    """Return a camera with the focal length of another one, and perhaps its principal point."""
    for index in camera.focal_length_idxs():
        camera.params[index] = given.mean_focal_length()
    if has_center:
        camera.principal_point_x = given.principal_point_x
        camera.principal_point_y = given.principal_point_y
    camera.has_prior_focal_length = given.has_prior_focal_length
    return camera


@cache
def sensor_width_mm(make: str, model: str) -> float | None:
    """Return the longer side of the sensor of a camera model that COLMAP knows, else None.

    COLMAP's table is only asked when an image is read, so it is given one of 8 px.
    """
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = make, model
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = IFDRational(1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one.jpg"
        Image.new("L", (8, 8)).save(path, exif=exif)
        bitmap = pycolmap.Bitmap.read(path, as_rgb=False)
    focal = bitmap.exif_focal_length() if bitmap else None
    return 8.0 / focal if focal else None


def _px(size: Sequence[int]) -> str:
    return f"{size[0]} x {size[1]} px"


def _focal(camera: pycolmap.Camera) -> float:
    return float(camera.mean_focal_length()) if len(camera.focal_length_idxs()) else 0.0


def import_images(
    path: Path, image_path: Path, names: Sequence[str], options: CameraOptions
) -> list[str]:
    """Add cameras, rigs, frames and images for the names that a database lacks.

    Sizes and GPS priors are read by COLMAP, from the files as stored, not rotated. Images that
    are added later share cameras as if all had been added at once. All of them are added, or none;
    a new database appears with them. Returns the names of the images that COLMAP cannot read, or
    whose size is not that of their camera.
    """
    initial = InitialCameras(image_path, options)
    is_new = not path.exists()
    if is_new:
        remove_own(database_files(path))  # what is beside it, of one that was removed
    with temporary_folder(path.parent) as folder:
        new = folder / "new.db" if is_new else path
        read = folder / "read.db"
        known = set[str]() if is_new else set(image_ids(new))
        missing = sorted(set(names) - known)
        missing = [name for name in missing if not why_unusable(image_path / name)]
        if missing:
            require_database_space(new, 2 * len(missing))
            with open_database(read) as found:  # which makes it
                _read_images(read, image_path, missing)
                with open_database(new) as database:
                    known.update(_take_over(initial, found, database))
        if not new.exists():
            image_ids(new)  # makes an empty one
        if is_new:
            new.replace(path)
    return sorted(set(names) - known)


def _read_images(path: Path, image_path: Path, names: Sequence[str]) -> None:
    """Let COLMAP read images into a database; OptionError where their folder is gone meanwhile."""
    mode = pycolmap.CameraMode.PER_IMAGE
    try:
        run_cancellable(lambda _: pycolmap.import_images(path, image_path, mode, names))
    except (RuntimeError, ValueError) as error:
        if lacks_memory(error) or image_path.is_dir():
            raise
        require_folder(image_path)  # it is gone, as with a drive


def _take_over(
    initial: InitialCameras, found: pycolmap.Database, database: pycolmap.Database
) -> list[str]:
    """Take over images that COLMAP has read into a database of their own: all of them, or none.

    Returns:
        The names of those that fit the cameras.
    """
    taken = list[str]()
    images = sorted(found.read_all_images(), key=lambda image: image.name)
    read = cameras_of_images(found)
    sizes = {i.name: (read[i.image_id].width, read[i.image_id].height) for i in images}
    priors = {prior.corr_data_id.id: prior for prior in found.read_all_pose_priors()}
    cameras = _known_cameras(initial, database)
    rigs = {rig.ref_sensor_id: rig.rig_id for rig in database.read_all_rigs()}
    with pycolmap.DatabaseTransaction(database):
        for group, names in initial.groups(list(sizes)).items():
            if group not in cameras:
                size = sizes[names[0]]
                camera, _ = initial.camera([n for n in names if sizes[n] == size], size)
                camera.camera_id = database.write_camera(camera)
                cameras[group] = camera
        for image in images:
            camera = cameras[initial.group(image.name)]
            if sizes[image.name] == (camera.width, camera.height):
                written = pycolmap.Image(name=image.name, camera_id=camera.camera_id)
                written.image_id = database.write_image(written)
                taken.append(image.name)
                write_frame(database, written, rigs)
                if prior := priors.get(image.image_id):
                    prior.corr_data_id = written.data_id
                    database.write_pose_prior(prior)
    return taken


def _known_cameras(
    initial: InitialCameras, database: pycolmap.Database
) -> dict[Group, pycolmap.Camera]:
    """Return the cameras of the database that new images of a group get."""
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    used: dict[Group, set[int]] = defaultdict(set)
    for image in database.read_all_images():
        used[initial.group(image.name)].add(image.camera_id)
    return {group: cameras[min(ids)] for group, ids in used.items() if len(ids) == 1}


def record_cameras(
    cameras_of: Mapping[str, pycolmap.Camera],
    records_path: Path,
    initial: InitialCameras | None = None,
    known: Mapping[int, CameraRecord] | None = None,
) -> None:
    """Put the cameras that are not on record yet on record, and log what is worth knowing of them.

    Args:
        cameras_of: the cameras of the database by image name.
        records_path: the file of the records.
        initial: what they were made from; None for cameras of another database.
        known: the records of that one, if there are any.
    """
    before = read_camera_records(records_path)
    known = before or known or {}
    cameras = {camera.camera_id: camera for camera in cameras_of.values()}
    names: dict[int, list[str]] = defaultdict(list)
    for name, camera in cameras_of.items():
        names[camera.camera_id].append(name)
    records = {}
    for camera_id, of_camera in names.items():
        record = known.get(camera_id)
        same = tuple(sorted(of_camera))
        if record and set(record.names) <= set(same):
            records[camera_id] = replace(record, names=same)
        else:
            records[camera_id] = _record(cameras[camera_id], same, initial)
    if records != before:
        write_camera_records(records_path, records)
        reasons: defaultdict[str, list[str]] = defaultdict(list)
        for key, record in records.items():
            if record.why and record != before.get(key):
                reasons[record.why] += record.names
        for why, concerned in list(reasons.items())[:MAX_LINES]:
            logger.info("cameras: %s: %s", such_as(concerned), why)


def _record(
    camera: pycolmap.Camera, names: tuple[str, ...], initial: InitialCameras | None
) -> CameraRecord:
    """Say what is known of a camera: as it was made here, or only by COLMAP's flag."""
    size = (camera.width, camera.height)
    if initial:
        made, record = initial.camera(names, size)
        if _values(made) == _values(camera):
            return record
    source: Source = "given" if camera.has_prior_focal_length else "guess"
    return CameraRecord(names, source, _focal(camera), size=size)


def _values(camera: pycolmap.Camera) -> tuple[object, ...]:
    return camera.model_name, camera.params.tolist(), camera.has_prior_focal_length
