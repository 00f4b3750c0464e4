"""Examines the cameras of a COLMAP database: are they plausible, and do the pairs agree?"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from colmap_affrect.colmap.camera_records import CameraRecord
from colmap_affrect.colmap.camera_vote import (
    MIN_LOG_EVIDENCE,
    CameraVote,
    VotingPair,
    log_evidence_for_sharing,
    voting_pairs,
)
from colmap_affrect.colmap.database import open_database
from colmap_affrect.doctor.findings import Findings
from colmap_affrect.geometry.focal_evidence import fits
from colmap_affrect.images.exif import PLAUSIBLE_FOCALS
from colmap_affrect.parallel.executor import available_cores, map_ordered

MAX_NUM_PAIRS = 48
"""The strongest pairs that are asked, some seconds' worth."""

MAX_DIFFERENCE = 1.15
"""How far beyond what pairs say a focal length is called contradicted; models move it so far."""

MIN_CONTRADICTING = 0.5
"""Share of the pairs of a camera that its focal length does not fit; some pairs are wrong."""


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
                items.append(f"{_who(record)}: {record.focal_px:.0f} px, {focal:.2g}")
        self._add("implausible-focal", items)

    def contradicted(self) -> set[int]:
        """Find priors that pairs do not fit while they agree on another focal length."""
        focals = {
            key: record.focal_px / max(record.size)
            for key, record in self._records.items()
            if record.source == "given"
        }
        known = [pair for pair in self.pairs if set(pair.cameras) <= set(focals)]

        def is_explained(pair: VotingPair) -> bool:
            return fits(pair.matched, focals[pair.cameras[0]], focals[pair.cameras[1]])

        votes: dict[int, list[bool]] = defaultdict(list)
        explained = map_ordered(is_explained, known, available_cores())
        for pair, is_good in zip(known, explained, strict=True):
            for camera in set(pair.cameras):
                votes[camera].append(is_good)
        doubted = {
            key for key, good in votes.items() if good.count(False) >= MIN_CONTRADICTING * len(good)
        }
        if not doubted:
            return set()
        asked = {
            key: replace(record, source="guess") if key in doubted else record
            for key, record in self._records.items()
            if key in doubted | set(focals)
        }
        pairs = [pair for pair in self.pairs if set(pair.cameras) <= set(asked)]
        items, found = [], set()
        for key, record in CameraVote(asked, pairs, may_share=False).decide().items():
            prior = self._records[key].focal_px
            low, high = record.low_px or 0.0, record.high_px or float("inf")
            if record.source == "pairs" and not (
                low / MAX_DIFFERENCE <= prior <= high * MAX_DIFFERENCE
            ):
                items.append(f"{_who(record)}: {prior:.0f}, not {low:.0f} to {high:.0f}")
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


def _who(record: CameraRecord) -> str:
    more = f" and {len(record.names) - 1} more" if len(record.names) > 1 else ""
    return f"{record.names[0]}{more}"
