"""Cameras before any pair is verified: which images share one, and what is known of it.

pycolmap reads the images, and their positions by GPS. Which cameras they have is decided here.
"""

import tempfile
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
    read_given_cameras,
)
from colmap_affrect.colmap.database import camera_matrix
from colmap_affrect.errors import Option, OptionError, Row, Words
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.images.exif import (
    MAX_CONTRADICTION,
    PLAUSIBLE_FOCALS,
    CameraTags,
    ExifFocal,
    exif_focal,
    has_other_shape,
    read_camera_tags,
)
from colmap_affrect.images.photographs import CameraOptions, photograph_files
from colmap_affrect.images.reading import IMAGE_SUFFIXES
from colmap_affrect.project.stage_warnings import StageWarning

# Longer by shorter side of a photograph that no panorama is; theory: the longest film is 617 (2.8)
MAX_ASPECT = 4.0
# Longer side in px of the photograph that COLMAP is asked about; any, as it gives a ratio (theory)
PROBE_SIZE_PX = 8

Size = tuple[int, int]
Group = tuple[object, ...]  # images of one group share a camera


@dataclass(frozen=True)
class StartFocal:
    """The focal length that a camera starts with, and its source.

    Attributes:
        source: who knows it; "guess" if nobody does.
        px: in px of the stored file; None for the guess, and where it is among given parameters.
        why: what was decided and for what reason, one clause.
    """

    source: Source
    px: float | None = None
    why: str = ""


class InitialCameras:
    """Which images share a camera, and which one."""

    def __init__(self, image_path: Path, options: CameraOptions) -> None:
        """Read what the user gives; OptionError when it is wrong."""
        self.image_path = image_path
        self.options = options
        self._given = read_given_cameras(options)
        self._stored_tags = cache(lambda name: read_camera_tags(image_path / name))

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

    def check(self, names: Sequence[str]) -> list[StageWarning]:
        """Refuse images that cannot have the cameras that they should.

        OptionError names the option, or file and line, and what to do. Returns a warning where
        images are to share a camera that cannot, for their sizes.
        """
        unknown = list[str]()
        for name in self._given:
            if name and not (self.image_path / name).is_file():
                unknown.append(name)
        self._refuse(unknown, names, str(self.image_path))
        for same in self.groups(names).values():
            given = self._given_of(same)
            for name in same:
                self._check_size(name, given)
        return self._several_sizes(names)

    def _check_size(self, name: str, given: GivenCamera) -> None:
        """Refuse an image of another size than that of its camera in a given model."""
        size = self.size(name)
        if given.size and size and size != given.size:
            raise OptionError(
                f"is {_px(given.size)}, {name} is {_px(size)}",
                where=given.where,
                advice="give photographs of that size, or leave the model out",
            )

    def _several_sizes(self, names: Sequence[str]) -> list[StageWarning]:
        """Warn of images of several sizes that are to share a camera, of the first ones found.

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
            first_size = self.size(first) or size
            if size == first_size:
                continue
            both = f"{first} is {_px(first_size)}, {name} is {_px(size)}"
            self._refuse_params_of_one_size(first, name, both)
            note = note or both
        if not note:
            return []
        most = max(map(len, sizes.values()))
        values: dict[str, int | str] = {"example": note, "num_sizes": most}
        return [StageWarning("several_sizes", "cameras", values)]

    def _refuse_params_of_one_size(self, first: str, second: str, both: str) -> None:
        """Refuse the same given parameters for images of two sizes, which ``both`` tells."""
        params = self.given(first).params
        if params and params == self.given(second).params:
            raise OptionError(
                f"{both}, and the given parameters are of one size",
                where=self._who(first),
                advice=(
                    "give those of each size as params in a table (",
                    Option("cameras-path"),
                    "), or leave them out",
                ),
            )

    def _who(self, name: str) -> Words:
        """Return what says that an image shares a camera with others."""
        mode = self.options.mode
        if mode == "auto":
            row: Row = self.given(name).where
            return row
        return Option("camera-mode", mode)

    def check_known(self, names: Sequence[str], where: str) -> None:
        """Refuse cameras of images that are not known, unless a model has more images.

        Args:
            names: of the images that are known.
            where: names the file or folder that has them, for the message.

        Raises:
            OptionError: a camera is given for another image.
        """
        known = {"", *names}
        unknown = [name for name in self._given if name not in known]
        self._refuse(unknown, names, where)

    def _refuse(self, unknown: Sequence[str], names: Sequence[str], where: str) -> None:
        """Refuse cameras of unknown images; a model may have more images."""
        is_model = any(given.size for given in self._given.values())
        if unknown and not (is_model and self._given.keys() & set(names)):
            given = self.given(unknown[0])
            raise OptionError(f"{unknown[0]} is not in {where}", where=given.where)

    def replace_cameras(self, database: pycolmap.Database) -> dict[int, CameraRecord]:
        """Write what the user gives into the cameras that images of a database have.

        Which images share a camera stays as it is, and of a camera whose focal length alone is
        given, model and distortion. Returns the records of these cameras.
        """
        names: defaultdict[int, list[str]] = defaultdict(list)
        for image in database.read_all_images():
            names[image.camera_id].append(image.name)
        records = dict[int, CameraRecord]()
        for camera_id, same in sorted(names.items()):
            given = self._given_of(same)
            if (
                given.params
                or given.focal_px
                or given.focal_mm
                or self.options.focal_mm
            ):
                records[camera_id] = self._replace_camera(database, camera_id, same)
        return records

    def _replace_camera(
        self, database: pycolmap.Database, camera_id: int, names: Sequence[str]
    ) -> CameraRecord:
        """Write what the user gives into one camera of a database, and return its record."""
        given = self._given_of(names)
        before = database.read_camera(camera_id)
        size = (before.width, before.height)
        if given.size and tuple(given.size) != size:
            raise OptionError(
                f"is {_px(given.size)}, and {names[0]} is {_px(size)} in the database",
                where=given.where,
            )
        camera, record = self.camera(sorted(names), size)
        if not given.params and given.model == CameraOptions().model:
            camera = _with_focal(before, camera, has_center=given.cx is not None)
        camera.camera_id = camera_id
        database.update_camera(camera)
        return record

    def _given_of(self, names: Sequence[str]) -> GivenCamera:
        named = [self._given[name] for name in names if name in self._given]
        first = named[0] if named else self._given[""]
        for other in named:
            if other.said != first.said:
                raise OptionError(
                    (
                        f"says something else than {first.where.part}, and ",
                        Option("camera-mode", self.options.mode),
                        " lets these images share a camera",
                    ),
                    where=other.where,
                    advice="leave that out, or give both the same",
                )
        return first

    def camera(
        self, names: Sequence[str], size: Size
    ) -> tuple[pycolmap.Camera, CameraRecord]:
        """Return the camera that images of one size share, and what is known of it.

        Args:
            names: of the images.
            size: their (width, height) in px of the stored files.

        Returns:
            The camera, whose id is not set, and its record.

        Raises:
            OptionError: the user says different things of these images.
        """
        given = self._given_of(names)
        start = self._start_focal(given, names, size)
        camera = pycolmap.Camera.create_from_model_name(
            1,
            given.model,
            self.options.default_focal_length_factor * max(size),
            *size,
        )
        _set_intrinsics(camera, given, start)
        focal_px = focal_of(camera)
        record = CameraRecord(
            names=tuple(sorted(names)),
            source=start.source,
            focal_px=focal_px,
            why=_implausible(start.source, focal_px, size) or start.why,
            size=size,
            given=_given_parts(camera, given, start.source),
        )
        if start.source == "guess":
            found = self._exif_focal(names)
            record = replace(
                record, lens_mm=found.lens_mm, uncropped_px=found.uncropped_px
            )
        return camera, record

    def _start_focal(
        self, given: GivenCamera, names: Sequence[str], size: Size
    ) -> StartFocal:
        """Return the focal length of the best source: the user for the images, EXIF, the user."""
        if given.params:
            return StartFocal("given")
        if given.focal_mm and given.plate_width_mm:
            return StartFocal("given", given.focal_mm / given.plate_width_mm * size[0])
        if given.focal_px:
            return StartFocal("given", given.focal_px)
        found = self._exif_focal(names)
        if found.focal_px:
            source: Source = "exif-rescaled" if found.is_rescaled else "exif"
            return StartFocal(source=source, px=found.focal_px, why=found.why)
        if self.options.focal_mm:
            film_widths = self.options.focal_mm / self.options.film_width_mm
            return StartFocal("given", film_widths * max(size))
        return StartFocal("guess", why=found.why)

    def _may_be_crop(self, tags: CameraTags) -> bool:
        """Tell whether a photograph that has kept its shape may be a crop, as others of its body.

        All of the folder are looked at, but only where one is smaller than when it was taken.
        """
        return tags.scale < 1.0 and tags.body in self._cropped_bodies

    def _tags(self, name: str) -> CameraTags | None:
        """Return what the file of a photograph says of its camera; None if it has no header.

        Programs that crop may leave out which size it had: others of its body may tell.
        """
        tags = self._stored_tags(name)
        if tags is None or tags.original_size or not any(tags.body):
            return tags
        whole = self._whole_sizes.get(tags.body)
        if whole is None:
            return tags
        return replace(tags, original_size=whole, is_size_of_others=True)

    @cached_property
    def _whole_sizes(self) -> dict[tuple[str, str, str], Size]:
        """Largest size of photographs of each body that have several shapes, and no other size."""
        sizes = defaultdict[tuple[str, str, str], list[Size]](list)
        for name in photograph_files(self.image_path, IMAGE_SUFFIXES):
            tags = self._stored_tags(name)
            if tags and any(tags.body) and not tags.original_size:
                sizes[tags.body].append(tags.size)
        found = {}
        for body, of_body in sizes.items():
            whole = max(of_body, key=lambda size: (max(size), min(size), size))
            if any(has_other_shape(size, whole) for size in of_body):
                found[body] = whole
        return found

    @cached_property
    def _cropped_bodies(self) -> set[tuple[str, str, str]]:
        """Bodies of cameras of which photographs were cropped."""
        bodies = set[tuple[str, str, str]]()
        for name in photograph_files(self.image_path, IMAGE_SUFFIXES):
            tags = self._tags(name)
            if tags and tags.was_cropped and any(tags.body):
                bodies.add(tags.body)
        return bodies

    def _exif_focal(self, names: Sequence[str]) -> ExifFocal:
        """Return the focal length that EXIF gives images of one camera; first that has one."""
        if self.options.ignore_exif:
            return ExifFocal(None, why="EXIF is ignored")
        found = self._exif_focals(names)
        trusted = [focal for focal in found if focal.focal_px]
        if not trusted:
            return found[0] if found else ExifFocal(None, why="no readable header")
        values = [focal.focal_px or 0.0 for focal in trusted]
        if max(values) > MAX_CONTRADICTION * min(values):
            why = f"EXIF of its images says {min(values):.0f} to {max(values):.0f} px"
            return ExifFocal(None, why=why)
        return trusted[0]

    def _exif_focals(self, names: Sequence[str]) -> list[ExifFocal]:
        """Return what EXIF says of each image whose header can be read."""
        found = list[ExifFocal]()
        for name in names:
            tags = self._tags(name)
            if tags:
                make, model, _ = tags.body
                width_mm = sensor_width_mm(make, model) if tags.focal_mm else None
                has_crops = self._may_be_crop(tags)
                found.append(exif_focal(tags, width_mm, has_crops=has_crops))
        return found

    def matrix(self, name: str, names: Sequence[str]) -> Array | None:
        """Return the intrinsics that an image will have, without distortion.

        Args:
            name: of the image.
            names: of all images, of which some may share its camera.

        Returns:
            A (3, 3) matrix in pixel-centre px; None for a file that cannot be read.
        """
        size = self.size(name)
        if not size:
            return None
        same = self.groups(names).get(self.group(name), [name])
        return camera_matrix(self.camera(same, size)[0])


def _set_intrinsics(
    camera: pycolmap.Camera, given: GivenCamera, start: StartFocal
) -> None:
    """Set what is known of the intrinsics; a camera has COLMAP's guess of the others."""
    if given.params:
        camera.params = list(given.params)
    elif start.px:
        for index in camera.focal_length_idxs():
            camera.params[index] = start.px
    has_center = bool(len(camera.principal_point_idxs())) and not given.params
    if has_center and given.cx is not None and given.cy is not None:
        camera.principal_point_x = given.cx
        camera.principal_point_y = given.cy
    camera.has_prior_focal_length = start.source in TRUSTED


def _given_parts(
    camera: pycolmap.Camera, given: GivenCamera, source: Source
) -> tuple[Given, ...]:
    """Return what of the intrinsics is the user's."""
    parts = list[Given]()
    if source == "given":
        parts.append("focal")
    if given.params or given.cx is not None:
        parts.append("principal-point")
    if given.params or (parts and not len(camera.extra_params_idxs())):
        parts.append("distortion")
    return tuple(parts)


def _implausible(source: Source, focal_px: float, size: Size) -> str:
    """Say why a camera is implausible; empty if it is not."""
    longer = max(size)
    low, high = PLAUSIBLE_FOCALS
    ratio = focal_px / longer
    if source == "given" and focal_px and not low <= ratio <= high:
        return f"{ratio:.2g} longer sides; is it in px of the stored files?"
    if longer > MAX_ASPECT * min(size):
        return "a panorama, which no camera model fits? give the photographs that it is made of"
    return ""


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

    COLMAP's table is only asked when an image is read, so it is given a small one, with a focal
    length of 1 mm.
    """
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = make
    exif[ExifTags.Base.Model] = model
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = IFDRational(1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one.jpg"
        Image.new("L", (PROBE_SIZE_PX, PROBE_SIZE_PX)).save(path, exif=exif)
        bitmap = pycolmap.Bitmap.read(path, as_rgb=False)
    focal = bitmap.exif_focal_length() if bitmap else None
    return PROBE_SIZE_PX / focal if focal else None


def _px(size: Sequence[int]) -> str:
    return f"{size[0]} x {size[1]} px"


def focal_of(camera: pycolmap.Camera) -> float:
    """Return the focal length of a camera in px, the mean of two; 0 without one."""
    return float(camera.mean_focal_length()) if len(camera.focal_length_idxs()) else 0.0
