"""COLMAP's SIFT through pycolmap, on the images and pairs of a database that has no features."""

from collections.abc import Sequence
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.errors import AffrectError
from colmap_affrect.images.photographs import MaskOptions, Photographs
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.outputs import temporary_folder


def extract_sift(
    database_path: Path,
    image_path: Path,
    image_names: Sequence[str],
    masks: MaskOptions,
) -> dict[str, str]:
    """Extract SIFT features of images of a database; those that have some are kept.

    Images and masks that claim more pixels than photographs have are passed over: COLMAP takes
    memory for whatever a header claims. Options are COLMAP's defaults. Returns the images without
    features, with the reason.
    """
    photographs = Photographs(image_path, masks)
    impossible = {name: why for name in image_names if (why := photographs.why_impossible(name))}
    usable = [name for name in image_names if name not in impossible]
    reader = pycolmap.ImageReaderOptions()
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
        )
    ids = image_ids(database_path)
    with open_database(database_path) as database:
        failed = [name for name in usable if not database.exists_keypoints(ids[name])]
    return impossible | dict.fromkeys(failed, "COLMAP cannot read it or its mask")


def match_sift(database_path: Path, pairs: Sequence[Pair] | None) -> None:
    """Match pairs of images, or all, by COLMAP's defaults, without verification.

    AffrectError for listed names with spaces, which COLMAP's lists of pairs cannot hold.
    """
    options = pycolmap.FeatureMatchingOptions(skip_geometric_verification=True)
    if pairs is None:
        pycolmap.match_exhaustive(database_path, matching_options=options)
        return
    if spaced := [name for pair in pairs for name in pair if " " in name]:
        raise AffrectError(f"{spaced[0]}: COLMAP matches no listed names with spaces; rename it")
    with temporary_folder(database_path.parent) as folder:
        list_path = folder / "pairs.txt"
        replace_text(list_path, "".join(f"{first} {second}\n" for first, second in pairs))
        pycolmap.match_image_pairs(
            database_path,
            matching_options=options,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=list_path),
        )
