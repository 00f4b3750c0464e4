"""The five stages; each skips what is done and leaves its results in the workspace."""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.mapping import map_incrementally, read_models
from colmap_affrect.colmap.verification import verified_pairs, verify
from colmap_affrect.errors import ImageError, OptionError, StaleStoreError, StoreError
from colmap_affrect.executor import available_cores, map_ordered
from colmap_affrect.extraction import ImageExtractor, Resources, prepare
from colmap_affrect.features.weights import file_sha256
from colmap_affrect.imaging import IMAGE_SUFFIXES, read_gray
from colmap_affrect.matching.nearest import MatchableImage, match_features, matchable
from colmap_affrect.matching.pairs import Pair, exhaustive_pairs, read_pairs, write_pairs
from colmap_affrect.options import (
    CameraOptions,
    ExtractionOptions,
    MappingOptions,
    MatchingOptions,
    VerificationOptions,
)
from colmap_affrect.outcomes import ModelSummary, StageReport
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.recipes import Recipe
from colmap_affrect.store import FeatureStore, MatchStore, PairMatches, pair_key
from colmap_affrect.workspace import Workspace

logger = logging.getLogger(__name__)

PAIRS_PER_WRITE = 64
INPUTS = "inputs.sha256"
"""File in sparse/ that names the verified pairs the models were made from."""
MATCHING_CACHE_BYTES = 1 << 30


def list_images(image_path: Path, image_list_path: Path | None = None) -> list[str]:
    """Return the sorted names, relative to ``image_path``, of all images or of those listed.

    Folders are searched through; hidden ones and files of other formats are passed over.

    Raises:
        ImageError: when there are none, or a listed one is missing.
    """
    if not image_path.is_dir():
        raise ImageError(f"{image_path}: no such folder; give the folder of the photographs")
    if image_list_path is not None:
        return _listed_images(image_path, image_list_path)
    paths = (path.relative_to(image_path) for path in image_path.rglob("*"))
    names = sorted(
        path.as_posix()
        for path in paths
        if path.suffix.lower() in IMAGE_SUFFIXES
        and not any(part.startswith(".") for part in path.parts)
        and not (image_path / path).is_dir()
    )
    if not names:
        raise ImageError(f"{image_path}: holds no images ({', '.join(IMAGE_SUFFIXES)})")
    for name in names:
        if name != name.encode("utf-8", "replace").decode("utf-8"):
            raise ImageError(f"{image_path}: the name {name!r} is not UTF-8; rename it")
    return names


def _listed_images(image_path: Path, image_list_path: Path) -> list[str]:
    try:
        lines = image_list_path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ImageError(f"{image_list_path}: cannot be read ({error})") from error
    listed = (line.strip() for line in lines if line.strip() and not line.startswith("#"))
    names = sorted({PurePosixPath(name).as_posix() for name in listed})
    missing = [name for name in names if not _is_below(image_path, name)]
    if missing or not names:
        what = f"lists {missing[0]}, which is not in {image_path}" if missing else "is empty"
        raise ImageError(f"{image_list_path}: {what}")
    return names


def recorded_images(workspace: Workspace) -> list[str]:
    """Return the names of all images that the extract stage was given."""
    record = workspace.require("extract")
    image_list = Path(record["image_list_path"]) if record["image_list_path"] else None
    return list_images(Path(record["image_path"]), image_list)


def _is_below(image_path: Path, name: str) -> bool:
    inside = ".." not in PurePosixPath(name).parts and not name.startswith("/")
    return inside and (image_path / name).is_file()


def extract(
    workspace: Workspace,
    image_path: Path,
    recipe: Recipe,
    cameras: CameraOptions,
    *,
    image_list_path: Path | None = None,
    resources: Resources | None = None,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> StageReport:
    """Extract features of all images and put cameras, images and keypoints into the database.

    An image that cannot be read is reported and passed over. One that cannot be rectified, for
    want of a depth map, is extracted as it is, with a warning.
    """
    start = time.perf_counter()
    names = list_images(image_path, image_list_path)
    _refuse_colliding_keys(names)
    colmap_database.check_cameras(cameras)
    if cameras.mode in ("single", "per-folder"):
        known = {} if overwrite else FeatureStore(workspace.features).image_sizes()
        _refuse_mixed_sizes(image_path, names, cameras.mode, known)
    extractor = make_extractor(workspace, recipe.extraction, resources, names, progress)
    options = {
        "image_path": str(image_path.resolve()),
        "image_list_path": str(image_list_path.resolve()) if image_list_path else "",
        "camera": cameras.to_mapping(),
        **recipe.extraction.to_mapping(),
        "weights": {path.name: file_sha256(path) for path in extractor.weights.values()},
    }
    workspace.claim("extract", options, overwrite=overwrite, recipe=recipe.name)
    store = feature_store(workspace)
    done = store.complete(names)
    missing = [name for name in names if name not in done]
    failures, warnings = {}, {}
    with progress.stage("extract", len(missing), "images") as advance:
        for name in missing:
            try:
                found = extractor.extract_file(
                    image_path / name, name, intrinsics(image_path / name, extractor, cameras)
                )
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
        raise ImageError(f"{image_path}: none of the {len(names)} images can be read")
    failures |= write_images_and_keypoints(workspace, store)
    return StageReport(
        "extract",
        time.perf_counter() - start,
        len(set(missing) - set(failures)),
        len(done - set(failures)),
        failures,
        warnings,
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


def intrinsics(
    path: Path, extractor: ImageExtractor, cameras: CameraOptions
) -> NDArray[np.float64] | None:
    """Return the camera matrix of an image file if its rectification depends on it."""
    if not any(rectifier.uses_depth for rectifier in extractor.options.rectifiers):
        return None
    return colmap_database.read_camera_matrix(path, cameras)


def feature_store(workspace: Workspace) -> FeatureStore:
    """Return the features of a workspace; other options than recorded are refused."""
    return FeatureStore(workspace.features, workspace.options_digest("extract"))


def match_store(workspace: Workspace) -> MatchStore:
    """Return the matches of a workspace; other options than recorded are refused."""
    return MatchStore(workspace.matches, workspace.options_digest("extract", "match"))


def _refuse_colliding_keys(names: Sequence[str]) -> None:
    """Hloc's pair keys turn '/' into '-': two names must not become the same."""
    seen: dict[str, str] = {}
    for name in names:
        other = seen.setdefault(pair_key(name, ""), name)
        if other != name:
            raise StoreError(
                f"{other} and {name} have the same key in hloc's match files, where '/' becomes "
                "'-'; rename one of them"
            )


def _refuse_mixed_sizes(
    image_path: Path, names: Sequence[str], mode: str, known: Mapping[str, tuple[int, int]]
) -> None:
    """COLMAP leaves out images of another size than the first one that shares their camera."""

    def size_of(name: str) -> tuple[int, int] | None:
        try:
            return known.get(name) or read_gray(image_path / name).shape[::-1]
        except ImageError:
            return None

    first: dict[PurePosixPath, tuple[str, tuple[int, int]]] = {}
    for name, size in zip(names, map_ordered(size_of, names, available_cores()), strict=True):
        if size is None:
            continue
        folder = PurePosixPath(name).parent if mode == "per-folder" else PurePosixPath()
        other, expected = first.setdefault(folder, (name, size))
        if size != expected:
            raise OptionError(
                f"--camera-mode {mode}: {other} is {expected[0]} x {expected[1]} px, {name} is "
                f"{size[0]} x {size[1]} px; images that share a camera must have one size"
            )


def write_images_and_keypoints(workspace: Workspace, store: FeatureStore) -> dict[str, str]:
    """Bring the database up to date; return the images that COLMAP does not take, with reasons."""
    record = workspace.require("extract")
    cameras = CameraOptions.from_mapping(record["camera"], str(workspace.config))
    names = store.names()
    rejected = colmap_database.import_images(
        workspace.database, Path(record["image_path"]), names, cameras
    )
    ids = colmap_database.image_ids(workspace.database)
    with colmap_database.open_database(workspace.database) as database:
        for name in names:
            if name in ids:
                colmap_database.write_keypoints(
                    database, ids[name], store.read_frames(name), store.level_ends(name)
                )
    return dict.fromkeys(rejected, f"COLMAP does not take it (camera mode {cameras.mode})")


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
    cache = _MatchableCache(features, options, level)

    def match_pair(pair: Pair) -> PairMatches:
        (first, indices1), (second, indices2) = cache[pair[0]], cache[pair[1]]
        found = match_features(first, second, options)
        rows, columns = found.indices.T
        indices = np.stack([indices1[rows], indices2[columns]], axis=1)
        count = int(indices1.max(initial=-1)) + 1
        return PairMatches(pair, indices, 1.0 - found.ratios, count, level)

    return map_ordered(match_pair, pairs, available_cores())


class _MatchableCache:
    """Images ready for matching, the least recently used dropped over a memory budget.

    Each comes with the indices that its features have in the store.
    """

    def __init__(self, store: FeatureStore, options: MatchingOptions, level: int) -> None:
        self._store, self._options, self._level = store, options, level
        self._images: OrderedDict[str, tuple[MatchableImage, NDArray[np.int64]]] = OrderedDict()
        self._lock = threading.Lock()

    def __getitem__(self, name: str) -> tuple[MatchableImage, NDArray[np.int64]]:
        with self._lock:
            if name not in self._images:
                indices = self._store.level_indices(name, self._level)
                features = self._store.read(name).select(indices)
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
    """Reconstruct; the models are mapped anew only when the verified pairs have changed."""
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
        models = map_incrementally(
            workspace.database,
            Path(extracted["image_path"]),
            workspace.sparse,
            options,
            random_seed,
            intrinsics_given=bool(extracted["camera"]["params"]),
            next_image=advance,
        )
    (workspace.sparse / INPUTS).write_text(inputs)
    return StageReport("map", time.perf_counter() - start, len(models)), models


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
