"""The five stages; each skips what is done and leaves its results in the workspace."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.copies import copy_without_features, open_copy
from colmap_affrect.colmap.mapping import map_database, read_models
from colmap_affrect.colmap.verification import verified_pairs, verify
from colmap_affrect.errors import DatabaseError, ImageError, OptionError, StaleStoreError
from colmap_affrect.executor import Executor
from colmap_affrect.extraction import ImageExtractor, Resources, prepare
from colmap_affrect.features.weights import file_sha256
from colmap_affrect.files import replace_text
from colmap_affrect.image_tasks import extract_images
from colmap_affrect.matching.pairs import Pair, exhaustive_pairs, read_pairs, write_pairs
from colmap_affrect.options import (
    CameraOptions,
    ExtractionOptions,
    MappingOptions,
    MaskOptions,
    MatchingOptions,
    PairOptions,
    VerificationOptions,
)
from colmap_affrect.outcomes import ModelSummary, StageReport
from colmap_affrect.pair_selection import (
    NUM_STRONGEST,
    low_resolution_pairs,
    pairs_by_place,
    retrieved_pairs,
)
from colmap_affrect.pair_tasks import MatchableCache, iterate_matches
from colmap_affrect.photographs import (
    Photographs,
    checked_names,
    left_out,
    list_images,
    refuse_colliding_keys,
    refuse_mixed_sizes,
)
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.recipes import Recipe
from colmap_affrect.store import FeatureStore, MatchStore, PairMatches, pair_key
from colmap_affrect.workspace import Workspace

logger = logging.getLogger(__name__)

PAIRS_PER_WRITE = 64
INPUTS = "inputs.sha256"
"""File in sparse/ that names the verified pairs the models were made from."""
MANY_IMAGES = 300
MANY_PAIRS = (
    "all pairs of %d images are %d; --pairs retrieval matches the promising ones only "
    "(see --num-neighbors)"
)


def recorded_images(workspace: Workspace) -> list[str]:
    """Return the names of all images that the extract stage was given."""
    record = workspace.require("extract")
    image_list = Path(record["image_list_path"]) if record["image_list_path"] else None
    database = workspace.database if record["from_database"] else None
    return images_to_use(Path(record["image_path"]), image_list, database)


def images_to_use(
    image_path: Path, image_list_path: Path | None, from_database: Path | None
) -> list[str]:
    """Return the images of a folder, of a list, or of a database; with both, those of the list."""
    if from_database is None:
        return list_images(image_path, image_list_path)
    with open_copy(from_database) as database:
        known = [image.name for image in database.read_all_images()]
    if image_list_path is None:
        return checked_names(image_path, known, str(from_database))
    names = list_images(image_path, image_list_path)
    unknown = sorted(set(names) - set(known))
    if unknown:
        raise ImageError(f"{image_list_path}: lists {unknown[0]}, which {from_database} has not")
    return names


def extract(
    workspace: Workspace,
    image_path: Path,
    recipe: Recipe,
    cameras: CameraOptions,
    *,
    masks: MaskOptions | None = None,
    image_list_path: Path | None = None,
    image_names: Sequence[str] = (),
    from_database: Path | None = None,
    resources: Resources | None = None,
    executor: Executor | None = None,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> StageReport:
    """Extract features of all images and put cameras, images and keypoints into the database.

    An image that cannot be read is reported and passed over. One that cannot be rectified, for
    want of a depth map, is extracted as it is, with a warning.

    Args:
        workspace: where the results go.
        image_path: folder of the images.
        recipe: what to extract.
        cameras: how images share cameras.
        masks: where features may be; everywhere by default.
        image_list_path: list of the images to use; None for all below the folder.
        image_names: the images to look at now, in the place of a list on record.
        from_database: database whose images, cameras, rigs, frames and pose priors are taken
            over; it stays as it is.
        resources: weights and device of networks.
        executor: where images are worked on; by default in threads of this process.
        overwrite: discard the results of this and later stages first.
        progress: where to show progress.
    """
    start = time.perf_counter()
    photographs = Photographs(image_path, cameras, masks or MaskOptions())
    photographs.check()
    names = images_to_use(image_path, image_list_path, from_database)
    if image_names:
        names = checked_names(image_path, image_names, "image_names")
    refuse_colliding_keys(names)
    colmap_database.check_cameras(cameras)
    if from_database and cameras != CameraOptions():
        raise OptionError(
            f"the cameras of {from_database} are used; leave out camera mode, model and parameters"
        )
    if cameras.mode in ("single", "per-folder"):
        known = {} if overwrite else FeatureStore(workspace.features).image_sizes()
        refuse_mixed_sizes(image_path, names, cameras.mode, known)
    extractor = make_extractor(workspace, recipe.extraction, resources, names, progress)
    options = {
        "image_path": str(image_path.resolve()),
        "image_list_path": str(image_list_path.resolve()) if image_list_path else "",
        "from_database": str(from_database.resolve()) if from_database else "",
        "camera": cameras.to_mapping(),
        "masks": photographs.masks.to_mapping(),
        **recipe.extraction.to_mapping(),
        "weights": {path.name: file_sha256(path) for path in extractor.weights.values()},
    }
    workspace.claim("extract", options, overwrite=overwrite, recipe=recipe.name)
    _start_database(workspace)
    store = feature_store(workspace)
    done = store.complete(names)
    missing = [name for name in names if name not in done]
    _refuse_foreign_features(workspace, missing)
    photographs = Photographs.recorded(workspace)
    failures: dict[str, str] = {}
    warnings = {} if image_list_path or image_names or from_database else left_out(image_path)
    for kind, what in warnings.items():
        logger.warning("%s: %s", kind, what)
    with progress.stage("extract", len(missing), "images") as advance:
        images = [(name, 0) for name in missing]
        with closing(extract_images(photographs, extractor, images, executor)) as found_images:
            for name, found in zip(missing, found_images, strict=True):
                if isinstance(found, ImageError):
                    logger.warning("%s", found)
                    failures[name] = str(found)
                else:
                    logger.debug("%s: %d features", name, len(found.features))
                    if not len(found.features):
                        logger.warning("%s: no features (blank or too small?)", name)
                    if found.warning:
                        logger.warning("%s: %s", name, found.warning)
                        warnings[name] = found.warning
                    store.write(name, found.features, found.image_size)
                advance(1)
    if len(failures) == len(names):
        raise ImageError(
            f"{image_path}: none of the {len(names)} images can be used; the first: "
            f"{failures[names[0]]}"
        )
    failures |= write_images_and_keypoints(workspace, store)
    return StageReport(
        "extract",
        time.perf_counter() - start,
        len(set(missing) - set(failures)),
        len(done - set(failures)),
        failures,
        warnings,
    )


def _start_database(workspace: Workspace) -> None:
    """Make the database from the one that the extract stage was given, unless it is there."""
    original = workspace.require("extract")["from_database"]
    if original and not workspace.database.exists():
        copy_without_features(Path(original), workspace.database)


def _refuse_foreign_features(workspace: Workspace, names: Sequence[str]) -> None:
    """Features of another program in a user's database are never replaced in place."""
    if not (workspace.users_database and workspace.database.exists()):
        return
    ids = colmap_database.image_ids(workspace.database)
    with colmap_database.open_database(workspace.database) as database:
        foreign = [n for n in names if n in ids and database.exists_keypoints(ids[n])]
    if foreign:
        raise DatabaseError(
            f"{workspace.database}: has other features of {foreign[0]}; they are not replaced, "
            "start a new database from it (from_database, --from-database)"
        )


def make_extractor(
    workspace: Workspace,
    options: ExtractionOptions,
    resources: Resources | None,
    names: Sequence[str],
    progress: Progress = SILENT,
) -> ImageExtractor:
    """Prepare a recipe for the images of a workspace, which keeps the depth maps of networks."""
    resources = replace(resources or Resources(), depth_cache_path=workspace.depth)
    return prepare(options, resources, names, progress)


def feature_store(workspace: Workspace) -> FeatureStore:
    """Return the features of a workspace; other options than recorded are refused."""
    return FeatureStore(workspace.features, workspace.options_digest("extract"))


def match_store(workspace: Workspace) -> MatchStore:
    """Return the matches of a workspace; other options than recorded are refused."""
    return MatchStore(workspace.matches, workspace.options_digest("extract", "match"))


def write_images_and_keypoints(workspace: Workspace, store: FeatureStore) -> dict[str, str]:
    """Bring the database up to date; return the images that COLMAP does not take, with reasons."""
    _start_database(workspace)
    photographs = Photographs.recorded(workspace)
    names = store.names()
    rejected = colmap_database.import_images(
        workspace.database, photographs.folder, names, photographs.cameras
    )
    ids = colmap_database.image_ids(workspace.database)
    with colmap_database.open_database(workspace.database) as database:
        for name in names:
            if name in ids:
                colmap_database.write_keypoints(
                    database, ids[name], store.read_frames(name), store.level_ends(name)
                )
    reason = f"COLMAP does not take it (camera mode {photographs.cameras.mode})"
    return dict.fromkeys(rejected, reason)


def write_descriptors(workspace: Workspace) -> None:
    """Write the descriptors of all images into the database as COLMAP's matchers take them."""
    features = feature_store(workspace)
    ids = colmap_database.image_ids(workspace.database)
    names = [name for name in features.names() if name in ids]
    counts = features.num_keypoints()
    with colmap_database.open_database(workspace.database) as database:
        written = {name: database.num_descriptors_for_image(ids[name]) for name in names}
        if any(written[name] not in (0, counts[name]) for name in names):
            database.clear_descriptors()  # of before an escalation; COLMAP cannot replace them
            written = dict.fromkeys(names, 0)
        for name in names:
            if counts[name] and not written[name]:
                descriptors = features.read(name).descriptors
                colmap_database.write_descriptors(database, ids[name], descriptors)


def choose_pairs(
    workspace: Workspace,
    options: PairOptions | None = None,
    *,
    match_list_path: Path | None = None,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> StageReport:
    """Write the list of the pairs to match: by default every pair of images, or those of a list.

    When images are added, pairs that were chosen by other options than these stay.

    Args:
        workspace: with features.
        options: how pairs are chosen.
        match_list_path: list of pairs; takes the place of ``exhaustive``.
        overwrite: discard the pairs that are there, and what was made of them, first.
        progress: where to show progress.

    Raises:
        PairListError: when the list cannot be used.
        DatabaseError: when there are no positions to choose by.
        StaleStoreError: when pairs of before are missing in the list, or other options made them.
    """
    start = time.perf_counter()
    options = options or PairOptions()
    pairs = _given_pairs(workspace, options, match_list_path)
    listed = str(match_list_path.resolve()) if match_list_path else ""
    recorded = {"match_list_path": listed, **options.to_mapping()}
    workspace.claim("pairs", recorded, overwrite=overwrite)
    there = _pairs_there(workspace)
    if set(options.methods) == {"exhaustive"}:
        _refuse_lost_pairs(workspace, there - pairs)
    else:
        pairs |= there | _similar_pairs(workspace, options, there, progress)
    write_pairs(workspace.pairs, sorted(pairs))
    return StageReport("pairs", time.perf_counter() - start, len(pairs))


def _given_pairs(
    workspace: Workspace, options: PairOptions, match_list_path: Path | None
) -> set[Pair]:
    """Return the pairs that are chosen without a look at features."""
    workspace.require("extract")
    features = feature_store(workspace)
    names = features.names()
    if "gps" in options.methods:
        write_images_and_keypoints(workspace, features)
    pairs = pairs_by_place(names, workspace.database, options)
    if match_list_path:
        # Images that could not be read may be in the list; only their pairs are dropped.
        known = set(names)
        listed = read_pairs(match_list_path, recorded_images(workspace))
        return pairs | {pair for pair in listed if known.issuperset(pair)}
    if "exhaustive" in options.methods:
        pairs |= set(exhaustive_pairs(names))
        if len(names) > MANY_IMAGES:
            logger.warning(MANY_PAIRS, len(names), len(pairs))
    return pairs


def _similar_pairs(
    workspace: Workspace, options: PairOptions, there: Collection[Pair], progress: Progress
) -> set[Pair]:
    """Return the pairs that features tell; none when no image has come since those there."""
    features = feature_store(workspace)
    names = [name for name, count in features.num_keypoints().items() if count]
    if len(names) < 2 or {name for pair in there for name in pair}.issuperset(names):
        return set()
    pairs: list[Pair] = []
    if "retrieval" in options.methods:
        pairs += retrieved_pairs(names, features.read, options.num_neighbors, progress)
    if "low-resolution" in options.methods:
        matching = MatchingOptions()
        cache = MatchableCache(features, matching, 0, NUM_STRONGEST)
        pairs += low_resolution_pairs(
            names, lambda name: cache[name][0], matching, options.num_neighbors, progress
        )
    return set(pairs)


def add_pairs(workspace: Workspace, pairs: Sequence[Pair]) -> None:
    """Add pairs to those that are matched already, as pycolmap's matchers do."""
    workspace.claim("pairs", {"match_list_path": "", **PairOptions().to_mapping()})
    write_pairs(workspace.pairs, sorted(_pairs_there(workspace).union(pairs)))


def _pairs_there(workspace: Workspace) -> set[Pair]:
    """Return the pairs that were chosen before."""
    there = workspace.pairs.exists() and workspace.pairs.stat().st_size
    return set(listed_pairs(workspace)) if there else set()


def _refuse_lost_pairs(workspace: Workspace, lost: Collection[Pair]) -> None:
    """Pairs may be added, but those that are matched already would stay in the database."""
    if lost:
        raise StaleStoreError(
            f"{workspace.pairs}: has pairs that are not to be matched any more, such as "
            f"{' and '.join(min(lost))}; use --overwrite to redo the pairs stage and those after it"
        )


def match(
    workspace: Workspace,
    options: MatchingOptions,
    *,
    device: str = "auto",
    executor: Executor | None = None,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> StageReport:
    """Match the listed pairs and put the raw matches into the database.

    Args:
        workspace: with features and a list of pairs.
        options: of matching.
        device: ``auto``, ``cpu``, ``cuda``, ``cuda:1``, ``mps``; it changes no result.
        executor: where pairs are matched; by default in threads of this process.
        overwrite: discard the results of this and later stages first.
        progress: where to show progress.
    """
    start = time.perf_counter()
    pairs = listed_pairs(workspace)
    workspace.claim("match", options.to_mapping(), overwrite=overwrite)
    features, matches = feature_store(workspace), match_store(workspace)
    done = matches.complete(pair_key(*pair) for pair in pairs)
    missing = [pair for pair in pairs if pair_key(*pair) not in done]
    with progress.stage("match", len(missing), "pairs") as advance:
        match_pairs(missing, features, matches, options, 0, advance, device, executor)
    _write_matches(workspace, pairs, features, matches)
    return StageReport("match", time.perf_counter() - start, len(missing), len(done))


def match_pairs(
    pairs: Sequence[Pair],
    features: FeatureStore,
    matches: MatchStore,
    options: MatchingOptions,
    level: int,
    advance: Callable[[int], None],
    device: str = "auto",
    executor: Executor | None = None,
) -> None:
    """Match pairs by the features of the images and of one level; what is done is written."""
    batch: list[PairMatches] = []
    try:
        with closing(
            iterate_matches(pairs, features, options, level, device, executor)
        ) as found_pairs:
            for found in found_pairs:
                batch.append(found)
                advance(1)
                if len(batch) == PAIRS_PER_WRITE:
                    matches.write(batch)
                    batch = []
    finally:
        if batch:
            matches.write(batch)


def listed_pairs(workspace: Workspace) -> list[Pair]:
    """Return the pairs of the list whose images have features."""
    workspace.require("pairs")
    names = feature_store(workspace).names()
    return read_pairs(workspace.pairs, names) if len(names) > 1 else []


def _write_matches(
    workspace: Workspace, pairs: Sequence[Pair], features: FeatureStore, matches: MatchStore
) -> None:
    write_images_and_keypoints(workspace, features)
    ids = colmap_database.image_ids(workspace.database)
    pairs = [pair for pair in pairs if pair[0] in ids and pair[1] in ids]
    with colmap_database.open_database(workspace.database) as database:
        for (name1, name2), indices in zip(pairs, read_indices(matches, pairs), strict=True):
            colmap_database.write_matches(database, ids[name1], ids[name2], indices)


def read_indices(matches: MatchStore, pairs: Sequence[Pair]) -> Iterable[NDArray[np.int64]]:
    """Read the (M, 2) matches of each pair; there is no file yet when there are no pairs."""
    return matches.read_indices(pairs) if pairs else []


def verify_matches(
    workspace: Workspace,
    options: VerificationOptions,
    random_seed: int,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> StageReport:
    """Estimate the two-view geometries of all matched pairs."""
    start = time.perf_counter()
    workspace.require("match")
    pairs = listed_pairs(workspace)
    recorded = {**options.to_mapping(), "random_seed": random_seed}
    workspace.claim("verify", recorded, overwrite=overwrite)
    features, matches = feature_store(workspace), match_store(workspace)
    _write_matches(workspace, pairs, features, matches)
    todo = colmap_database.num_unverified_pairs(workspace.database)
    with progress.stage("verify", todo, "pairs") as advance:
        verify_new(workspace, options, random_seed)
        advance(todo)
    return StageReport("verify", time.perf_counter() - start, todo, len(pairs) - todo)


def verify_new(workspace: Workspace, options: VerificationOptions, random_seed: int) -> None:
    """Verify the pairs of the database that have matches and no two-view geometry, good or bad."""
    if colmap_database.num_unverified_pairs(workspace.database):
        verify(workspace.database, options, random_seed)


def map_images(
    workspace: Workspace,
    options: MappingOptions,
    random_seed: int,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> tuple[StageReport, list[ModelSummary]]:
    """Reconstruct; the models are mapped anew only when the verified pairs have changed.

    Args:
        workspace: verified.
        options: with ``mapper_options`` checked (``colmap.mapping.checked_mapping_options``).
        random_seed: seed of all random parts.
        overwrite: discard the models that are there.
        progress: where to show progress.
    """
    start = time.perf_counter()
    workspace.require("verify")
    extracted = workspace.require("extract")
    recorded = {**options.to_mapping(), "random_seed": random_seed}
    workspace.claim("map", recorded, overwrite=overwrite)
    inputs = colmap_database.geometry_digest(workspace.database)
    if (workspace.sparse / INPUTS).exists() and (workspace.sparse / INPUTS).read_text() == inputs:
        models = read_models(workspace.sparse)
        return StageReport("map", time.perf_counter() - start, 0, len(models)), models
    num_images = len(colmap_database.image_ids(workspace.database))
    with progress.stage("map", num_images, "images") as advance:
        models = map_database(
            workspace.database,
            Path(extracted["image_path"]),
            workspace.sparse,
            options,
            random_seed,
            intrinsics_given=intrinsics_given(workspace),
            next_image=advance,
        )
    replace_text(workspace.sparse / INPUTS, inputs)
    return StageReport("map", time.perf_counter() - start, len(models)), models


def intrinsics_given(workspace: Workspace) -> bool:
    """Tell whether the user gave the camera parameters."""
    return bool(workspace.require("extract")["camera"]["params"])


def num_listed_pairs(workspace: Workspace) -> int:
    """Return the number of pairs that were to be matched."""
    return len(listed_pairs(workspace))


def num_verified_pairs(workspace: Workspace, min_num_inliers: int) -> int:
    """Return the number of pairs with a two-view geometry."""
    return len(verified_pairs(workspace.database, min_num_inliers))


def reconstruction_problems(
    workspace: Workspace, names: Sequence[str], registered: Sequence[str], min_num_inliers: int
) -> dict[str, str]:
    """Tell for each image outside the largest model why it is not in it."""
    num_keypoints = feature_store(workspace).num_keypoints()
    ids = colmap_database.image_ids(workspace.database)
    verified = verified_pairs(workspace.database, min_num_inliers)
    in_pairs = {image_id for pair in verified for image_id in pair}
    reasons = {}
    for name in names:
        if name in registered:
            continue
        if name not in num_keypoints or name not in ids:
            reasons[name] = "unreadable"
        elif not num_keypoints[name]:
            reasons[name] = "no features"
        elif ids[name] not in in_pairs:
            reasons[name] = "no verified pair"
        else:
            reasons[name] = "not registered"
    return reasons
