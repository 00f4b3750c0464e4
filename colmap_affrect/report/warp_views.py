"""What a recipe warps in a photograph: its regions in colour and the largest warps, small."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_affrect.extraction import ImageExtractor, Resources, prepare
from colmap_affrect.imaging import shrink_to, warp
from colmap_affrect.photographs import Photographs
from colmap_affrect.report.pictures import Picture
from colmap_affrect.report.sheet import warp_colors
from colmap_affrect.types import ColorImage, Photograph, RectificationPlan
from colmap_affrect.workspace import Workspace

MAP_SIZE_PX = 480
WARP_SIZE_PX = 200
MAX_NUM_WARPS = 6
TINT = 0.45


@dataclass(frozen=True)
class WarpView:
    """One warp.

    Attributes:
        picture: of it.
        color: of its region, as #rrggbb.
        tilt: that it undoes.
        angle_deg: direction in which it stretches.
    """

    picture: Picture
    color: str
    tilt: float
    angle_deg: float


@dataclass(frozen=True)
class WarpedPhotograph:
    """What one level of a recipe does with a photograph.

    Attributes:
        name: of the photograph.
        level: of escalation; 0 is what every photograph gets.
        rectifier: its name.
        num_warps: all that were planned.
        regions: the photograph with the regions of the warps in colour.
        warps: the largest.
        has_regions: whether warps are meant for parts of the photograph.
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
    """Plan the warps of photographs again; those without any are left out.

    Args:
        workspace: folder of the method.
        names: of the photographs.
        resources: weights and device; depth maps of networks are taken from the workspace.

    Raises:
        AffrectError: when what the recipe needs, or a photograph, cannot be used.
    """
    resources = resources or Resources(depth_cache_path=workspace.depth)
    extractor = prepare(workspace.extraction_options(), resources)
    photographs = Photographs.recorded(workspace)
    found = (_warped(extractor, photographs, name) for name in names)
    return [item for item in found if item is not None]


def _warped(
    extractor: ImageExtractor, photographs: Photographs, name: str
) -> WarpedPhotograph | None:
    """Return the first level that has warps."""
    camera = photographs.known.get(name)
    photograph, _ = extractor.photograph(
        photographs.folder / name,
        name,
        camera.matrix if camera else None,
        photographs.mask(name),
    )
    for level, options in enumerate(extractor.options.rectifiers):
        plan, _ = extractor.plan_or_warn(photograph, level)
        if plan.items:
            return _view(photograph, plan, level, options.name)
    return None


def _view(
    photograph: Photograph, plan: RectificationPlan, level: int, rectifier: str
) -> WarpedPhotograph:
    colors = warp_colors(plan)
    by_area = sorted(range(len(plan.items)), key=lambda index: -plan.items[index].canvas_area_px)
    views = []
    for index in by_area[:MAX_NUM_WARPS]:
        item = plan.items[index]
        red, green, blue = (round(255 * share) for share in colors[index])
        views.append(
            WarpView(
                Picture.jpeg(shrink_to(warp(photograph.gray, item), WARP_SIZE_PX)),
                f"#{red:02x}{green:02x}{blue:02x}",
                item.tilt,
                float(np.rad2deg(item.tilt_angle_rad)),
            )
        )
    return WarpedPhotograph(
        photograph.name,
        level,
        rectifier,
        len(plan.items),
        Picture.jpeg(shrink_to(tinted(photograph, plan), MAP_SIZE_PX)),
        tuple(views),
        any(item.region is not None for item in plan.items),
    )


def tinted(photograph: Photograph, plan: RectificationPlan) -> ColorImage:
    """Return the (H, W, 3) photograph with each region in the colour of its warp."""
    image = np.repeat(photograph.gray[:, :, None], 3, axis=2)
    for item, color in zip(plan.items, warp_colors(plan), strict=True):
        if item.region is not None:
            rows, columns = np.nonzero(item.region)
            rows, columns = rows + item.region_origin[1], columns + item.region_origin[0]
            gray = photograph.gray[rows, columns, None]
            mixed = (1.0 - TINT) * gray + TINT * 255.0 * np.array(color)
            image[rows, columns] = np.rint(mixed).astype(np.uint8)
    return image


def rectifies(output_path: Path, folder: str) -> bool:
    """Tell whether the method of a folder warps photographs; those of SIFT do not."""
    workspace = Workspace(output_path / folder)
    if not folder or "extract" not in workspace.recorded():
        return False
    return any(item.name != "identity" for item in workspace.extraction_options().rectifiers)
