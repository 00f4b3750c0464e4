"""COLMAP's SIFT through pycolmap, on the images and pairs of a database that has no features."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.images.photographs import MaskOptions, Photographs
from colmap_affrect.pairs.base import Pair
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.outputs import temporary_folder

TEMPORARY_NAME = "id:{}"  # name of an image by its id while COLMAP matches


def extract_sift(
    database_path: Path,
    image_path: Path,
    image_names: Sequence[str],
    masks: MaskOptions,
    *,
    affine: bool,
) -> dict[str, str]:
    """Extract SIFT features of images of a database; those that have some are kept.

    Images and masks that claim more pixels than photographs have are passed over: COLMAP takes
    memory for whatever a header claims. Options are COLMAP's defaults, if ``affine`` with affine
    shapes and domain-size pooling. Returns the images without features, with the reason.
    """
    photographs = Photographs(image_path, masks)
    impossible = {name: why for name in image_names if (why := photographs.why_impossible(name))}
    usable = [name for name in image_names if name not in impossible]
    options, reader = pycolmap.FeatureExtractionOptions(), pycolmap.ImageReaderOptions()
    options.sift.estimate_affine_shape = options.sift.domain_size_pooling = affine
    if masks.path:
        reader.mask_path = Path(masks.path)
    if masks.camera_path:
        reader.camera_mask_path = Path(masks.camera_path)
    if usable:  # pycolmap takes no names for all
        pycolmap.extract_features(
            database_path,
            image_path,
            image_names=usable,
            reader_options=reader,
            extraction_options=options,
        )
    ids = image_ids(database_path)
    with open_database(database_path) as database:
        failed = [name for name in usable if not database.exists_keypoints(ids[name])]
    return impossible | dict.fromkeys(failed, "COLMAP cannot read it or its mask")


def match_sift(database_path: Path, pairs: Sequence[Pair]) -> None:
    """Match pairs of images by COLMAP's defaults, without verification.

    In a copy in which images have other names: COLMAP's lists of pairs cannot hold spaces.
    """
    ids = image_ids(database_path)
    names = {image_id: name for name, image_id in ids.items()}
    lines = [f"{TEMPORARY_NAME.format(ids[a])} {TEMPORARY_NAME.format(ids[b])}\n" for a, b in pairs]
    with temporary_folder(database_path.parent) as folder:
        list_path, copy = folder / "pairs.txt", folder / database_path.name
        replace_text(list_path, "".join(lines))
        copy_database(database_path, copy)
        _rename_images(copy, {image_id: TEMPORARY_NAME.format(image_id) for image_id in names})
        pycolmap.match_image_pairs(
            copy,
            matching_options=pycolmap.FeatureMatchingOptions(skip_geometric_verification=True),
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=list_path),
        )
        _rename_images(copy, names)
        copy.replace(database_path)


def _rename_images(database_path: Path, names: Mapping[int, str]) -> None:
    with open_database(database_path) as database:
        for image in database.read_all_images():
            image.name = names[image.image_id]
            database.update_image(image)
