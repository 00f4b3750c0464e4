"""From a folder of photographs to a COLMAP model: the stages one after the other."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

from colmap_affrect import stages
from colmap_affrect.escalation import escalate, pair_levels
from colmap_affrect.extraction import Resources
from colmap_affrect.options import CameraOptions, MappingOptions, VerificationOptions
from colmap_affrect.outcomes import ReconstructionReport, StageReport
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.recipes import Recipe, load_recipe
from colmap_affrect.workspace import Workspace

REPORTED_PACKAGES = (
    "colmap-affrect", "pycolmap", "opencv-python-headless", "numpy", "h5py", "torch", "kornia",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Everything a run depends on beside its images and its output folder.

    Attributes:
        recipe: options of extraction and matching.
        match_list_path: list of the pairs to match; None for all pairs.
        image_list_path: list of the images to use; None for all below the folder.
        random_seed: seed of verification and mapping.
        resources: weights and device of networks.
    """

    recipe: Recipe = field(default_factory=lambda: load_recipe("default"))
    cameras: CameraOptions = field(default_factory=CameraOptions)
    verification: VerificationOptions = field(default_factory=VerificationOptions)
    mapping: MappingOptions = field(default_factory=MappingOptions)
    match_list_path: Path | None = None
    image_list_path: Path | None = None
    random_seed: int = 0
    resources: Resources = field(default_factory=Resources)


def run(
    image_path: Path,
    output_path: Path,
    options: RunOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> ReconstructionReport:
    """Extract, match, verify and map; go on where an earlier run stopped.

    Args:
        image_path: folder of the photographs, searched with its sub-folders.
        output_path: folder for all results, made if missing.
        options: see :class:`RunOptions`.
        overwrite: discard results that are there.
        progress: where to show progress.

    Returns:
        The report that is also written to ``report.json``.

    Raises:
        AffrectError: for anything that the caller can mend; what is done stays.
    """
    options = options or RunOptions()
    workspace = Workspace(output_path)
    stages.list_images(image_path, options.image_list_path)
    with workspace.locked():
        reports = [
            stages.extract(
                workspace,
                image_path,
                options.recipe,
                options.cameras,
                image_list_path=options.image_list_path,
                resources=options.resources,
                overwrite=overwrite,
                progress=progress,
            ),
            stages.choose_pairs(workspace, match_list_path=options.match_list_path),
            stages.match(workspace, options.recipe.matching, progress=progress),
            stages.verify_matches(
                workspace, options.verification, options.random_seed, progress=progress
            ),
        ]
        if options.recipe.extraction.escalation:
            reports.append(escalate(workspace, resources=options.resources, progress=progress))
        return map_and_report(
            workspace, options.mapping, options.random_seed, earlier=reports, progress=progress
        )


def map_and_report(
    workspace: Workspace,
    options: MappingOptions,
    random_seed: int,
    *,
    earlier: Sequence[StageReport] = (),
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> ReconstructionReport:
    """Map a verified workspace and write ``report.json``."""
    report, models = stages.map_images(
        workspace, options, random_seed, overwrite=overwrite, progress=progress
    )
    names = stages.recorded_images(workspace)
    min_num_inliers = workspace.require("verify")["min_num_inliers"]
    registered = models[0].registered_names if models else ()
    result = ReconstructionReport(
        images_total=len(names),
        unregistered=stages.reconstruction_problems(workspace, names, registered, min_num_inliers),
        models=tuple(models),
        num_pairs=stages.num_listed_pairs(workspace),
        num_verified_pairs=stages.num_verified_pairs(workspace, min_num_inliers),
        stages=(*earlier, report),
        recipe=workspace.recipe(),
        random_seed=random_seed,
        versions=installed_versions(),
        pair_levels=pair_levels(workspace),
    )
    workspace.report.write_text(result.to_json(), encoding="utf-8")
    return result


def installed_versions() -> dict[str, str]:
    """Return the versions of what a result depends on."""
    versions = {"python": platform.python_version()}
    for package in REPORTED_PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed as a package"
    return versions
