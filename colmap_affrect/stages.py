"""The five stages; each skips what is done and leaves its results in the workspace."""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.copies import copy_without_features, open_copy
from colmap_affrect.colmap.mapping import map_database, read_models
from colmap_affrect.colmap.verification import verified_pairs, verify
from colmap_affrect.errors import DatabaseError, ImageError, OptionError, StaleStoreError
from colmap_affrect.executor import available_cores, map_ordered
from colmap_affrect.extraction import ImageExtractor, Resources, prepare
from colmap_affrect.features.weights import file_sha256
from colmap_affrect.files import replace_text
from colmap_affrect.matching.nearest import MatchableImage, match_features, matchable
from colmap_affrect.matching.pairs import Pair, exhaustive_pairs, read_pairs, write_pairs
from colmap_affrect.options import (
    CameraOptions,
    ExtractionOptions,
    MappingOptions,
    MaskOptions,
    MatchingOptions,
    VerificationOptions,
)
from colmap_affrect.outcomes import ModelSummary, StageReport
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
MATCHING_CACHE_BYTES = 1 << 30


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
        for name in missing:
            try:
                found = photographs.extract(extractor, name)
            except ImageError as error:
                logger.warning("%s", error)
                failures[name] = str(error)
            else:
                logger.debug("%s: %d features", name, len(found.features))
                if not len(found.features):
                    logger.warning("%s: no features (blank or too small?)", name)
                if found.warning:
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
    workspace: Workspace, *, match_list_path: Path | None = None, overwrite: bool = False
) -> StageReport:
    """Write the list of the pairs to match: every pair of images, or those of a list."""
    start = time.perf_counter()
    workspace.require("extract")
    names = feature_store(workspace).names()
    pairs = exhaustive_pairs(names)
    if match_list_path:
        # Images that could not be read may be in the list; only their pairs are dropped.
        usable = set(pairs)
        listed_pairs = read_pairs(match_list_path, recorded_images(workspace))
        pairs = [pair for pair in listed_pairs if pair in usable]
    listed = str(match_list_path.resolve()) if match_list_path else ""
    workspace.claim("pairs", {"match_list_path": listed}, overwrite=overwrite)
    _refuse_lost_pairs(workspace, pairs)
    write_pairs(workspace.pairs, pairs)
    return StageReport("pairs", time.perf_counter() - start, len(pairs))


def add_pairs(workspace: Workspace, pairs: Sequence[Pair]) -> None:
    """Add pairs to those that are matched already, as pycolmap's matchers do."""
    workspace.claim("pairs", {"match_list_path": ""})
    names = feature_store(workspace).names()
    there = read_pairs(workspace.pairs, names) if workspace.pairs.exists() else []
    write_pairs(workspace.pairs, sorted({*there, *pairs}))


def _refuse_lost_pairs(workspace: Workspace, pairs: Sequence[Pair]) -> None:
    """Pairs may be added, but those that are matched already would stay in the database."""
    if not workspace.pairs.exists() or not workspace.pairs.stat().st_size:
        return
    lost = sorted(set(listed_pairs(workspace)) - set(pairs))
    if lost:
        raise StaleStoreError(
            f"{workspace.pairs}: has pairs that are not to be matched any more, such as "
            f"{' and '.join(lost[0])}; use --overwrite to redo the pairs stage and those after it"
        )


def match(
    workspace: Workspace,
    options: MatchingOptions,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> StageReport:
    """Match the listed pairs and put the raw matches into the database."""
    start = time.perf_counter()
    pairs = listed_pairs(workspace)
    workspace.claim("match", options.to_mapping(), overwrite=overwrite)
    features, matches = feature_store(workspace), match_store(workspace)
    done = matches.complete(pair_key(*pair) for pair in pairs)
    missing = [pair for pair in pairs if pair_key(*pair) not in done]
    with progress.stage("match", len(missing), "pairs") as advance:
        match_pairs(missing, features, matches, options, 0, advance)
    _write_matches(workspace, pairs, features, matches)
    return StageReport("match", time.perf_counter() - start, len(missing), len(done))


def match_pairs(
    pairs: Sequence[Pair],
    features: FeatureStore,
    matches: MatchStore,
    options: MatchingOptions,
    level: int,
    advance: Callable[[int], None],
) -> None:
    """Match pairs by the features of the images and of one level; what is done is written."""
    batch: list[PairMatches] = []
    try:
        for found in iterate_matches(pairs, features, options, level):
            batch.append(found)
            advance(1)
            if len(batch) == PAIRS_PER_WRITE:
                matches.write(batch)
                batch = []
    finally:
        if batch:
            matches.write(batch)


def iterate_matches(
    pairs: Sequence[Pair], features: FeatureStore, options: MatchingOptions, level: int
) -> Iterable[PairMatches]:
    """Match pairs by the features of the images themselves and those of one level, in order."""
    cache = MatchableCache(features, options, level)

    def match_pair(pair: Pair) -> PairMatches:
        (first, indices1), (second, indices2) = cache[pair[0]], cache[pair[1]]
        found = match_features(first, second, options)
        rows, columns = found.indices.T
        indices = np.stack([indices1[rows], indices2[columns]], axis=1)
        count = int(indices1.max(initial=-1)) + 1
        return PairMatches(pair, indices, 1.0 - found.ratios, count, level)

    return map_ordered(match_pair, pairs, available_cores())


class MatchableCache:
    """Images ready for matching, the least recently used dropped over a memory budget.

    Each comes with the indices that its features have in the store.
    """

    def __init__(
        self,
        store: FeatureStore,
        options: MatchingOptions,
        level: int,
        max_num_features: int | None = None,
    ) -> None:
        """Name the features.

        Args:
            store: where they are.
            options: of matching.
            level: of escalation; its features come together with those of level 0.
            max_num_features: of the features of an image, those of the largest responses; None
                takes all.
        """
        self._store, self._options, self._level = store, options, level
        self._max_num_features = max_num_features
        self._images: OrderedDict[str, tuple[MatchableImage, NDArray[np.int64]]] = OrderedDict()
        self._lock = threading.Lock()

    def __getitem__(self, name: str) -> tuple[MatchableImage, NDArray[np.int64]]:
        with self._lock:
            if name not in self._images:
                indices = self._store.level_indices(name, self._level)
                features = self._store.read(name).select(indices)
                if self._max_num_features is not None:
                    order = np.argsort(-features.responses, kind="stable")
                    strongest = np.sort(order[: self._max_num_features])
                    indices, features = indices[strongest], features.select(strongest)
                image = matchable(features.descriptors, features.keypoints, self._options)
                self._images[name] = image, indices
            self._images.move_to_end(name)
            while self._num_bytes() > MATCHING_CACHE_BYTES and len(self._images) > 1:
                self._images.popitem(last=False)
            return self._images[name]

    def _num_bytes(self) -> int:
        return sum(image.descriptors.nbytes for image, _ in self._images.values())


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
