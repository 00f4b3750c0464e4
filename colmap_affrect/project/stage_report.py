"""What a stage reports."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from colmap_affrect.errors import with_arguments, with_flags
from colmap_affrect.options import Summarized, documented
from colmap_affrect.project.image_failures import (
    ImageFailure,
    failures_to_mapping,
    texts_of_failures,
)
from colmap_affrect.project.stage_warnings import StageWarning, texts_by_subject


@documented
@dataclass(frozen=True)
class StageReport(Summarized):
    """One stage of a run."""

    name: str
    """``extract``, ``pairs``, ``match``, ``verify``, ``escalate``, ``guide`` or ``map``."""
    wall_s: float
    """Seconds that it took."""
    num_done: int
    """Images, pairs, cameras or models that were made now."""
    num_kept: int = 0
    """Those that were there already."""
    failed: dict[str, ImageFailure] = field(default_factory=dict)
    """Why images cannot be used, by their names."""
    warned: tuple[StageWarning, ...] = ()
    """What went less well than asked for."""

    @property
    def failures(self) -> dict[str, str]:
        """Why images cannot be used, in words, by their names."""
        return texts_of_failures(self.failed)

    @property
    def warnings(self) -> dict[str, str]:
        """What went less well than asked for, in words, by what it is about."""
        return texts_by_subject(self.warned, with_arguments)

    def to_mapping(self) -> dict[str, Any]:
        """Return what ``report.json`` has of it."""
        failed = failures_to_mapping(self.failed)
        warned = [warning.to_mapping() for warning in self.warned]
        in_words = {
            "failures": texts_of_failures(self.failed, with_flags),
            "warnings": texts_by_subject(self.warned),
        }
        return {**asdict(self), **in_words, "failed": failed, "warned": warned}

    def summary(self) -> str:
        """Return one line."""
        kept = f", {self.num_kept} already there" if self.num_kept else ""
        failed = f", {len(self.failed)} failed" if self.failed else ""
        warned = f", {len(self.warnings)} with a warning" if self.warnings else ""
        return f"{self.name}: {self.num_done} done{kept}{failed}{warned} in {self.wall_s:.1f} s"


def sum_by_stage(reports: Iterable[StageReport]) -> tuple[StageReport, ...]:
    """Return one report of each stage, in the order in which they began: the last, all seconds."""
    found = dict[str, StageReport]()
    for report in reports:
        before = found.get(report.name, replace(report, wall_s=0.0, num_done=0))
        found[report.name] = replace(
            report,
            wall_s=before.wall_s + report.wall_s,
            num_done=before.num_done + report.num_done,
        )
    return tuple(found.values())
