"""What a run returns: its report, its models, and how a notebook shows it."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import Any

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import TRUSTED, CameraRecord, read_camera_records
from colmap_affrect.errors import (
    NoModelError,
    Option,
    OptionError,
    Words,
    shown,
    such_as,
)
from colmap_affrect.geometry.lines import LineCamera, LineFindings
from colmap_affrect.mappers.camera_priors import (
    FocalContradiction,
    focal_contradictions,
)
from colmap_affrect.options import documented
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.line_report import LineReport, line_report
from colmap_affrect.project.reasons import text_of
from colmap_affrect.project.report import (
    MAX_LINES,
    SOURCES,
    ModelSummary,
    ReconstructionReport,
    largest_of,
    probability_text,
)
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.photographs import PhotographReport, quality_of
from colmap_affrect.session.context import Context

MAX_ROWS = 200  # photographs in the table of a notebook; report.json has all


@documented
@dataclass(frozen=True, kw_only=True, repr=False)
class RunReport(ReconstructionReport):
    """The report of a run, with the output folder that it is about."""

    output_path: Path
    """Folder of all results."""
    photographs: dict[str, PhotographReport] = field(default_factory=dict)
    """Figures of each photograph, by name."""
    made_from: str = ""
    """Digest of these figures and of the models that they are of."""
    focal_contradictions: tuple[FocalContradiction, ...] = ()
    """Focal lengths of EXIF or the user that straight lines contradict."""

    @property
    def page_path(self) -> Path | None:
        """The page to look at, ``report.html``; None where none was written."""
        page = Workspace(self.output_path).page
        return page if page.is_file() else None

    def reconstruction(self, number: int = 0) -> pycolmap.Reconstruction:
        """Return a model as pycolmap has it.

        Args:
            number: of the model, 0 is the largest; its folder is ``sparse/NUMBER``.

        Returns:
            The model, read from its files anew each time.

        Raises:
            NoModelError: where the run has found none.
            OptionError: for a number that no model has.
        """
        if not self.models:
            raise NoModelError(self.why_no_model)
        if number not in range(len(self.models)):
            raise OptionError(
                f"the models are 0 to {len(self.models) - 1}",
                where=f"number={number!r}",
            )
        return pycolmap.Reconstruction(Workspace(self.output_path).sparse / str(number))

    def to_mapping(self) -> dict[str, Any]:
        """Return the content of ``report.json``."""
        content = super().to_mapping()
        del content["output_path"]  # a folder may be moved
        return content

    def _last_lines(self, said: Callable[[Words], str]) -> list[str]:
        contradictions = self.focal_contradictions[:MAX_LINES]
        return [
            f"lines       {said(contradiction_words(one))}" for one in contradictions
        ]

    def __repr__(self) -> str:
        registered = f"{len(self.registered_names)} of {self.images_total} images"
        where = str(self.output_path)
        state = f"registered={registered!r}, status={self.status!r}"
        return f"RunReport({state}, output_path={where!r})"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: counts, photographs, what to try next."""
        which = "largest model" if len(self.models) > 1 else "model"
        counts = {
            f"photographs in the {which}": f"{len(self.registered_names)} of {self.images_total}",
            "verified pairs": f"{self.num_verified_pairs:,} of {self.num_pairs:,}",
        }
        if self.models:
            model = self.models[0]
            counts |= {
                **{key: f"{num}" for key, num in model.class_counts().items()},
                "points": f"{model.num_points3D:,}",
                "reprojection error": f"{model.mean_reprojection_error_px:.2f} px",
            }
        parts = [
            f"<p><strong>{_text(self._headline())}</strong></p>",
            _table([], [[_text(key), _text(value)] for key, value in counts.items()]),
            self._photographs(),
            *(_advice(one.why, one.command) for one in self.advice),
            f"<p>{self._link()}</p>",
        ]
        return f"<div>{''.join(parts)}</div>"

    def _headline(self) -> str:
        registered = f"{len(self.registered_names)} of {self.images_total} photographs registered"
        return self.why_no_model or registered

    def _photographs(self) -> str:
        """Return a folded table of the photographs and what became of each."""
        rows = []
        model = largest_of(self.models)
        for name in self.registered_names:
            chance = model.probabilities.get(name)
            percent = "" if chance is None else _text(probability_text(chance))
            doubts = (*model.doubtful.get(name, ()), *model.unsure.get(name, ()))
            quality = quality_of(name, model)
            why = f"{quality}: {text_of(doubts)}" if doubts else quality
            rows.append(
                [
                    _text(name),
                    percent,
                    _text(why),
                ]
            )
        rows += [
            [_text(name), "", _text(why.text())]
            for name, why in self.unregistered.items()
        ]
        more = (
            f"<p>and {len(rows) - MAX_ROWS:,} more</p>" if len(rows) > MAX_ROWS else ""
        )
        table = _table(
            ["photograph", "probability", "what became of it"], rows[:MAX_ROWS]
        )
        return f"<details><summary>Photographs</summary>{table}{more}</details>"

    def _link(self) -> str:
        """Return where the page is, as a link where a notebook can follow it."""
        page = self.page_path
        if page is None:
            return f"Results: <code>{_text(str(self.output_path))}</code>"
        relative = os.path.relpath(page)
        # Notebooks show files below their folder only
        if relative.startswith(os.pardir):
            return f"To look at: <code>{_text(str(page))}</code>"
        address = escape(Path(relative).as_posix(), quote=True)
        return f'To look at: <a href="{address}" target="_blank">{_text(relative)}</a>'


def _text(text: str) -> str:
    return escape(shown(text))


def _advice(why: str, command: str) -> str:
    """Return a paragraph on what may help, with the command that does it."""
    code = f"<pre>{_text(command)}</pre>" if command else ""
    return f"<p>Try: {_text(why)}</p>{code}"


def _table(titles: list[str], rows: list[list[str]]) -> str:
    """Return a table of cells that are HTML already."""
    head = "".join(f"<th>{title}</th>" for title in titles)
    lines = [f"<tr>{head}</tr>"] if titles else []
    for row in rows:
        cells = "".join(f'<td style="text-align: left">{cell}</td>' for cell in row)
        lines.append(f"<tr>{cells}</tr>")
    return f"<table>{''.join(lines)}</table>"


def cameras_of_report(
    workspace: Workspace, models: Sequence[ModelSummary], before: Sequence[str]
) -> tuple[dict[str, Any], ...]:
    """Return what a report has of the cameras, as the largest model has them.

    Args:
        workspace: with the record of the cameras.
        models: the largest first.
        before: names of the images of the model that was extended.
    """
    largest = models[0] if models else None
    found = list[dict[str, Any]]()
    for camera_id, record in read_camera_records(workspace.cameras).items():
        found.append(_extended(record, before).to_report(camera_id, largest))
    return tuple(found)


def lines_of_report(
    features: FeatureStore, lines: Mapping[str, LineFindings]
) -> dict[str, LineReport]:
    """Return what straight lines say of photographs.

    Args:
        features: of the run.
        lines: of the photographs.
    """
    sizes = features.image_sizes()
    return {name: line_report(found, sizes[name]) for name, found in lines.items()}


def contradictions_of_report(
    context: Context, lines: Mapping[str, LineFindings]
) -> tuple[FocalContradiction, ...]:
    """Return the focal lengths of EXIF and of the user that straight lines contradict.

    Args:
        context: of the run.
        lines: of its photographs.
    """
    records = read_camera_records(context.workspace.cameras)
    line_cameras = dict[str, LineCamera]()
    for record in records.values():
        if record.source not in TRUSTED:
            continue
        for name in record.names:
            by_lines = lines[name].camera if name in lines else None
            if by_lines is not None:
                line_cameras[name] = by_lines
    cameras = {}
    for camera in context.graph.cameras.values():
        cameras[camera.camera_id] = camera
    return tuple(focal_contradictions(cameras.values(), records, line_cameras))


def contradiction_words(found: FocalContradiction) -> Words:
    """Say what lines contradict, and what helps."""
    is_given = found.source == "given"
    remedy: Words = (Option("ignore-exif"), " leaves it out")
    if is_given:
        remedy = (Option("cameras-path"), " takes another one")
    source = "given" if is_given else SOURCES.get(found.source, found.source)
    differs = (
        f"{such_as(found.names)}: the focal length {source} is {found.said_px:,.0f} px, straight "
        f"lines tell {found.lines_px:,.0f} px +-{found.lines_sigma:.0%}; "
    )
    return (differs, remedy)


def _extended(record: CameraRecord, before: Sequence[str]) -> CameraRecord:
    """Say of a camera that nobody knew but the model that is extended that it is from there."""
    is_known = record.source == "guess" and not set(before).isdisjoint(record.names)
    return replace(record, source="model", lens_mm=0.0) if is_known else record
