"""Examines a COLMAP database, in a copy: its tables, and whether pairs agree with its cameras."""

import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_affrect.colmap.camera_records import CameraRecord
from colmap_affrect.colmap.camera_vote import (
    MIN_LOG_EVIDENCE,
    VotingPair,
    log_evidence_for_sharing,
    voting_pairs,
)
from colmap_affrect.colmap.checks import CHECKS, check_database, check_image_files
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.database_copy import (
    copy_as_it_is,
    is_stamped,
    newest_schema_version,
    schema_version,
)
from colmap_affrect.colmap.tables import Tables
from colmap_affrect.doctor.findings import Findings, without_path
from colmap_affrect.errors import DatabaseError
from colmap_affrect.geometry.focal_evidence import log_evidence
from colmap_affrect.geometry.focal_vote import FOCALS, MAX_VOTE, FocalEstimate, ballot, count
from colmap_affrect.images.exif import PLAUSIBLE_FOCALS
from colmap_affrect.images.reading import readable_size
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.progress import Progress
from colmap_affrect.project.outputs import leads_outside
from colmap_affrect.shown import such_as

MAX_NUM_PAIRS = 48  # the strongest pairs that are asked, some seconds' worth
MAX_SPREAD = 2.5
"""Ratio of the ends of an interval beyond which pairs say too little to contradict; without them
it is the usual lenses, 7."""

MAX_DIFFERENCE = 1.15
"""How far beyond an interval a focal length still is right, half of the interval if that is more:
mapping refines them, and pairs are a little wrong."""


def examine_cameras(findings: Findings, path: Path, copy: Path) -> None:
    """Add what is found out about cameras of a database called ``path``, by a copy without errors.

    Focal lengths that no photograph has are found without asking pairs.
    """
    images: dict[int, list[int]] = defaultdict(list)
    with open_database(copy) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        for image in database.read_all_images():
            images[image.camera_id].append(image.image_id)
        cameras = database.read_all_cameras()
    records = {
        camera.camera_id: CameraRecord(
            tuple(sorted(names[image_id] for image_id in images[camera.camera_id])),
            "given" if camera.has_prior_focal_length else "guess",
            float(camera.mean_focal_length()),
            size=(camera.width, camera.height),
        )
        for camera in cameras
        if camera.camera_id in images and len(camera.focal_length_idxs())
    }
    implausible = []
    for record in records.values():
        focal, (low, high) = record.focal_px / max(record.size), PLAUSIBLE_FOCALS
        if not low <= focal <= high:
            implausible.append(f"{such_as(record.names, 1)}: {record.focal_px:.0f} px, {focal:.2g}")
    pairs = voting_pairs(copy, set(records), None)[:MAX_NUM_PAIRS]
    examination = _Examination(findings, path, records, pairs)
    examination.add("implausible-focal", implausible)
    contradicted = examination.contradicted()
    examination.not_shared()
    for key, same in images.items():
        if key in contradicted or (key in records and records[key].source == "guess"):
            examination.shared(key, same)


@dataclass(frozen=True)
class _Examination:
    """Examines the cameras of a database by the votes of pairs."""

    findings: Findings
    path: Path
    records: Mapping[int, CameraRecord]
    pairs: Sequence[VotingPair]

    def add(self, kind: str, items: Sequence[str]) -> None:
        if items:
            self.findings.add(kind, self.path, items)

    def contradicted(self) -> set[int]:
        """Find priors that pairs contradict, each as if the others were right."""
        focals = {
            key: record.focal_px / max(record.size)
            for key, record in self.records.items()
            if record.source == "given"
        }
        items, found = [], set()
        for key, prior in focals.items():
            pairs = [p for p in self.pairs if key in p.cameras and set(p.cameras) <= set(focals)]
            if sum(_doubt(pair, key, focals) for pair in pairs) < MIN_LOG_EVIDENCE:
                continue
            others = {other: focal for other, focal in focals.items() if other != key}
            ballots = [ballot(pair.matched, pair.cameras, others) for pair in pairs]
            estimate = count([item for item in ballots if item], [key]).estimates[key]
            if _contradicts(estimate, prior):
                record, longer = self.records[key], max(self.records[key].size)
                low, high = estimate.low * longer, estimate.high * longer
                focal = f"{record.focal_px:.0f}, not {low:.0f} to {high:.0f}"
                items.append(f"{such_as(record.names, 1)}: {focal}")
                found.add(key)
        self.add("contradicted-focal", items)
        return found

    def not_shared(self) -> None:
        """Find cameras of one size that nobody knows and that are one by the votes of pairs."""
        unknown = {key: r for key, r in self.records.items() if r.source == "guess"}
        same: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for key, record in unknown.items():
            same[tuple(sorted(record.size))].append(key)
        for keys in same.values():
            difference = log_evidence_for_sharing(self.pairs, keys) if len(keys) > 1 else None
            if difference is not None and difference >= MIN_LOG_EVIDENCE:
                names = [name for key in keys for name in self.records[key].names]
                self.add("cameras-not-shared", sorted(names))

    def shared(self, camera_id: int, images: Sequence[int]) -> None:
        """Find out whether the images of a camera are rather by many."""
        if len(images) < 2:
            return
        pairs = [replace(p, cameras=p.images) for p in self.pairs if set(p.cameras) == {camera_id}]
        difference = log_evidence_for_sharing(pairs, images)
        if difference is not None and -difference >= MIN_LOG_EVIDENCE:
            self.add("cameras-shared", self.records[camera_id].names)


def _doubt(pair: VotingPair, key: int, focals: Mapping[int, float]) -> float:
    """Return by how much some focal length of a camera is more likely than what is known of it."""
    asked = np.append(focals[key], FOCALS[::8])
    first, second = (
        asked if camera == key else np.full_like(asked, focals[camera]) for camera in pair.cameras
    )
    return float(min(MAX_VOTE, -log_evidence(pair.matched, first, second)[0]))


def _contradicts(estimate: FocalEstimate, focal: float) -> bool:
    beyond = max(estimate.low / focal, focal / estimate.high)
    return estimate.spread <= MAX_SPREAD and beyond > max(MAX_DIFFERENCE, estimate.spread**0.5)


def examine_database(findings: Findings, path: Path, image_path: Path | None) -> None:
    """Examine a COLMAP database, and its photographs if their folder is given."""
    with examined_copy(findings, path, image_path, {}):
        pass


@contextmanager
def examined_copy(
    findings: Findings, path: Path, image_path: Path | None, own_advice: Mapping[str, str]
) -> Iterator[tuple[Path, Tables] | None]:
    """Examine a copy of a database and yield it with its tables, None if it cannot be used.

    The sizes of photographs are compared if their folder is given; ``own_advice`` says what to do
    about a problem by its kind, where it is not what ``TEXTS`` says.
    """
    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary) / "database.db"
        try:
            version, newest = schema_version(path), newest_schema_version()
            copy_as_it_is(path, copy)
        except DatabaseError as error:
            message = without_path(path, error).replace(str(copy), "a temporary file")
            findings.add("no-database", path, error=message)
            yield None
            return
        if version < newest:
            kind = "stamped" if is_stamped(path) else "old-schema"
            kept = path.with_suffix(".old.db")
            findings.add(kind, path, version=version, newest=newest, path=path, copy=kept)
        try:
            tables, problems = check_database(copy)
        except DatabaseError as error:
            findings.add("database-damaged", path, error=without_path(copy, error))
            yield None
            return
        findings.checked.append(f"{path}: {tables.summary()}")
        if image_path is not None:
            sizes = _file_sizes(image_path, tables.names.values(), findings.progress)
            problems |= check_image_files(tables, image_path, sizes)
            findings.checked.append(f"{image_path}: sizes of {len(sizes)} photographs")
        for kind in sorted(problems, key=list(CHECKS).index):
            advice = own_advice.get(kind, "")
            findings.add(kind, path, problems[kind], advice=advice, path=path, folder=path.parent)
        if not any(CHECKS[kind][0] == "error" for kind in problems):
            examine_cameras(findings, path, copy)
        yield copy, tables


def _file_sizes(
    image_path: Path, names: Iterable[str], progress: Progress
) -> dict[str, tuple[int, int] | None]:
    """Read photographs for their (width, height), None for those that cannot be read."""
    present = [n for n in names if not leads_outside(n) and (image_path / n).is_file()]
    sizes = {}
    with progress.stage("read", len(present), "images") as advance:
        paths = (image_path / name for name in present)
        found = map_ordered(readable_size, paths, available_cores())
        for name, size in zip(present, found, strict=True):
            sizes[name] = size
            advance(1)
    return sizes
