"""What each command does with its options: one library function and its result printed.

Every command takes the parsed options and returns the exit code. Modules are imported when a
command needs them: ``--help`` loads no heavy package.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from colmap_affrect.errors import ComparisonError, OptionError
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.report import EXIT_FAILED, EXIT_NO_MODEL, EXIT_OK
from colmap_affrect.project.workspace import Workspace

if TYPE_CHECKING:
    from colmap_affrect.colmap.verification import VerificationOptions
    from colmap_affrect.comparison.results import Comparison
    from colmap_affrect.images.photographs import CameraOptions, MaskOptions
    from colmap_affrect.interop.hdf5 import InterchangeReport
    from colmap_affrect.mappers.base import MapperOptions
    from colmap_affrect.mappers.existing import Extension
    from colmap_affrect.pairs.base import PairOptions
    from colmap_affrect.parallel.executor import Executor
    from colmap_affrect.project.report import ReconstructionReport, StageReport
    from colmap_affrect.recipes import Recipe
    from colmap_affrect.stages.context import Context, Resources


def run(options: argparse.Namespace) -> int:
    from colmap_affrect import pipeline

    recipe = _recipe(options)
    given = pipeline.RunOptions(
        recipe=recipe,
        database_descriptors=options.database_descriptors,
        extend=_extension(options),
        **_inputs(options, recipe),
    )
    with _executor(options) as executor:
        report = pipeline.run(
            options.image_path,
            options.output_path,
            given,
            executor=executor,
            overwrite=options.overwrite,
            progress=_progress(options),
        )
    return _print_reconstruction(report, options)


def _inputs(options: argparse.Namespace, recipe: Recipe | None = None) -> dict[str, Any]:
    """Return the fields of InputOptions, which run and compare have in common."""
    return {
        "cameras": _cameras(options),
        "masks": _masks(options),
        "pairs": _pair_options(options),
        "verification": _verification(options),
        "mapping": _mapping(options, recipe),
        "image_list_path": options.image_list_path,
        "from_database": options.from_database,
        "resources": _resources(options),
    }


def _extension(options: argparse.Namespace) -> Extension | None:
    from colmap_affrect.mappers.existing import Extension

    if options.extend:
        return Extension(options.extend, options.refine_existing)
    if options.refine_existing:
        raise OptionError("--refine-existing: only with --extend MODEL")
    return None


def _recipe(options: argparse.Namespace) -> Recipe:
    from colmap_affrect.recipes import load_recipe

    given = {"matching.name": options.matcher, "guided.enabled": options.guided}
    settings = [f"{key}={json.dumps(value)}" for key, value in given.items() if value]
    return load_recipe(options.recipe, [*settings, *options.set, *_depth_settings(options)])


def _depth_settings(options: argparse.Namespace) -> list[str]:
    path, model = options.depth_path, options.depth_model
    given = {
        "name": "monocular" if model else "files" if path else None,
        "path": str(path.resolve()) if path else None,
        "model": model,
        "kind": options.depth_kind,
    }
    return [f"depth.{key}={json.dumps(value)}" for key, value in given.items() if value]


def _resources(options: argparse.Namespace) -> Resources:
    from colmap_affrect.stages.context import Resources

    return Resources(options.weights, options.device)


@contextmanager
def _executor(options: argparse.Namespace) -> Iterator[Executor | None]:
    """Use the cluster that was named, None if there is none."""
    if not options.scheduler:
        yield None
        return
    from colmap_affrect.parallel.cluster import connected

    with connected(options.scheduler) as cluster:
        yield cluster


@contextmanager
def _context(options: argparse.Namespace) -> Iterator[Context]:
    """Lock the output folder and return what the stages work with."""
    from colmap_affrect.stages.context import Context

    with Workspace(options.output_path).locked() as workspace, _executor(options) as executor:
        yield Context(workspace, _resources(options), executor, _progress(options))


def _cameras(options: argparse.Namespace) -> CameraOptions:
    from colmap_affrect.images.photographs import CameraOptions

    return CameraOptions(
        mode=options.camera_mode, model=options.camera_model, params=options.camera_params
    )


def _masks(options: argparse.Namespace) -> MaskOptions:
    from colmap_affrect.images.photographs import MaskOptions

    paths = (options.mask_path, options.camera_mask_path)
    folder, camera = (str(path.resolve()) if path else "" for path in paths)
    return MaskOptions(path=folder, camera_path=camera)


def _pair_options(
    options: argparse.Namespace, recorded: Mapping[str, Any] | None = None
) -> PairOptions:
    """Return what is given on the command line, over what is on record."""
    from colmap_affrect.pairs.base import PairOptions

    listed = options.match_list_path
    given = {
        "methods": options.pairs,
        "num_neighbors": options.num_neighbors,
        "max_distance_m": options.max_distance_m,
        "match_list_path": str(listed.resolve()) if listed else None,
    }
    chosen = {key: value for key, value in given.items() if value is not None}
    return PairOptions.from_mapping({**(recorded or {}), **chosen}, "pairs")


def _verification(
    options: argparse.Namespace, recorded: Mapping[str, Any] | None = None
) -> VerificationOptions:
    """Return the preset that is given, or what is on record."""
    from colmap_affrect.colmap.verification import VerificationOptions

    if recorded and not options.preset:
        return VerificationOptions(**{**recorded, **_seed(options)})
    return VerificationOptions.preset(options.preset or "sparse", **_seed(options))


def _seed(options: argparse.Namespace) -> dict[str, int]:
    return {} if options.random_seed is None else {"random_seed": options.random_seed}


def _mapping(
    options: argparse.Namespace,
    recipe: Recipe | None = None,
    recorded: Mapping[str, Any] | None = None,
) -> MapperOptions:
    """Return the mapper that is given, or what is on record."""
    from colmap_affrect.mappers.base import MAPPERS
    from colmap_affrect.recipes import Recipe

    native = {}
    for setting in options.mapper_options:
        key, separator, value = setting.partition("=")
        if not separator or not key.strip():
            raise OptionError(f"--mapper-options {setting}: expected KEY=VALUE")
        native[key.strip()] = value
    given = {**_seed(options), **({"mapper_options": native} if native else {})}
    if recorded and not (options.preset or options.mapper):
        found: MapperOptions = MAPPERS.options({**recorded, **given})
        return found
    recipe = recipe or Recipe("")
    return recipe.mapper_options(options.preset or "sparse", options.mapper or "", **given)


def extract(options: argparse.Namespace) -> int:
    from colmap_affrect.stages import extract as stage

    inputs = stage.Inputs.of(
        options.image_path,
        image_list_path=options.image_list_path,
        from_database=options.from_database,
        cameras=_cameras(options),
        masks=_masks(options),
    )
    with _context(options) as context:
        report = stage.extract(context, inputs, _recipe(options), overwrite=options.overwrite)
        if options.database_descriptors:
            stage.write_descriptors(context)
    print(report.summary())
    return _exit_code(report.failures, options)


def pairs(options: argparse.Namespace) -> int:
    from colmap_affrect.stages.pairs import choose_pairs

    with _context(options) as context:
        chosen = _pair_options(options, context.workspace.planned("pairs"))
        report = choose_pairs(context, chosen, overwrite=options.overwrite)
    return _printed(report)


def match(options: argparse.Namespace) -> int:
    from colmap_affrect.matchers.base import MATCHERS
    from colmap_affrect.stages.match import match

    with _context(options) as context:
        if options.recipe:
            matching = _recipe(options).matching
        else:
            chosen = [f"matching.name={json.dumps(options.matcher)}"] if options.matcher else []
            values = _changed(context, "match", "matching", [*chosen, *options.set])
            matching = MATCHERS.options(values, where="matching")
        report = match(context, matching, overwrite=options.overwrite)
    return _printed(report)


def _changed(context: Context, stage: str, section: str, settings: Sequence[str]) -> dict[str, Any]:
    """Return the options on record of a stage, a section of the recipe, some of them changed."""
    from colmap_affrect.recipes import with_settings

    values = with_settings({section: context.workspace.planned(stage) or {}}, settings)
    if len(values) > 1:
        raise OptionError(f"--set: only options of {section} can be changed here")
    changed: dict[str, Any] = values[section]
    return changed


def verify(options: argparse.Namespace) -> int:
    from colmap_affrect.stages.verify import verify_matches

    with _context(options) as context:
        chosen = _verification(options, context.workspace.planned("verify"))
        report = verify_matches(context, chosen, overwrite=options.overwrite)
    return _printed(report)


def escalate(options: argparse.Namespace) -> int:
    from colmap_affrect.recipes import EscalateOptions
    from colmap_affrect.stages.escalate import escalate, pair_levels

    with _context(options) as context:
        values = _changed(context, "escalate", "escalate", options.set)
        chosen = EscalateOptions.from_mapping(values, "escalate")
        report = escalate(context, chosen, overwrite=options.overwrite)
        levels = pair_levels(context)
    print(report.summary())
    print(", ".join(f"{count} pairs by {name}" for name, count in levels.items()))
    return EXIT_OK


def guide(options: argparse.Namespace) -> int:
    from colmap_affrect.colmap.model_files import read_model
    from colmap_affrect.matchers.guided import GuidedOptions
    from colmap_affrect.stages.guide import guide, guided_counts
    from colmap_affrect.stages.guide_by_model import guide_by_model

    with _context(options) as context:
        values = _changed(context, "guide", "guided", options.set)
        values |= {"enabled": options.guided} if options.guided else {}
        chosen = GuidedOptions.from_mapping(values, "guided")
        report = guide(
            context, chosen, () if options.model_path else None, overwrite=options.overwrite
        )
        if options.model_path:
            report = guide_by_model(context, read_model(options.model_path))
        counts = guided_counts(context)
    print(report.summary())
    if counts:
        print("{pairs} pairs, {matches_before} to {matches_after} inliers".format(**counts))
    return EXIT_OK


def map(options: argparse.Namespace) -> int:
    from colmap_affrect.mappers.base import MAPPERS
    from colmap_affrect.pipeline import map_and_report, map_from_database

    extend = _extension(options)
    if options.from_database:
        report = map_from_database(
            options.from_database,
            options.output_path,
            image_path=options.image_path,
            mapping=_mapping(options),
            verification=_verification(options),
            extend=extend,
            overwrite=options.overwrite,
            progress=_progress(options),
        )
        return _print_reconstruction(report, options)
    if options.image_path:
        raise OptionError("--image-path: only with --from-database; else that of extract is used")
    with _context(options) as context:
        mapper = MAPPERS.make(_mapping(options, recorded=context.workspace.planned("map")))
        report = map_and_report(context, mapper, extend, overwrite=options.overwrite)
    return _print_reconstruction(report, options)


def compare(options: argparse.Namespace) -> int:
    from colmap_affrect.comparison.compare import CompareOptions, compare
    from colmap_affrect.comparison.methods import parse_methods
    from colmap_affrect.comparison.tables import summary, to_json
    from colmap_affrect.comparison.viewer import log_comparison, require_viewer

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
    print(to_json(comparison) if options.json else summary(comparison))
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
    from colmap_affrect.interop.hdf5 import import_h5

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
    return _printed(report)


def export_h5(options: argparse.Namespace) -> int:
    from colmap_affrect.interop.hdf5 import export_h5

    report = export_h5(
        options.features_path,
        options.matches_path,
        output_path=options.workspace_path,
        database_path=options.database_path,
        layout=options.layout,
        half=options.half,
        progress=_progress(options),
    )
    return _printed(report)


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


def _printed(report: StageReport | InterchangeReport) -> int:
    print(report.summary())
    return EXIT_OK


def _progress(options: argparse.Namespace) -> Progress:
    return SILENT if options.quiet else Progress(sys.stderr)


def _print_reconstruction(report: ReconstructionReport, options: argparse.Namespace) -> int:
    print(report.to_json() if options.json else report.summary())
    why = ""
    if not report.models:
        why = "one image cannot make a model" if report.images_total == 1 else "no model was found"
    elif not report.models[0].is_trustworthy:
        why = "nothing in the model can be trusted"
    if why:
        print(f"error: {why}; see {options.output_path / 'report.json'}", file=sys.stderr)
        return EXIT_NO_MODEL
    return _exit_code(report.failures, options)


def _exit_code(failures: Mapping[str, str], options: argparse.Namespace) -> int:
    if len(failures) <= options.max_failures:
        return EXIT_OK
    names = ", ".join(failures)
    print(f"error: could not read {len(failures)} of the images: {names}", file=sys.stderr)
    return EXIT_FAILED


def inspect(options: argparse.Namespace) -> int:
    from colmap_affrect.images.photographs import Photographs
    from colmap_affrect.report.inspection import inspect_image
    from colmap_affrect.stages.one_image import prepare

    recipe = _recipe(options)
    photographs = Photographs(options.image.parent, _masks(options))
    photographs.check()
    mask = photographs.mask(options.image.name)
    extractor = prepare(recipe.extraction, _resources(options), [options.image.name])
    print(inspect_image(extractor, options.image, options.output_path, mask))
    return EXIT_OK


def recipes(options: argparse.Namespace) -> int:
    import tomli_w

    from colmap_affrect.recipes import load_recipe, recipe_names

    if options.name:
        recipe = load_recipe(options.name)
        print(tomli_w.dumps({"summary": recipe.summary, **recipe.to_mapping()}), end="")
        return EXIT_OK
    for name in recipe_names():
        recipe = load_recipe(name)
        needs = list(recipe.extraction.weights)
        needs += ["depth"] if recipe.extraction.uses_depth else []
        print(f"{name:26s} {recipe.summary}")
        print(f"{'':26s} needs {', '.join(needs) or 'nothing'}")
    return EXIT_OK


def weights(options: argparse.Namespace) -> int:
    from colmap_affrect.features.weights import describe_weights, fetch

    if options.action == "fetch":
        keys = options.keys or ["affnet", "orinet", "hardnet"]
        for path in fetch(keys, options.weights, progress=Progress(sys.stderr)).values():
            print(path)
        return EXIT_OK
    checks = {None: "", True: ", verified", False: ", NOT the published file"}
    for row in describe_weights(options.weights):
        file = row.published
        where = f"{row.path}{checks[row.verified]}" if row.path else "not found"
        print(f"{row.key:10s} {file.file_name:32s} {file.used_for}")
        print(f"{'':10s} {where}")
        sha256, licence = file.sha256 or "not known", file.licence or "not stated"
        print(f"{'':10s} sha256 {sha256}; licence {licence}")
    return EXIT_OK
