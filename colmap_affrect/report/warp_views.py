"""What a recipe warps in a photograph: its regions in colour and the largest warps, small."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.colors import to_hex

from colmap_affrect.data import Photograph, RectificationPlan
from colmap_affrect.images.reading import shrink_to
from colmap_affrect.images.warping import warp
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.pictures import Picture
from colmap_affrect.report.regions import largest_warps, tinted, warp_colors
from colmap_affrect.stages.context import Context, Resources
from colmap_affrect.stages.extract import image_tasks
from colmap_affrect.stages.one_image import prepare

MAP_SIZE_PX = 480
WARP_SIZE_PX = 200
MAX_NUM_WARPS = 6


@dataclass(frozen=True)
class WarpView:
    """One warp; the colour of its region is #rrggbb, the angle where it stretches."""

    picture: Picture
    color: str
    tilt: float
    angle_deg: float


@dataclass(frozen=True)
class WarpedPhotograph:
    """What one level of a recipe does with a photograph, and the largest of its warps.

    ``regions`` is the photograph with their regions in colour; ``has_regions`` says whether they
    are meant for parts of it.
    """

    name: str
    level: int
    rectifier: str
    num_warps: int
    regions: Picture
    warps: tuple[WarpView, ...]
    has_regions: bool


def warped_photographs(
    workspace: Workspace, names: Sequence[str], resources: Resources | None = None
) -> list[WarpedPhotograph]:
    """Plan the warps of photographs again, of each those of the first level that has any.

    Depth maps of networks are taken from the workspace. Raises AffrectError when what the recipe
    needs, or a photograph, cannot be used.
    """
    resources = resources or Resources(depth_cache_path=workspace.depth)
    extractor = prepare(Context(workspace).extraction, resources)
    inputs = Context(workspace).inputs
    found = []
    for task in image_tasks(workspace, inputs, extractor.options, [(name, 0) for name in names]):
        path, mask = task.photographs.folder / task.name, task.photographs.mask(task.name)
        for level, chosen in enumerate(extractor.options.levels):
            given = path, task.name, task.intrinsics, mask, level
            photograph, _ = extractor.photograph(*given)
            plan, _ = extractor.plan_or_warn(photograph, level)
            if plan.items:
                found.append(_view(photograph, plan, level, chosen.rectifier.name))
                break
    return found


def _view(
    photograph: Photograph, plan: RectificationPlan, level: int, rectifier: str
) -> WarpedPhotograph:
    colors = warp_colors(plan)
    views = []
    for index in largest_warps(plan, MAX_NUM_WARPS):
        item = plan.items[index]
        picture = Picture.jpeg(shrink_to(warp(photograph.gray, item), WARP_SIZE_PX))
        angle_deg = float(np.rad2deg(item.tilt_angle_rad))
        views.append(WarpView(picture, to_hex(colors[index]), item.tilt, angle_deg))
    return WarpedPhotograph(
        photograph.name,
        level,
        rectifier,
        len(plan.items),
        Picture.jpeg(shrink_to(tinted(photograph, plan), MAP_SIZE_PX)),
        tuple(views),
        any(item.region is not None for item in plan.items),
    )


def rectifies(workspace: Workspace) -> bool:
    """Tell whether photographs are warped there; COLMAP's SIFT leaves no record and warps none."""
    if workspace.planned("extract") is None:
        return False
    levels = Context(workspace).extraction.levels
    return any(level.rectifier.name != "identity" for level in levels)
