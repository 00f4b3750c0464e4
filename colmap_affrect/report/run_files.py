"""The files that a run ends with, ``report.json`` and ``report.html``."""

from collections.abc import Mapping, Sequence

from colmap_affrect.colmap.by_hand import Marks
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.report.advice import command_with_masks, command_with_tie_points
from colmap_affrect.report.pair_lines import lines_of_pairs
from colmap_affrect.report.pair_matches import PairReader
from colmap_affrect.report.pairs import draw_pairs_to_check
from colmap_affrect.report.run_page import RunContent, write_run_page
from colmap_affrect.report.run_report import RunReport
from colmap_affrect.session.context import Context


def write_results(
    context: Context,
    report: RunReport,
    names: Sequence[str],
    num_inliers: Mapping[Pair, int],
    marks: Marks | None,
) -> None:
    """Write ``report.json`` and, unless there are no marks to begin with, ``report.html``.

    Args:
        context: of the run.
        report: of the run.
        names: of all photographs.
        num_inliers: of the verified pairs.
        marks: of the tie points by hand; None: no page is wanted.
    """
    workspace = context.workspace
    workspace.page.unlink(missing_ok=True)  # a kill leaves none beside another report
    replace_text(workspace.report, report.to_json())
    if marks is None:
        return
    reader = PairReader(context.graph, context)
    content = RunContent(
        names=names,
        num_inliers=num_inliers,
        image_path=workspace.photographs(),
        marks=marks,
        pairs_to_check=draw_pairs_to_check(context, reader, report, num_inliers),
        pair_lines=lines_of_pairs(reader, names, num_inliers),
        cameras=context.graph.cameras,
        marks_command=command_with_tie_points(context),
        masks_command=command_with_masks(context),
    )
    write_run_page(workspace, report, content, context.progress)
