"""What each command does with its options: one library function and its result printed.

Every command takes the parsed options, and raises what is wrong. This is imported when a command
runs: ``--help`` loads no heavy package. What one command alone needs, that imports.
"""

import argparse
import shlex
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_affrect import pipeline
from colmap_affrect.cli import given
from colmap_affrect.colmap.by_hand import ByHand
from colmap_affrect.colmap.database import fill_descriptors
from colmap_affrect.errors import (
    AffrectError,
    ImageError,
    NoModelError,
    Option,
    OptionError,
    such_as,
)
from colmap_affrect.features import weights as files
from colmap_affrect.images.photographs import (
    CameraOptions,
    MaskOptions,
    Photographs,
    list_images,
)
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.options import described_toml
from colmap_affrect.pipeline import single_stages
from colmap_affrect.progress import Progress, show
from colmap_affrect.project.report import ReconstructionReport
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe, recipe_names
from colmap_affrect.report.run_report import RunReport
from colmap_affrect.session.run_options import RunOptions
from colmap_affrect.stages.extract import extract as extract_features
from colmap_affrect.stages.match import match as match_pairs
from colmap_affrect.stages.one_image import prepare
from colmap_affrect.stages.pairs import choose_pairs
from colmap_affrect.stages.verify import verify_matches

if TYPE_CHECKING:
    from colmap_affrect.comparison.results import Comparison

MAX_PORT = 65_535  # of TCP (theory)


def run(options: argparse.Namespace) -> None:
    recipe = given.recipe(options)
    run_options = RunOptions(
        recipe=recipe,
        database_descriptors=bool(options.database_descriptors),
        extend=given.extension(options),
        by_hand=given.by_hand(options),
        effort=options.effort,
        max_minutes=options.max_minutes,
        command=options.words,
        **given.inputs(options, recipe),
    )
    with given.executor(options) as executor:
        report = pipeline.run(
            options.image_path,
            options.output_path,
            run_options,
            executor=executor,
            overwrite=bool(options.overwrite),
            page=options.page,
            progress=options.progress,
        )
    _print_reconstruction(report, options)


def extract(options: argparse.Namespace) -> None:
    known = RunOptions(**given.inputs(options))
    inputs = known.inputs(options.image_path)
    with given.context(options) as context:
        report = extract_features(
            context, inputs, given.recipe(options), overwrite=bool(options.overwrite)
        )
        if options.database_descriptors:
            fill_descriptors(context.workspace.database, context.features)
        show(report.summary())
    _refuse_failures(report.failures, options)


def stage(options: argparse.Namespace) -> None:
    """Run one stage, with the options on record and those that are given in their place."""
    how = {"overwrite": bool(options.overwrite)}
    with given.context(options) as at:
        match options.command:
            case "pairs":
                report = choose_pairs(
                    at, given.over(at.pairing, options, "pairs"), **how
                )
            case "match":
                report = match_pairs(at, given.matching(at.matching, options), **how)
            case _:
                report = verify_matches(
                    at, given.verification(options, at.verification), **how
                )
        show(report.summary())


def map(options: argparse.Namespace) -> None:
    extend = given.extension(options)
    how = {"overwrite": bool(options.overwrite), "page": options.page}
    if options.from_database:
        report = pipeline.map_database(
            options.from_database,
            options.output_path,
            image_path=options.image_path,
            cameras=given.over(CameraOptions(), options, "cameras"),
            matches_path=options.matches_path,
            match_type=options.match_type or "raw",
            match_list_path=options.match_list_path,
            mapping=given.mapping(options),
            verification=given.verification(options),
            extend=extend,
            by_hand=given.by_hand(options),
            progress=options.progress,
            **how,
        )
    else:
        given.refuse_without_database(options)
        with given.context(options) as context:
            mapper = MAPPERS.make(given.mapping(options, known=context.mapping))
            report = pipeline.map_and_report(context, mapper, extend, **how)
    _print_reconstruction(report, options)


def compare(options: argparse.Namespace) -> None:
    from colmap_affrect.comparison import compare as comparing
    from colmap_affrect.comparison import tables
    from colmap_affrect.comparison.method_run import CompareOptions
    from colmap_affrect.comparison.methods import parse_methods

    comparison = comparing.compare(
        options.image_path,
        options.output_path,
        CompareOptions(
            methods=parse_methods(options.methods, given.depth_settings(options)),
            seeds=options.seeds,
            ground_truth_path=options.ground_truth_path,
            **given.inputs(options),
        ),
        overwrite=bool(options.overwrite),
        progress=replace(options.progress, num_plain_lines=1),
    )
    show(tables.to_json(comparison) if options.json else tables.summary(comparison))
    if not options.json:
        show(f"\npictures: {options.output_path / 'report.html'}")
    _refuse_failed_methods(comparison, options.output_path / "comparison.json")
    _refuse_failures(
        (name for method in comparison.methods for name in method.failures), options
    )


def _refuse_failed_methods(comparison: "Comparison", where: Path) -> None:
    """End with an error if a method failed, or none found a model."""
    failed = [method.name for method in comparison.methods if method.failed]
    if failed:
        names = ", ".join(failed)
        raise AffrectError(f"failed: {names}", advice=f"{where} says why")
    if not any(seed.models for method in comparison.methods for seed in method.seeds):
        raise NoModelError("no method found a model")


def evaluate(options: argparse.Namespace) -> None:
    from colmap_affrect.comparison.methods import parse_methods
    from colmap_affrect.evaluation import evaluate as evaluating
    from colmap_affrect.evaluation.evaluate import EvaluateOptions
    from colmap_affrect.evaluation.truths import ScoreOptions

    evaluation = evaluating.evaluate(
        options.protocol,
        options.dataset_path,
        options.output_path,
        EvaluateOptions(
            recipes=parse_methods(options.recipes, given.depth_settings(options)),
            max_num_keypoints=options.max_num_keypoints,
            scores=ScoreOptions(random_seed=options.random_seed or 0),
            resources=given.resources(options),
        ),
        overwrite=bool(options.overwrite),
        progress=options.progress,
    )
    show(evaluation.to_json() if options.json else evaluation.summary())
    if not options.json:
        show(f"\nall pairs: {options.output_path / 'evaluation.json'}")
    _refuse_failures(
        (name for recipe in evaluation.recipes for name in recipe.failures), options
    )


def import_h5(options: argparse.Namespace) -> None:
    from colmap_affrect.interop import hdf5

    report = hdf5.import_h5(
        options.image_path,
        options.features_path,
        options.matches_path,
        options.database_path,
        match_type=options.match_type or "raw",
        match_list_path=options.match_list_path,
        cameras=given.over(CameraOptions(), options, "cameras"),
        random_seed=options.random_seed or 0,
        progress=options.progress,
    )
    show(report.summary())


def panoramas(options: argparse.Namespace) -> None:
    from colmap_affrect.interop import panoramas as panorama_views

    models = panorama_views.reconstruct_panoramas(
        options.image_path,
        options.target_path,
        order=options.order,
        random_seed=options.random_seed or 0,
        progress=options.progress,
    )
    num_all = len(list_images(options.image_path))
    for number, model in models.items():
        where = options.target_path / "sparse_equirectangular" / str(number)
        show(f"registered  {model.num_reg_images()} of {num_all} panoramas, {where}")
    show(
        f"views       {options.target_path / 'sparse'}, with {options.target_path / 'images'}"
    )


def export_h5(options: argparse.Namespace) -> None:
    from colmap_affrect.interop import hdf5

    report = hdf5.export_h5(
        options.database_path,
        options.features_path,
        options.matches_path,
        progress=options.progress,
    )
    show(report.summary())


def export_database(options: argparse.Namespace) -> None:
    from colmap_affrect.colmap import old_databases

    number = old_databases.export_database(
        options.path, options.database_path, descriptors=bool(options.descriptors)
    )
    show(
        f"{options.database_path}: for COLMAP {options.colmap} to 3.13; {number or 'no'} images "
        "have descriptors, which COLMAP's own matchers need (--descriptors)\n"
        "then, for few photographs (the folder of models must be there): colmap mapper "
        f"--database_path {options.database_path} --image_path PHOTOS --output_path MODELS "
        f"{old_databases.MAPPER_OPTIONS}"
    )


def export(options: argparse.Namespace) -> None:
    from colmap_affrect.interop import export as exporting

    written = exporting.export(
        options.model_path,
        options.target_path,
        options.format,
        image_path=options.image_path,
        camera_model=options.camera_model or "",
        note=show,
    )
    for name, path in written.items():
        show(f"{name:11s} {path}")


def align(options: argparse.Namespace) -> None:
    from colmap_affrect.interop import align as aligning

    reference = aligning.Reference(
        gps_database=options.gps,
        positions_path=options.positions,
        points_path=options.points,
        distances=tuple(options.distance),
    )
    show(aligning.align(options.model_path, options.target_path, reference).summary())
    show(f"model       {options.target_path}")


def doctor(options: argparse.Namespace) -> int | None:
    from colmap_affrect import doctor as examination

    diagnosis = examination.diagnose(options.path, weights_path=options.weights)
    show(diagnosis.to_json() if options.json else diagnosis.summary())
    return 1 if diagnosis.num_errors else None


def _print_reconstruction(
    report: ReconstructionReport, options: argparse.Namespace
) -> None:
    show(
        report.to_json()
        if options.json
        else report.summary(with_warnings=options.quiet)
    )
    workspace = Workspace(options.output_path)
    if not (options.json or options.quiet):
        show("\n".join(_next_steps(report, workspace)))
    why = report.why_no_model
    if report.status == "doubtful":
        why = "nothing in the model can be trusted: it is doubtful throughout, but written"
    if why:
        where = workspace.page if workspace.page.exists() else workspace.report
        raise NoModelError(why, advice=f"see {where}")
    _refuse_failures(report.failures, options)


def _next_steps(report: ReconstructionReport, workspace: Workspace) -> list[str]:
    """Say where the results are, and with which commands to go on."""
    photos = workspace.photographs()
    model = workspace.path / "sparse" / "0"
    page = f", to look at: {workspace.page}" if workspace.page.exists() else ""
    lines = [f"results     {workspace.path}{page}"]
    if report.status not in ("ok", "partial"):
        return lines
    places = [
        "--model-path",
        str(model),
        "--output-path",
        str(workspace.path / "export"),
    ]
    lines += ["next", f"            colmap-affrect export {shlex.join(places)}"]
    if shutil.which("colmap"):
        mapped = workspace.mapped_database
        database = mapped if mapped.exists() else workspace.database
        look = ["--import_path", str(model), "--database_path", str(database)]
        look += ["--image_path", str(photos)] if photos else []
        lines.append(f"            colmap gui {shlex.join(look)}")
    return lines


def _refuse_failures(failures: Iterable[str], options: argparse.Namespace) -> None:
    """End with an error if more images than allowed could not be read."""
    names = list(dict.fromkeys(failures))
    if len(names) > (options.max_failures or 0):
        rest = (
            f"the results are of the others (--max-failures {len(names)} accepts that)"
        )
        raise ImageError(
            f"could not read {len(names)} of the images: {', '.join(names)}",
            advice=rest,
        )


def inspect(options: argparse.Namespace) -> None:
    from colmap_affrect.report.inspection import inspect_image

    recipe = given.recipe(options)
    if not options.image.is_file():
        why = "is a folder" if options.image.is_dir() else "no such file"
        raise OptionError(why, where=options.image, advice="give a photograph")
    photographs = Photographs(
        options.image.parent, given.over(MaskOptions(), options, "masks")
    )
    photographs.check()
    mask = photographs.mask(options.image.name)
    extractor = prepare(
        recipe.extraction, given.resources(options), [options.image.name]
    )
    show(inspect_image(extractor, options.image, options.output_path, mask))


def lines(options: argparse.Namespace) -> None:
    from colmap_affrect.report.line_pictures import report_lines

    found = report_lines(options.photographs, options.target_path)
    show(found.to_json() if options.json else found.summary())
    _refuse_failures(found.failures, options)


def serve(options: argparse.Namespace) -> None:
    from colmap_affrect.report import page_server

    by_hand = ByHand(rejected=tuple(options.rejected), left_out=tuple(options.left_out))
    port = page_server.PORT if options.port is None else options.port
    if port > MAX_PORT:
        raise OptionError(f"give a number up to {MAX_PORT}", where=Option("port", port))

    def map_images(said: ByHand, progress: Progress) -> RunReport:
        return single_stages.map_images(options.path, by_hand=said, progress=progress)

    page_server.serve(Workspace(options.path), by_hand, port, map_images, show)


def show_runs(options: argparse.Namespace) -> None:
    from colmap_affrect.report.two_runs import write_two_runs

    page = write_two_runs(
        options.before, options.after, options.page_path, options.progress
    )
    show(f"page        {page}")


def show_pair(options: argparse.Namespace) -> None:
    from colmap_affrect.report.pairs import draw_pair

    photographs = given.folder("image-path", options.image_path)
    show(
        draw_pair(options.path, tuple(options.pair), photographs, options.picture_path)
    )


def convert(options: argparse.Namespace) -> None:
    from colmap_affrect.images.conversion import convert_images

    report = convert_images(options.image_path, options.target_path, options.progress)
    show(report.summary())
    if report.failures:
        names = such_as(sorted(report.failures))
        raise ImageError(f"could not convert {len(report.failures)} files: {names}")


def recipes(options: argparse.Namespace) -> None:
    if options.name:
        show(described_toml(load_recipe(options.name)), end="")
        return
    for name in sorted(
        recipe_names(), key=lambda name: name not in ("default", "rectified")
    ):
        recipe = load_recipe(name)
        needs = list(recipe.required_weights)
        uses = [key for key in recipe.weights if key not in needs]
        more = f", and uses {', '.join(uses)} if it can" if uses else ""
        if recipe.extraction.uses_depth:
            needs.append("depth")
        show(f"{name:28s} {recipe.summary}")
        show(f"{'':28s} needs {', '.join(needs) or 'nothing'}{more}")


def weights(options: argparse.Namespace) -> None:
    keys = _weights_of(options.keys)
    if options.keys and not keys:
        show(f"{', '.join(options.keys)}: no weights are needed")
    elif options.action == "fetch":
        keys = keys or ["affnet", "orinet", "hardnet"]
        fetched = files.fetch(keys, options.weights, progress=options.progress)
        for path in fetched.values():
            show(str(path))
    else:
        folder = given.folder("weights", options.weights)
        for key in keys or files.WEIGHT_FILES:
            _show_weights(key, folder)


def _weights_of(names: Iterable[str]) -> list[str]:
    """Return the keys of files of weights that are named, each once.

    Of a recipe these are those that it needs; ``aliked`` stands for all keys that begin so.
    """
    keys: dict[str, None] = {}
    for name in names:
        if name in recipe_names():
            keys |= dict.fromkeys(load_recipe(name).weights)
            continue
        alike = [
            key
            for key in files.WEIGHT_FILES
            if key == name or key.startswith(f"{name}-")
        ]
        keys |= dict.fromkeys(alike or [name])
    return list(keys)


def _show_weights(key: str, folder: Path | None) -> None:
    """Print what a file of weights is for, and where it is."""
    path = files.find(key, folder)
    file = files.WEIGHT_FILES[key]
    if not path:
        where = f"not found: {', or '.join(files.commands_for([key]))}"
    elif files.is_published(key, path) is False:
        where = f"{path}, NOT the published file: unless it is your own, {files.remedy(path)}"
    else:
        where = str(path)
    show(f"{key:32s} {file.used_for}, {file.file_name}\n    {where}")
    show(
        f"    sha256 {file.sha256 or 'not known'}; licence {file.licence or 'not stated'}"
    )
