"""From a folder of photographs to a COLMAP model: the stages one after the other."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

from colmap_affrect import stages
from colmap_affrect.colmap.mapping import checked_mapping_options, mapping_differences
from colmap_affrect.colmap.verification import verification_differences
from colmap_affrect.escalation import escalate, pair_levels
from colmap_affrect.executor import Executor
from colmap_affrect.extraction import Resources
from colmap_affrect.files import replace_text
from colmap_affrect.options import (
    CameraOptions,
    MappingOptions,
    MaskOptions,
    PairOptions,
    VerificationOptions,
)
from colmap_affrect.outcomes import ModelSummary, ReconstructionReport, StageReport
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.recipes import Recipe, load_recipe
from colmap_affrect.workspace import Workspace

REPORTED_PACKAGES = (
    "colmap-affrect", "pycolmap", "opencv-python-headless", "numpy", "h5py", "torch", "kornia",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class InputOptions:
    """What a run and a comparison of methods depend on alike, beside images and recipes.

    Attributes:
        cameras: how images share cameras.
        masks: where features may be.
        verification: thresholds of two-view geometry.
        mapping: mapper and its options.
        match_list_path: list of the pairs to match; None for all pairs.
        image_list_path: list of the images to use; None for all below the folder.
        from_database: COLMAP database whose images, cameras, rigs, frames and pose priors are
            used; it stays as it is.
        resources: weights and device of networks.
    """

    cameras: CameraOptions = field(default_factory=CameraOptions)
    masks: MaskOptions = field(default_factory=MaskOptions)
    verification: VerificationOptions = field(default_factory=VerificationOptions)
    mapping: MappingOptions = field(default_factory=MappingOptions)
    match_list_path: Path | None = None
    image_list_path: Path | None = None
    from_database: Path | None = None
    resources: Resources = field(default_factory=Resources)


@dataclass(frozen=True, kw_only=True)
class RunOptions(InputOptions):
    """Everything a run depends on beside its images and its output folder.

    Attributes:
        recipe: options of extraction and matching.
        pairs: how the pairs to match are chosen.
        database_descriptors: also write descriptors into the database, as COLMAP's matchers
            need them.
        random_seed: seed of verification and mapping.
    """

    recipe: Recipe = field(default_factory=lambda: load_recipe("default"))
    pairs: PairOptions = field(default_factory=PairOptions)
    database_descriptors: bool = False
    random_seed: int = 0


def run(
    image_path: Path,
    output_path: Path,
    options: RunOptions | None = None,
    *,
    executor: Executor | None = None,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> ReconstructionReport:
    """Extract, match, verify and map; go on where an earlier run stopped.

    Args:
        image_path: folder of the photographs, searched with its sub-folders.
        output_path: folder for all results, made if missing.
        options: see :class:`RunOptions`.
        executor: where images and pairs are worked on, a cluster for one
            (:func:`colmap_affrect.cluster.connected`); by default in threads of this process.
        overwrite: discard results that are there.
        progress: where to show progress.

    Returns:
        The report that is also written to ``report.json``.

    Raises:
        AffrectError: for anything that the caller can mend; what is done stays.
    """
    options = options or RunOptions()
    workspace = Workspace(output_path)
    mapping = checked_mapping_options(options.mapping)
    stages.images_to_use(image_path, options.image_list_path, options.from_database)
    with workspace.locked():
        reports = [
            stages.extract(
                workspace,
                image_path,
                options.recipe,
                options.cameras,
                masks=options.masks,
                image_list_path=options.image_list_path,
                from_database=options.from_database,
                resources=options.resources,
                executor=executor,
                overwrite=overwrite,
                progress=progress,
            ),
            stages.choose_pairs(
                workspace,
                options.pairs,
                match_list_path=options.match_list_path,
                progress=progress,
            ),
            stages.match(
                workspace,
                options.recipe.matching,
                device=options.resources.device,
                executor=executor,
                progress=progress,
            ),
            stages.verify_matches(
                workspace, options.verification, options.random_seed, progress=progress
            ),
        ]
        if options.recipe.extraction.escalation:
            reports.append(
                escalate(
                    workspace, resources=options.resources, executor=executor, progress=progress
                )
            )
        if options.database_descriptors:
            stages.write_descriptors(workspace)
        return map_and_report(
            workspace, mapping, options.random_seed, earlier=reports, progress=progress
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
    options = checked_mapping_options(options)
    report, models = stages.map_images(
        workspace, options, random_seed, overwrite=overwrite, progress=progress
    )
    names = stages.recorded_images(workspace)
    verification, verification_seed = workspace.verification_options()
    min_num_inliers = verification.min_num_inliers
    registered = models[0].registered_names if models else ()
    intrinsics_given = stages.intrinsics_given(workspace)
    result = ReconstructionReport(
        images_total=len(names),
        unregistered={
            **stages.reconstruction_problems(workspace, names, registered, min_num_inliers),
            **_in_other_models(models),
        },
        models=tuple(models),
        num_pairs=stages.num_listed_pairs(workspace),
        num_verified_pairs=stages.num_verified_pairs(workspace, min_num_inliers),
        stages=(*earlier, report),
        recipe=workspace.recipe(),
        random_seed=random_seed,
        versions=installed_versions(),
        verification=verification,
        mapping=options,
        differs_from_colmap={
            "verification": verification_differences(verification, verification_seed),
            "mapping": mapping_differences(options, random_seed, intrinsics_given=intrinsics_given),
        },
        pair_levels=pair_levels(workspace),
    )
    replace_text(workspace.report, result.to_json())
    return result


def _in_other_models(models: Sequence[ModelSummary]) -> dict[str, str]:
    """Tell of the images outside the largest model which other one has them."""
    largest = models[0].registered_names if models else ()
    return {
        name: f"in another model, sparse/{index}"
        for index, model in reversed(list(enumerate(models)))
        for name in model.registered_names
        if name not in largest
    }


def installed_versions() -> dict[str, str]:
    """Return the versions of what a result depends on."""
    versions = {"python": platform.python_version()}
    for package in REPORTED_PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed as a package"
    return versions
