"""What the page of a run was made from: while that stays, so does the page.

To read the matches of thousands of pairs and to shrink all photographs takes most of the time of a
command that finds everything done.
"""

from collections.abc import Sequence
from contextlib import suppress

from colmap_affrect.colmap.by_hand import Marks
from colmap_affrect.colmap.model_files import kept_digests
from colmap_affrect.options import digest_of
from colmap_affrect.project.record import stamp_of
from colmap_affrect.project.regular_files import first_bytes
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.page import TEMPLATES
from colmap_affrect.report.run_report import RunReport

HEAD_BYTES = 4096  # of a page, in which its key is; format


def page_key(
    workspace: Workspace,
    report: RunReport,
    names: Sequence[str],
    marks: Marks,
    commands: Sequence[str],
) -> str:
    """Return a digest of all that a page is made from.

    Args:
        workspace: of the run, whose pairs and models are shown.
        report: of the run; how much its stages did, and how long that took, does not count.
        names: of all photographs.
        marks: tie points by hand.
        commands: that the page offers.

    Returns:
        The digest; empty where others may have changed the database, which has no stamp.
    """
    if workspace.is_foreign or workspace.is_changed:
        return ""
    content = report.to_mapping()
    said = []
    for stage in content.pop("stages"):
        said.append([stage["name"], stage["failed"], stage["warned"]])
    folder = workspace.photographs()
    photographs = [folder / name for name in names] if folder else []
    folders = [workspace.sparse / str(number) for number in range(len(report.models))]
    places = {}
    for point, of_images in marks.items():
        places[point] = {image: px.tolist() for image, px in of_images.items()}
    stores = (workspace.features, workspace.matches, workspace.guided)
    return digest_of(
        [
            content,
            said,
            stamp_of(photographs),
            [kept_digests(folder) for folder in folders],
            stamp_of(stores),
            workspace.record(),
            places,
            list(commands),
            stamp_of(sorted(TEMPLATES.iterdir())),
        ]
    )


def is_current(workspace: Workspace, key: str) -> bool:
    """Tell whether the page of a run, with all files beside it, was made from what a key says."""
    if not key:
        return False
    with suppress(OSError):
        head = first_bytes(workspace.page, HEAD_BYTES)
        named = f"{key} {len(workspace.page_files())}"
        return f'"made-from" content="{named}"'.encode() in head
    return False
