"""What each command does with its options: one library function and its result printed.

Every command takes the parsed options and returns the exit code. Modules are imported when a
command needs them: ``--help`` loads no heavy package.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from colmap_affrect.errors import ComparisonError, OptionError
from colmap_affrect.options import (
    CameraOptions,
    MappingOptions,
    MaskOptions,
    PairOptions,
    VerificationOptions,
)
from colmap_affrect.outcomes import EXIT_FAILED, EXIT_NO_MODEL, EXIT_OK, ReconstructionReport
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.workspace import Workspace

if TYPE_CHECKING:
    from colmap_affrect.comparison.results import Comparison
    from colmap_affrect.executor import Executor
    from colmap_affrect.extraction import Resources
    from colmap_affrect.pipeline import RunOptions
    from colmap_affrect.recipes import Recipe


def run(options: argparse.Namespace) -> int:
    from colmap_affrect import pipeline

    with _executor(options) as executor:
        report = pipeline.run(
            options.image_path,
            options.output_path,
            _run_options(options),
            executor=executor,
            overwrite=options.overwrite,
            progress=_progress(options),
        )
    return _print_reconstruction(report, options)


def _run_options(options: argparse.Namespace) -> RunOptions:
    from colmap_affrect.pipeline import RunOptions

    return RunOptions(
        recipe=_recipe(options, options.recipe),
        pairs=_pair_options(options),
        database_descriptors=options.database_descriptors,
        random_seed=options.random_seed,
        **_inputs(options),
    )


def _inputs(options: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of InputOptions, which run and compare have in common."""
    return {
        "cameras": _cameras(options),
        "masks": _masks(options),
        "verification": VerificationOptions.preset(options.preset),
        "mapping": _mapping(options),
        "match_list_path": options.match_list_path,
        "image_list_path": options.image_list_path,
        "from_database": options.from_database,
        "resources": _resources(options),
    }


def _recipe(options: argparse.Namespace, name: str) -> Recipe:
    from colmap_affrect.recipes import load_recipe

    return load_recipe(name, [*options.set, *_depth_settings(options)])


def _depth_settings(options: argparse.Namespace) -> list[str]:
    path = getattr(options, "depth_path", None)
    given = {
        "path": str(path.resolve()) if path else None,
        "model": getattr(options, "depth_model", None),
        "kind": getattr(options, "depth_kind", None),
    }
    return [f"depth.{key}={json.dumps(value)}" for key, value in given.items() if value]


def _resources(options: argparse.Namespace) -> Resources:
    from colmap_affrect.extraction import Resources

    return Resources(options.weights, options.device)


@contextmanager
def _executor(options: argparse.Namespace) -> Iterator[Executor | None]:
    """Use the cluster that was named, None if there is none."""
    if not options.scheduler:
        yield None
        return
    from colmap_affrect.cluster import connected

    with connected(options.scheduler) as cluster:
        yield cluster


def _cameras(options: argparse.Namespace) -> CameraOptions:
    return CameraOptions(
        mode=options.camera_mode, model=options.camera_model, params=options.camera_params
    )


def _mapping(options: argparse.Namespace) -> MappingOptions:
    given = {}
    for setting in options.mapper_options:
        key, separator, value = setting.partition("=")
        if not separator or not key.strip():
            raise OptionError(f"--mapper-options {setting}: expected KEY=VALUE")
        given[key.strip()] = value
    return MappingOptions.preset(options.preset, mapper=options.mapper, mapper_options=given)


def _masks(options: argparse.Namespace) -> MaskOptions:
    paths = (options.mask_path, options.camera_mask_path)
    folder, camera = (str(path.resolve()) if path else "" for path in paths)
    return MaskOptions(path=folder, camera_path=camera)


def extract(options: argparse.Namespace) -> int:
    from colmap_affrect import stages

    with Workspace(options.output_path).locked() as workspace, _executor(options) as executor:
        report = stages.extract(
            workspace,
            options.image_path,
            _recipe(options, options.recipe),
            _cameras(options),
            masks=_masks(options),
            image_list_path=options.image_list_path,
            from_database=options.from_database,
            resources=_resources(options),
            executor=executor,
            overwrite=options.overwrite,
            progress=_progress(options),
        )
        if options.database_descriptors:
            stages.write_descriptors(workspace)
    print(report.summary())
    return _exit_code(report.failures, options)


def pairs(options: argparse.Namespace) -> int:
    from colmap_affrect import stages

    with Workspace(options.output_path).locked() as workspace:
        report = stages.choose_pairs(
            workspace,
            _pair_options(options),
            match_list_path=options.match_list_path,
            overwrite=options.overwrite,
            progress=_progress(options),
        )
    print(report.summary())
    return EXIT_OK


def _pair_options(options: argparse.Namespace) -> PairOptions:
    return PairOptions(
        methods=options.pairs,
        num_neighbors=options.num_neighbors,
        max_distance_m=options.max_distance_m,
    )


def match(options: argparse.Namespace) -> int:
    from colmap_affrect import stages

    with Workspace(options.output_path).locked() as workspace, _executor(options) as executor:
        recipe = _recipe(options, options.recipe or workspace.recipe())
        report = stages.match(
            workspace,
            recipe.matching,
            device=options.device,
            executor=executor,
            overwrite=options.overwrite,
            progress=_progress(options),
        )
    print(report.summary())
    return EXIT_OK


def verify(options: argparse.Namespace) -> int:
    from colmap_affrect import stages

    with Workspace(options.output_path).locked() as workspace:
        report = stages.verify_matches(
            workspace,
            VerificationOptions.preset(options.preset),
            options.random_seed,
            overwrite=options.overwrite,
            progress=_progress(options),
        )
    print(report.summary())
    return EXIT_OK


def escalate(options: argparse.Namespace) -> int:
    from colmap_affrect import escalation

    with Workspace(options.output_path).locked() as workspace, _executor(options) as executor:
        report = escalation.escalate(
            workspace,
            resources=_resources(options),
            executor=executor,
            overwrite=options.overwrite,
            progress=_progress(options),
        )
        levels = escalation.pair_levels(workspace)
    print(report.summary())
    print(", ".join(f"{count} pairs by {name}" for name, count in levels.items()))
    return EXIT_OK


def map(options: argparse.Namespace) -> int:
    from colmap_affrect.pipeline import map_and_report

    with Workspace(options.output_path).locked() as workspace:
        report = map_and_report(
            workspace,
            _mapping(options),
            options.random_seed,
            overwrite=options.overwrite,
            progress=_progress(options),
        )
    return _print_reconstruction(report, options)


def compare(options: argparse.Namespace) -> int:
    from colmap_affrect.comparison.compare import CompareOptions, compare
    from colmap_affrect.comparison.methods import parse_methods
    from colmap_affrect.report.viewer import log_comparison, require_viewer

    if options.viewer:
        require_viewer()
    comparison = compare(
        options.image_path,
        options.output_path,
        CompareOptions(
            methods=parse_methods(options.methods, _depth_settings(options)),
            seeds=options.seeds,
            ground_truth_path=options.ground_truth_path,
            **_inputs(options),
        ),
        overwrite=options.overwrite,
        progress=SILENT if options.quiet else Progress(sys.stderr, num_plain_lines=1),
    )
    print(comparison.to_json() if options.json else comparison.summary())
    if not options.json:
        print(f"\npictures: {options.output_path / 'report.html'}")
    if options.viewer:
        path = log_comparison(comparison, options.output_path)
        print(f"for rerun: {path}", file=sys.stderr)
    return _comparison_exit_code(comparison, options)


def evaluate(options: argparse.Namespace) -> int:
    from colmap_affrect.comparison.methods import parse_methods
    from colmap_affrect.evaluation.evaluate import EvaluateOptions, evaluate
    from colmap_affrect.evaluation.registry import make_protocol

    evaluation = evaluate(
        make_protocol(options.protocol, options.protocol_options),
        options.dataset_path,
        options.output_path,
        EvaluateOptions(
            recipes=parse_methods(options.recipes, _depth_settings(options)),
            baseline=options.baseline,
            max_num_keypoints=options.max_num_keypoints,
            random_seed=options.random_seed,
            resources=_resources(options),
        ),
        overwrite=options.overwrite,
        progress=_progress(options),
    )
    print(evaluation.to_json() if options.json else evaluation.summary())
    if not options.json:
        print(f"\nplots, all pairs: {options.output_path}")
    failures = {name: why for recipe in evaluation.recipes for name, why in recipe.failures.items()}
    return _exit_code(failures, options)


def _comparison_exit_code(comparison: Comparison, options: argparse.Namespace) -> int:
    failed = [method.name for method in comparison.methods if method.failed]
    if failed:
        where = options.output_path / "comparison.json"
        raise ComparisonError(f"failed: {', '.join(failed)}; {where} says why")
    if not any(seed.model_names for method in comparison.methods for seed in method.seeds):
        print("error: no method found a model", file=sys.stderr)
        return EXIT_NO_MODEL
    failures = {name: why for m in comparison.methods for name, why in m.failures.items()}
    return _exit_code(failures, options)


def import_h5(options: argparse.Namespace) -> int:
    from colmap_affrect.interchange import import_h5

    report = import_h5(
        options.image_path,
        options.features_path,
        options.matches_path,
        options.database_path,
        cameras=_cameras(options),
        layout=options.layout,
        pixel_origin=options.pixel_origin,
        skip_verification=options.skip_verification,
        random_seed=options.random_seed,
        progress=_progress(options),
    )
    print(report.summary())
    return EXIT_OK


def export_h5(options: argparse.Namespace) -> int:
    from colmap_affrect.interchange import export_h5

    report = export_h5(
        options.features_path,
        options.matches_path,
        output_path=options.workspace_path,
        database_path=options.database_path,
        layout=options.layout,
        half=options.half,
        progress=_progress(options),
    )
    print(report.summary())
    return EXIT_OK


def doctor(options: argparse.Namespace) -> int:
    from colmap_affrect.doctor import diagnose

    diagnosis = diagnose(
        options.path,
        image_path=options.image_path,
        weights_path=options.weights,
        progress=_progress(options),
    )
    print(diagnosis.to_json() if options.json else diagnosis.summary())
    return EXIT_FAILED if diagnosis.num_errors else EXIT_OK


def _progress(options: argparse.Namespace) -> Progress:
    return SILENT if options.quiet else Progress(sys.stderr)


def _print_reconstruction(report: ReconstructionReport, options: argparse.Namespace) -> int:
    print(report.to_json() if options.json else report.summary())
    if not report.models:
        why = "one image cannot make a model" if report.images_total == 1 else "no model was found"
        print(f"error: {why}; see {options.output_path / 'report.json'}", file=sys.stderr)
        return EXIT_NO_MODEL
    return _exit_code(report.failures, options)


def _exit_code(failures: Mapping[str, str], options: argparse.Namespace) -> int:
    if len(failures) <= getattr(options, "max_failures", 0):
        return EXIT_OK
    names = ", ".join(failures)
    print(f"error: could not read {len(failures)} of the images: {names}", file=sys.stderr)
    return EXIT_FAILED


def inspect(options: argparse.Namespace) -> int:
    from colmap_affrect.extraction import prepare
    from colmap_affrect.photographs import Photographs
    from colmap_affrect.report.inspection import inspect_image

    recipe = _recipe(options, options.recipe)
    photographs = Photographs(options.image.parent, CameraOptions(), _masks(options))
    photographs.check()
    mask = photographs.mask(options.image.name)
    extractor = prepare(recipe.extraction, _resources(options), [options.image.name])
    print(inspect_image(extractor, options.image, options.output_path, mask=mask).summary())
    return EXIT_OK


def recipes(options: argparse.Namespace) -> int:
    from colmap_affrect.features.registry import needed_weights
    from colmap_affrect.recipes import load_recipe, recipe_names
    from colmap_affrect.workspace import dump_toml

    if options.name:
        recipe = load_recipe(options.name)
        everything = {**recipe.extraction.to_mapping(), "matching": recipe.matching.to_mapping()}
        print(f"# {recipe.summary}\n{dump_toml(everything)}", end="")
        return EXIT_OK
    for name in recipe_names():
        recipe = load_recipe(name)
        needs = list(needed_weights(recipe.extraction))
        needs += ["depth"] if any(r.uses_depth for r in recipe.extraction.rectifiers) else []
        print(f"{name:26s} {recipe.summary}")
        print(f"{'':26s} needs {', '.join(needs) or 'nothing'}")
    return EXIT_OK


def weights(options: argparse.Namespace) -> int:
    from colmap_affrect.features.weights import WEIGHT_FILES, describe_weights, fetch

    if options.action == "fetch":
        keys = options.keys or ["affnet", "orinet", "hardnet"]
        for path in fetch(keys, options.weights, progress=Progress(sys.stderr)).values():
            print(path)
        return EXIT_OK
    checks = {None: "", True: ", verified", False: ", NOT the published file"}
    for row in describe_weights(options.weights):
        where = f"{row.path}{checks[row.verified]}" if row.path else "not found"
        print(f"{row.key:10s} {row.file_name:32s} {row.used_for}")
        print(f"{'':10s} {where}")
        sha256, licence = WEIGHT_FILES[row.key].sha256 or "not known", row.licence or "not stated"
        print(f"{'':10s} sha256 {sha256}; licence {licence}")
    return EXIT_OK
