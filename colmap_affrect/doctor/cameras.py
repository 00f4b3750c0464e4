"""Examines the cameras of a COLMAP database: are they plausible, and do the pairs agree?"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from colmap_affrect.colmap.camera_records import CameraRecord
from colmap_affrect.colmap.camera_vote import (
    MIN_LOG_EVIDENCE,
    VotingPair,
    log_evidence_for_sharing,
    voting_pairs,
)
from colmap_affrect.colmap.database import open_database
from colmap_affrect.doctor.findings import Findings
from colmap_affrect.geometry.focal_evidence import log_evidence
from colmap_affrect.geometry.focal_vote import FOCALS, MAX_VOTE, FocalEstimate, ballot, count
from colmap_affrect.images.exif import PLAUSIBLE_FOCALS
from colmap_affrect.shown import such_as

MAX_NUM_PAIRS = 48
"""The strongest pairs that are asked, some seconds' worth."""

MAX_SPREAD = 2.5
"""Ratio of the ends of an interval beyond which pairs say too little to contradict; without them
it is the usual lenses, 7."""

MAX_DIFFERENCE = 1.15
"""How far beyond an interval a focal length still is right, half of the interval if that is more:
mapping refines them, and pairs are a little wrong."""


def examine_cameras(findings: Findings, path: Path, copy: Path) -> None:
    """Add what is found out about cameras.

    Args:
        findings: to be added to.
        path: of the database, as it is called.
        copy: of the database, free of errors.
    """
    with open_database(copy) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        images: dict[int, list[int]] = defaultdict(list)
        for image in database.read_all_images():
            images[image.camera_id].append(image.image_id)
        cameras = {
            camera.camera_id: camera
            for camera in database.read_all_cameras()
            if camera.camera_id in images and len(camera.focal_length_idxs())
        }
    records = {
        key: CameraRecord(
            tuple(sorted(names[image_id] for image_id in images[key])),
            "given" if camera.has_prior_focal_length else "guess",
            float(camera.mean_focal_length()),
            size=(camera.width, camera.height),
        )
        for key, camera in cameras.items()
    }
    examination = _Examination(findings, path, records)
    examination.plausible()
    examination.pairs = voting_pairs(copy, set(cameras), None)[:MAX_NUM_PAIRS]
    contradicted = examination.contradicted()
    examination.not_shared()
    for key, same in images.items():
        if key in contradicted or (key in records and records[key].source == "guess"):
            examination.shared(key, same)


class _Examination:
    """Examines cameras by the votes of pairs.

    Attributes:
        pairs: that vote.
    """

    def __init__(self, findings: Findings, path: Path, records: Mapping[int, CameraRecord]) -> None:
        self._findings, self._path, self._records = findings, path, records
        self.pairs: Sequence[VotingPair] = []

    def _add(self, kind: str, items: Sequence[str]) -> None:
        if items:
            self._findings.add(kind, self._path, items)

    def plausible(self) -> None:
        """Find focal lengths that no photograph has."""
        low, high = PLAUSIBLE_FOCALS
        items = []
        for record in self._records.values():
            focal = record.focal_px / max(record.size)
            if not low <= focal <= high:
                items.append(f"{such_as(record.names, 1)}: {record.focal_px:.0f} px, {focal:.2g}")
        self._add("implausible-focal", items)

    def contradicted(self) -> set[int]:
        """Find priors that pairs contradict, each as if the others were right."""
        focals = {
            key: record.focal_px / max(record.size)
            for key, record in self._records.items()
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
                record, longer = self._records[key], max(self._records[key].size)
                low, high = estimate.low * longer, estimate.high * longer
                focal = f"{record.focal_px:.0f}, not {low:.0f} to {high:.0f}"
                items.append(f"{such_as(record.names, 1)}: {focal}")
                found.add(key)
        self._add("contradicted-focal", items)
        return found

    def not_shared(self) -> None:
        """Find cameras of one size that nobody knows and that are one by the votes of pairs."""
        unknown = {key: r for key, r in self._records.items() if r.source == "guess"}
        same: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for key, record in unknown.items():
            same[tuple(sorted(record.size))].append(key)
        for keys in same.values():
            difference = log_evidence_for_sharing(self.pairs, keys) if len(keys) > 1 else None
            if difference is not None and difference >= MIN_LOG_EVIDENCE:
                names = [name for key in keys for name in self._records[key].names]
                self._add("cameras-not-shared", sorted(names))

    def shared(self, camera_id: int, images: Sequence[int]) -> None:
        """Find out whether the images of a camera are rather by many."""
        if len(images) < 2:
            return
        pairs = [replace(p, cameras=p.images) for p in self.pairs if set(p.cameras) == {camera_id}]
        difference = log_evidence_for_sharing(pairs, images)
        if difference is not None and -difference >= MIN_LOG_EVIDENCE:
            self._add("cameras-shared", self._records[camera_id].names)


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
