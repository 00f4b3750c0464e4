"""What a run ends with: ``report.json`` and ``report.html``, from the models that mapping made."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from colmap_affrect.colmap.by_hand import Marks
from colmap_affrect.colmap.database import num_matched_pairs
from colmap_affrect.escalation.summary import escalation_summary
from colmap_affrect.geometry.lines import LineFindings
from colmap_affrect.mappers.base import MapperOptions
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.report import ModelSummary, installed_versions
from colmap_affrect.project.stage_report import StageReport, sum_by_stage
from colmap_affrect.report.advice import (
    advice,
    command_with_masks,
    command_with_tie_points,
)
from colmap_affrect.report.kept_figures import figures_digest, kept_figures, models_key
from colmap_affrect.report.observations import ModelReader
from colmap_affrect.report.page_key import is_current, page_key
from colmap_affrect.report.pair_lines import LinesOfRun
from colmap_affrect.report.pair_matches import PairReader
from colmap_affrect.report.pairs import draw_pairs_to_check
from colmap_affrect.report.photographs import photographs_of_report
from colmap_affrect.report.run_page import RunContent, write_run_page
from colmap_affrect.report.run_report import (
    RunReport,
    cameras_of_report,
    contradictions_of_report,
    lines_of_report,
)
from colmap_affrect.session.context import Context
from colmap_affrect.stages.guide import guided_counts
from colmap_affrect.stages.map import unregistered


@dataclass(frozen=True)
class MappingResult:
    """What mapping was given, and what it made."""

    options: MapperOptions  # of the mapper
    names: Sequence[str]  # of all photographs
    extended: Sequence[str]  # photographs of the model that was extended, if any
    marks: Marks  # tie points by hand
    models: Sequence[ModelSummary]  # the largest first
    stages: Sequence[StageReport]  # all of the run, in their order


def write_results(context: Context, result: MappingResult, *, page: bool) -> RunReport:
    """Write ``report.json`` and, if wanted, ``report.html``.

    Args:
        context: of the workspace, with its models.
        result: of mapping.
        page: also write ``report.html``; one that was made from the same stays.

    Returns:
        The report that is also written to ``report.json``.
    """
    workspace = context.workspace
    verified = context.num_verified_inliers().items()
    by_hand = context.by_hand
    pair_inliers = {pair: num for pair, num in verified if by_hand.allows(*pair)}
    models = ModelReader(workspace.sparse)
    report = _report(context, result, models, num_inliers=pair_inliers)
    commands = command_with_tie_points(context), command_with_masks(context)
    key = page_key(workspace, report, result.names, result.marks, commands)
    keeps_page = page and is_current(workspace, key)
    if not keeps_page:
        workspace.remove_page()  # a kill leaves none beside another report
    replace_text(workspace.report, report.to_json())
    if page and not keeps_page:
        content = _page_content(context, result, report, models, pair_inliers)
        content = replace(
            content, key=key, marks_command=commands[0], masks_command=commands[1]
        )
        write_run_page(workspace, report, content, context.progress)
    if not workspace.is_foreign:
        context.features.keep_summaries()
    return report


def _report(
    context: Context,
    result: MappingResult,
    models: ModelReader,
    num_inliers: Mapping[Pair, int],
) -> RunReport:
    """Return the report of a run.

    Args:
        context: of the workspace, with its models.
        result: of mapping.
        models: reads the models.
        num_inliers: of the verified pairs.
    """
    workspace = context.workspace
    missing = unregistered(context, result.names, result.models, num_inliers)
    cameras = cameras_of_report(workspace, result.models, result.extended)
    line_findings = _line_findings(context, result.names)
    lines = lines_of_report(context.features, line_findings)
    escalated = escalation_summary(context)
    escalates = escalated.matched_again or escalated.untried
    focal_contradictions = contradictions_of_report(context, line_findings)
    key = models_key(workspace.sparse, len(result.models))
    photographs = photographs_of_report(
        models,
        result.names,
        result.models,
        cameras,
        lines,
        kept=kept_figures(workspace.report, key),
    )
    return RunReport(
        output_path=workspace.path,
        images_total=len(result.names),
        unregistered=missing,
        models=tuple(result.models),
        num_verified_pairs=len(num_inliers),
        stages=sum_by_stage(result.stages),
        versions=installed_versions(),
        preset=result.options.preset_name,
        verification=context.verification.to_mapping(),
        mapping=result.options.to_mapping(),
        cameras=cameras,
        lines=lines,
        photographs=photographs,
        # Figures that lack a model are counted again by the next command.
        made_from=figures_digest("" if models.unreadable else key, photographs),
        focal_contradictions=focal_contradictions,
        extended=tuple(result.extended),
        advice=advice(
            context,
            missing,
            result.models,
            max(num_inliers.values(), default=0),
            escalated.untried,
            escalated.effort,
            focal_contradictions,
        ),
        by_hand=context.by_hand.texts(),
        effort=escalated.effort if escalates else "",
        matched_again=escalated.matched_again,
        untried=escalated.untried,
        **_own_results(context),
    )


def _line_findings(context: Context, names: Sequence[str]) -> dict[str, LineFindings]:
    """Return what the straight lines of photographs say, in the order of the names."""
    if context.workspace.is_foreign:
        return {}
    known = context.features.line_findings()
    return {name: known[name] for name in names if name in known}


def _page_content(
    context: Context,
    result: MappingResult,
    report: RunReport,
    models: ModelReader,
    num_inliers: Mapping[Pair, int],
) -> RunContent:
    """Return what ``report.html`` has beside the report and commands.

    Args:
        context: of the workspace, with its models.
        result: of mapping.
        report: of the run.
        models: reads its models.
        num_inliers: of the verified pairs.
    """
    workspace = context.workspace
    reader = PairReader(context.graph, context, models)
    lines = LinesOfRun(reader, result.names, num_inliers)
    return RunContent(
        names=result.names,
        num_inliers=num_inliers,
        image_path=workspace.photographs(),
        marks=result.marks,
        pairs_to_check=draw_pairs_to_check(context, reader, report, num_inliers),
        pair_lines=lines.of_page(),
        pair_files=lines.write_files(workspace),
        num_pairs_left_out=lines.num_left_out,
        cameras=context.graph.cameras,
        reader=models,
    )


def _own_results(context: Context) -> dict[str, Any]:
    """Return the fields that differ, or are missing, for the database of another program."""
    workspace = context.workspace
    if workspace.is_foreign:
        return {"num_pairs": num_matched_pairs(workspace.database), "recipe": ""}
    return {
        "num_pairs": len(context.listed_pairs()),
        "recipe": workspace.recipe(),
        "guided": guided_counts(context),
    }
