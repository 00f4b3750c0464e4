"""From a verified database to a folder of models, by any mapper.

What is known of finished models is kept beside them: COLMAP's files cannot hold it all.
"""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.colmap.model_files import SUMMARY, file_digests, require_intact, write_model
from colmap_affrect.errors import damage, made_again
from colmap_affrect.mappers.base import MappedModel, Mapper, MappingTask
from colmap_affrect.mappers.one_view import one_views
from colmap_affrect.mappers.pair_graph import MIN_NUM_MATCHES, graph_of
from colmap_affrect.mappers.reliability import Judgement, focal_growths, judge
from colmap_affrect.mappers.snapshots import with_snapshots
from colmap_affrect.mappers.tie_points import tie_points_of
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.regular_files import read_regular
from colmap_affrect.project.report import DOUBTFUL, SURE, ModelSummary, kept_probability


@dataclass(frozen=True)
class _Kept:
    model: dict[str, str]  # digests of its files by name
    summary: ModelSummary


_KEPT = TypeAdapter(_Kept)


def write_summary(summary: ModelSummary, folder: Path) -> None:
    """Keep the summary of the model in a folder."""
    kept = _Kept(file_digests(folder), summary)
    replace_text(folder / SUMMARY, _KEPT.dump_json(kept, indent=2).decode())


def copy_with_keypoints(folder: Path, target: Path, database_path: Path) -> None:
    """Copy a model with the keypoints that the database has got since it was made.

    Args:
        folder: of the model and its summary.
        target: new folder of the copy.
        database_path: the database of the model; new keypoints follow those that there were.
    """
    summary = read_summary(folder)
    model = pycolmap.Reconstruction(folder)
    with open_database(database_path) as database:
        for image in model.images.values():
            keypoints = database.read_keypoints(image.image_id)
            new = keypoints[image.num_points2D() :, :2].astype(np.float64)
            for xy in new:
                image.points2D.append(pycolmap.Point2D(xy))
    write_model(model, target)
    write_summary(summary, target)


def read_summary(folder: Path) -> ModelSummary:
    """Return the summary of the model in a folder.

    StoreError if there is none, or it or the model is damaged: somebody may have edited the model.
    """
    require_intact(folder)
    again = made_again("map", folder.parent.parent)
    mend = f"if you have edited the model, copy it to a folder of its own; then {again}"
    with damage(folder / SUMMARY, mend):
        return _KEPT.validate_json(read_regular(folder / SUMMARY)).summary


def read_summaries(sparse_path: Path) -> list[ModelSummary]:
    """Return the summaries of the models that mapping has written, in their order."""
    return [read_summary(folder) for folder in model_folders(sparse_path)]


def model_folders(sparse_path: Path) -> list[Path]:
    """Return the folders of the models that mapping has written, 0, 1, ..."""
    folders = sparse_path.iterdir() if sparse_path.is_dir() else ()
    return sorted((p for p in folders if p.name.isdecimal()), key=lambda p: int(p.name))


Judgements = Mapping[str, Judgement]  # by the names of the images
WRONG = 0.05  # probability below which an image leaves its model: nineteen of twenty are wrong
NUM_REMOVALS, BETWEEN_REMOVALS_S = 5, 0.05  # of what was begun, while a call still writes there


def map_database(
    mapper: Mapper, task: MappingTask, sparse_path: Path, next_image: Callable[[int], None]
) -> list[ModelSummary]:
    """Map a verified database and write the models to ``sparse_path``/0, /1, ..., largest first.

    Images that are surely wrong are taken out (:mod:`colmap_affrect.mappers.reliability`), but not
    of a model that is extended. ``sparse_path`` appears only once all models are written, and
    what was in it, perhaps the model that is extended, stays there until then.

    ``next_image`` is called with the number of images registered since the last call, never more
    than there are, also when a mapper tries several models. AffrectError when COLMAP ends with an
    error; KeyboardInterrupt after mapping has been stopped, of which snapshots alone stay.
    """
    partial, snapshots = (
        sparse_path.with_name(sparse_path.name + end) for end in (".partial", ".snapshots")
    )
    remove_own([partial] if task.extend or task.before else [partial, sparse_path])
    num_images = len(image_ids(task.database_path))
    most_shown, lock = 0, threading.Lock()

    def show(count: int) -> None:
        nonlocal most_shown
        with lock:  # several models may grow at once
            news = min(count, num_images) - most_shown
            if news > 0:
                most_shown += news
                next_image(news)

    try:
        with with_snapshots(task, mapper.options, snapshots, num_images) as whole:
            raw = partial / "raw"
            raw.mkdir(parents=True)
            found = mapper.map(whole, raw, mapper.options.random_seed, show)
            remove_own([raw])
        judged = [(model, *_judged(model, task)) for model in found]
        kept = [(model, sure, taken) for model, sure, taken in judged if sure]
        summaries = []
        kept.sort(key=lambda found: -found[0].reconstruction.num_points3D())
        kept.sort(key=lambda found: -found[0].reconstruction.num_reg_images())
        for index, (model, sure, taken) in enumerate(kept):
            if model.finish:
                model.finish()
            write_model(model.reconstruction, partial / str(index))
            summaries.append(_summary(model, sure, taken, task))
            write_summary(summaries[-1], partial / str(index))
        remove_own([sparse_path])
        partial.rename(sparse_path)
    finally:
        _remove_unfinished(partial)
    return summaries


def _remove_unfinished(partial: Path) -> None:
    """Remove what mapping has not finished; a call of COLMAP that was left may still write there.

    What stays nevertheless, the next mapping removes.
    """
    for _ in range(NUM_REMOVALS):
        try:
            remove_own([partial])
            return
        except OSError:
            time.sleep(BETWEEN_REMOVALS_S)


def _judged(mapped: MappedModel, task: MappingTask) -> tuple[Judgements, Judgements]:
    """Take out the images that are surely wrong, the worst one first; judge what is left, and them.

    The reconstruction itself is changed; nothing is left of it with fewer than two images. Of a rig
    all images leave that were taken at once. Those of a model that is extended stay.
    """
    model, taken = mapped.reconstruction, dict[str, Judgement]()
    growths, are_new = focal_growths(model, task), True
    while model.num_reg_images() > 1:
        found = _best_of_frames(model, judge(mapped, task, growths))
        name = min(found, key=lambda name: found[name].probability)
        if task.extend or found[name].probability >= WRONG:
            if are_new:
                return found, taken
            growths, are_new = focal_growths(model, task), True
            continue
        are_new = False
        frame_id = model.find_image_with_name(name).frame_id
        for image in model.images.values():
            if image.frame_id == frame_id and image.has_pose:
                taken[image.name] = found[name]
        model.deregister_frame(frame_id)
    return {}, taken


def _best_of_frames(model: pycolmap.Reconstruction, found: Judgements) -> Judgements:
    """Return of each image the judgement of the surest one that a rig took with it.

    A rig is rigid: where one of its images stands right, the others do, which may see next to
    nothing.
    """
    best = dict[int, Judgement]()
    frames = {name: model.find_image_with_name(name).frame_id for name in found}
    for name, judgement in found.items():
        known = best.get(frames[name])
        if not known or judgement.probability > known.probability:
            best[frames[name]] = judgement
    return {name: best[frame_id] for name, frame_id in frames.items()}


def _summary(
    mapped: MappedModel, found: Judgements, taken: Judgements, task: MappingTask
) -> ModelSummary:
    """Count what a model holds, and say how sure it is of each photograph."""
    model = mapped.reconstruction
    inside, graph = set(model.reg_image_ids()), graph_of(task, MIN_NUM_MATCHES)
    images = [model.images[image_id] for image_id in sorted(inside)]
    alike = sorted(one_views(graph, task.image_path))
    sure_of = {name: kept_probability(one.probability) for name, one in found.items()}
    focals = {i.name: float(model.cameras[i.camera_id].mean_focal_length()) for i in images}
    return ModelSummary(
        registered_names=tuple(sorted(focals)),
        num_points3D=model.num_points3D(),
        mean_track_length=float(model.compute_mean_track_length()),
        mean_reprojection_error_px=float(model.compute_mean_reprojection_error()),
        probabilities=sure_of,
        gains={name: round(one.gain, 3) for name, one in {**taken, **found}.items()},
        doubtful={name: found[name].reason for name, p in sure_of.items() if p < DOUBTFUL},
        unsure={name: found[name].reason for name, p in sure_of.items() if DOUBTFUL <= p < SURE},
        bridges={name: one for name, one in mapped.bridges.items() if name in focals},
        taken_out={name: one.reason for name, one in taken.items()},
        focals_px=focals,
        moves=mapped.moves,
        tie_points=tie_points_of(task, graph).report(model),
        one_view=tuple((graph.names[a], graph.names[b]) for a, b in alike if inside >= {a, b}),
    )
