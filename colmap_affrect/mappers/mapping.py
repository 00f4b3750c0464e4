"""From a verified database to a folder of models, by any mapper."""

import logging
from collections.abc import Callable
from pathlib import Path

from colmap_affrect.colmap.database import image_ids
from colmap_affrect.colmap.model_files import SUMMARY, read_given_model, write_model
from colmap_affrect.mappers.arrivals import arrivals
from colmap_affrect.mappers.base import MappedModel, Mapper, MappingTask
from colmap_affrect.mappers.doubts import FOCAL_DOUBT, find_doubts, without_impossible
from colmap_affrect.mappers.existing import require_extends
from colmap_affrect.mappers.loose_cameras import contradicted_focals, loose_images
from colmap_affrect.mappers.snapshots import snapshots_of, with_snapshots
from colmap_affrect.mappers.summaries import model_folders, read_summary, write_summary
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.report import ModelSummary

logger = logging.getLogger(__name__)


def map_database(
    mapper: Mapper, task: MappingTask, sparse_path: Path, next_image: Callable[[int], None]
) -> list[ModelSummary]:
    """Map a verified database and write the models to ``sparse_path``/0, /1, ..., largest first.

    Images that are certainly wrong are taken out (:mod:`colmap_affrect.mappers.doubts`), but for
    those of a model that is extended. ``sparse_path`` appears only once all models are written, and
    what was in it, perhaps the model that is extended, stays there until then.

    Args:
        mapper: with its options.
        task: what to map.
        sparse_path: folder to make; an old one is replaced.
        next_image: called with the number of images registered since the last call; never
            more than there are, also when a mapper tries several models.

    Raises:
        MappingError: when COLMAP ends with an error.
        KeyboardInterrupt: after mapping has been stopped and what it wrote, but snapshots, removed.
        OptionError: when the mapper cannot extend a model.
    """
    if task.extend:
        require_extends(mapper.options)
    partial = sparse_path.with_name(sparse_path.name + ".partial")
    remove_own([partial] if task.extend else [partial, sparse_path])
    num_images = len(image_ids(task.database_path))
    most_shown = 0

    def show(count: int) -> None:
        nonlocal most_shown
        news = min(count, num_images) - most_shown
        if news > 0:
            most_shown += news
            next_image(news)

    try:
        with with_snapshots(task, mapper.options, snapshots_of(sparse_path), num_images) as kept:
            raw = partial / "raw"
            raw.mkdir(parents=True)
            found = mapper.map(kept, raw, mapper.options.random_seed, show)
            remove_own([raw])
        if not task.extend:  # whose images stay, whatever they are
            found = [model for each in found if (model := without_impossible(each, task))]
        summaries = []
        for index, model in enumerate(sorted(found, key=_size, reverse=True)):
            write_model(model.reconstruction, partial / str(index))
            summaries.append(summarize(model, task, is_largest=index == 0))
            write_summary(summaries[-1], partial / str(index))
        remove_own([sparse_path])
        partial.rename(sparse_path)
    finally:
        remove_own([partial])
    return summaries


def _size(model: MappedModel) -> tuple[int, int]:
    return model.reconstruction.num_reg_images(), model.reconstruction.num_points3D()


def read_models(sparse_path: Path, task: MappingTask) -> list[ModelSummary]:
    """Return the summaries of the models that :func:`map_database` wrote for a task.

    A model whose summary is damaged is judged anew; how it came about is not known any more.
    """
    return [read_summary(path) or _judged_anew(path, task) for path in model_folders(sparse_path)]


def _judged_anew(folder: Path, task: MappingTask) -> ModelSummary:
    logger.warning("%s: %s is missing or damaged; the model is judged anew", folder, SUMMARY)
    return summarize(MappedModel(read_given_model(folder)), task, is_largest=folder.name == "0")


def summarize(mapped: MappedModel, task: MappingTask, *, is_largest: bool) -> ModelSummary:
    """Count what a model holds, and judge it."""
    model = mapped.reconstruction
    loose = loose_images(model, task) if is_largest and not task.extend else ()
    fitting_px = {} if task.extend else contradicted_focals(model, task)
    doubts = find_doubts(mapped, task, loose, fitting_px)
    images = [model.images[image_id] for image_id in model.reg_image_ids()]
    focals = {i.name: float(model.cameras[i.camera_id].mean_focal_length()) for i in images}
    return ModelSummary(
        registered_names=tuple(sorted(focals)),
        num_points3D=model.num_points3D(),
        mean_track_length=float(model.compute_mean_track_length()),
        mean_reprojection_error_px=float(model.compute_mean_reprojection_error()),
        doubtful=dict(doubts.images),
        doubts=doubts.model,
        arrivals=arrivals(mapped, task),
        taken_out=dict(mapped.taken_out),
        focals_px=focals,
        rival_focals_px=dict(mapped.rival_focals_px),
        moves=mapped.moves,
        loose=tuple(name for name, why in doubts.images.items() if why == FOCAL_DOUBT),
    )
