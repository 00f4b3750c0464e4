"""From a verified database to a folder of models, by any mapper.

A summary of each finished model is kept beside it: COLMAP's files cannot hold it all.
"""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.model_files import (
    SUMMARY,
    file_digests,
    require_intact,
    write_model,
)
from colmap_affrect.errors import WorkspaceError, damage, how_to_make_again
from colmap_affrect.mappers.base import MappedModel, Mapper, MappingTask
from colmap_affrect.mappers.last_points import LastPoints
from colmap_affrect.mappers.other_cameras import OtherCameras
from colmap_affrect.mappers.pair_graph import (
    MIN_NUM_MATCHES,
    Ids,
    PairGraph,
    cameras_of,
    graph_of,
    poses_of,
)
from colmap_affrect.mappers.same_viewpoint import same_viewpoint_pairs
from colmap_affrect.mappers.scored_models import ScoredModel, scored_places
from colmap_affrect.mappers.snapshots import with_snapshots
from colmap_affrect.mappers.tie_points import tie_points_of
from colmap_affrect.mappers.wrong_models import (
    NUM_OTHER_HYPOTHESES,
    WITHOUT_FALSE_PAIRS,
    ThrownAway,
    pairs_stood_on,
    pairs_to_leave_out,
    thrown_away_of,
    write_thrown_away,
)
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.reasons import Doubt
from colmap_affrect.project.report import (
    DOUBTFUL,
    SURE,
    ModelSummary,
    kept_probability,
)
from colmap_affrect.project.sealed_json import read_sealed, write_sealed

ENOUGH_OF_SMALL_SET = 0.8  # of all images: such a model is never too small (COLMAP)
# What was begun is removed while a call of COLMAP may still write there.
NUM_REMOVALS = 5  # times that this is tried; resource
REMOVAL_INTERVAL_S = 0.05  # between them; resource


@dataclass(frozen=True)
class Findings:
    """What mapping that goes on from a model cannot find again."""

    other_cameras: OtherCameras | None = None
    """One camera in the place of own ones: which photographs shared it at first is not tried
    again."""
    share_as_modelled: float = 1.0
    """As of a :class:`MappedModel`, before cameras were freed."""


@dataclass(frozen=True)
class _SummaryFile:
    model: dict[str, str]  # digests of its files by name
    summary: ModelSummary
    findings: Findings = Findings()


_SUMMARY_FILE = TypeAdapter(_SummaryFile)


def write_summary(
    summary: ModelSummary, folder: Path, findings: Findings | None = None
) -> None:
    """Keep the summary of the model in a folder.

    Args:
        summary: Of the model.
        folder: Of the model.
        findings: What mapping that goes on from it needs; by default nothing was found.
    """
    content = _SummaryFile(file_digests(folder), summary, findings or Findings())
    write_sealed(folder / SUMMARY, _SUMMARY_FILE.dump_json(content))


def copy_with_keypoints(folder: Path, target: Path, database_path: Path) -> None:
    """Copy a model with the keypoints that the database has got since it was made.

    Args:
        folder: Of the model and its summary.
        target: New folder of the copy.
        database_path: The database of the model; new keypoints follow those that there were.
    """
    known = _read_summary_file(folder)
    model = pycolmap.Reconstruction(folder)
    with open_database(database_path) as database:
        for image in model.images.values():
            keypoints = database.read_keypoints(image.image_id)
            new = keypoints[image.num_points2D() :, :2].astype(np.float64)
            for xy in new:
                image.points2D.append(pycolmap.Point2D(xy))
    write_model(model, target)
    write_summary(known.summary, target, known.findings)


def read_summary(folder: Path) -> ModelSummary:
    """Return the summary of the model in a folder.

    StoreError if there is none, or it or the model is damaged: somebody may have edited the model.
    """
    return _read_summary_file(folder).summary


def _read_summary_file(folder: Path) -> _SummaryFile:
    require_intact(folder)
    again = how_to_make_again("map", folder.parent.parent)
    mend = f"if you have edited the model, copy it to a folder of its own; then {again}"
    with damage(folder / SUMMARY, mend):
        return _SUMMARY_FILE.validate_python(read_sealed(folder / SUMMARY))


def read_summaries(sparse_path: Path) -> list[ModelSummary]:
    """Return the summaries of the models that mapping has written, in their order."""
    return [read_summary(folder) for folder in model_folders(sparse_path)]


def read_models(sparse_path: Path) -> list[MappedModel]:
    """Return the models that mapping has written, in their order, to go on from them.

    StoreError as :func:`read_summary`.
    """
    models = list[MappedModel]()
    for folder in model_folders(sparse_path):
        known = _read_summary_file(folder)
        models.append(
            MappedModel(
                reconstruction=pycolmap.Reconstruction(folder),
                bridges=known.summary.bridges,
                hypotheses=known.summary.hypotheses,
                other_cameras=known.findings.other_cameras,
                share_as_modelled=known.findings.share_as_modelled,
            )
        )
    return models


def model_folders(sparse_path: Path) -> list[Path]:
    """Return the folders of the models that mapping has written, 0, 1, ..."""
    folders = sparse_path.iterdir() if sparse_path.is_dir() else ()
    return sorted((p for p in folders if p.name.isdecimal()), key=lambda p: int(p.name))


class _Progress:
    """Passes on by how many images the largest model has grown."""

    def __init__(self, next_image: Callable[[int], None], num_images: int) -> None:
        self.next_image = next_image
        self.num_images = num_images
        self._num_shown = 0
        self._lock = threading.Lock()  # several models may grow at once

    def show(self, count: int) -> None:
        """Take the number of images of any model."""
        with self._lock:
            num_new = min(count, self.num_images) - self._num_shown
            if num_new > 0:
                self._num_shown += num_new
                self.next_image(num_new)


def map_database(
    mapper: Mapper,
    task: MappingTask,
    sparse_path: Path,
    next_image: Callable[[int], None],
) -> list[ModelSummary]:
    """Map a verified database and write the models to ``sparse_path``/0, /1, ..., largest first.

    Images that are surely wrong are taken out (:mod:`colmap_affrect.mappers.reliability`), but not
    of a model that is extended. ``sparse_path`` appears only once all models are written, and
    what was in it, perhaps the model that is extended, stays there until then.

    Args:
        mapper: Makes the models.
        task: What to map.
        sparse_path: Folder of the models.
        next_image: Called with the number of images registered since the last call, never more
            than there are, also when a mapper tries several models.

    Returns:
        The summaries of the models, in their order.

    Raises:
        AffrectError: When COLMAP ends with an error.
        KeyboardInterrupt: After mapping has been stopped, of which snapshots alone stay.
    """
    partial = sparse_path.with_name(sparse_path.name + ".partial")
    snapshots = sparse_path.with_name(sparse_path.name + ".snapshots")
    keeps_models = task.extend or task.previous_models
    remove_own([partial] if keeps_models else [partial, sparse_path])
    graph = graph_of(task, MIN_NUM_MATCHES)
    num_images = len(graph.names)
    least = 1 if task.extend else mapper.options.min_model_size
    least = max(1, min(least, int(ENOUGH_OF_SMALL_SET * num_images)))
    progress = _Progress(next_image, num_images)
    judged = _Judged(task, least)
    last_points = LastPoints()
    try:
        with with_snapshots(task, mapper.options, snapshots, num_images) as whole:
            raw = partial / "raw"
            raw.mkdir(parents=True)
            found = mapper.map(whole, raw, mapper.options.random_seed, progress.show)
            last_points.begin(found)
            judged.add(found)
            _map_without_false_pairs(mapper, judged, raw, progress)
            remove_own([raw])
        judged.kept.sort(key=lambda model: model.size, reverse=True)
        _pass_on_reasons(judged.scored, judged.kept)
        summaries = _write_models(judged.kept, task, last_points, partial)
        write_thrown_away(judged.thrown_away(), partial)
        remove_own([sparse_path])
        partial.rename(sparse_path)
    finally:
        _remove_unfinished(partial)
    return summaries


class _Judged:
    """Models that were made, with their images scored, and what is left of them."""

    def __init__(self, task: MappingTask, least: int) -> None:
        """Begin without models.

        Args:
            task: What is mapped.
            least: Images of a model that is kept.
        """
        self.task = task
        self.graph = graph_of(task, MIN_NUM_MATCHES)
        self.least = least
        self.kept = list[ScoredModel]()
        self.stood_on = set[Ids]()
        """Pairs that models stood on of which nothing is left."""
        self._of_wrong_models = set[int]()  # images of these models
        self.scored = list[ScoredModel]()

    def add(self, found: Sequence[MappedModel]) -> None:
        """Score models, and keep what is large enough of them."""
        for mapped in found:
            poses = poses_of(mapped.reconstruction)  # before images leave it
            cameras = cameras_of(mapped.reconstruction)
            scored = scored_places(mapped, self.task)
            self.scored += scored
            self.kept += [one for one in scored if len(one.confidences) >= self.least]
            if not any(one.confidences for one in scored):
                self.stood_on |= pairs_stood_on(self.graph, poses, cameras)
                self._of_wrong_models.update(poses)

    def image_ids_left(self) -> set[int]:
        """Return the images that no model has, where one was thrown away; else none.

        Also those that were in none: pairs may tie them to images of the wrong one.
        """
        if not self._of_wrong_models:
            return set()
        left = set(self.graph.keypoints)
        for model in self.kept:
            left.difference_update(model.mapped.reconstruction.reg_image_ids())
        return left

    def _doubts_of_missing(self) -> dict[str, tuple[Doubt, ...]]:
        """Return why images that no model has were taken out of theirs, by name."""
        inside = set[str]()
        for model in self.kept:
            inside |= model.confidences.keys()
        found = dict[str, tuple[Doubt, ...]]()
        for model in self.scored:
            for name, one in model.taken_out.items():
                if name not in inside:
                    found.setdefault(name, one.reasons)
        return found

    def thrown_away(self) -> ThrownAway:
        """Return what is known of images of models of which nothing is left."""
        left = self.image_ids_left() & self._of_wrong_models
        doubts = self._doubts_of_missing()
        of_them = dict[str, tuple[Doubt, ...]]()
        for name in sorted(self.graph.names[image_id] for image_id in left):
            if name in doubts:
                of_them[name] = doubts[name]
        return thrown_away_of(self.graph, of_them, self.stood_on)


def _pass_on_reasons(
    models: Sequence[ScoredModel], kept: Sequence[ScoredModel]
) -> None:
    """Let the first model that is kept say of images of dropped ones why they were taken out."""
    inside = set[str]()
    for model in kept:
        inside |= model.confidences.keys() | model.taken_out.keys()
    for model in models:
        for name, one in model.taken_out.items():
            if kept and name not in inside:
                kept[0].taken_out[name] = one


def _map_without_false_pairs(
    mapper: Mapper, judged: _Judged, folder: Path, progress: _Progress
) -> None:
    """Map photographs of wrong models once more, without the pairs that these stood on.

    Args:
        mapper: Makes the models.
        judged: Gets the models.
        folder: Of what mappers write.
        progress: Is told of images.
    """
    for number in range(NUM_OTHER_HYPOTHESES):
        image_ids = judged.image_ids_left()
        if not 0 < len(image_ids) < mapper.options.max_images_of_some_pairs:
            return
        left_out = pairs_to_leave_out(judged.graph, image_ids, judged.stood_on)
        if not left_out:
            return
        other = replace(judged.task, previous_models=(), without_pairs=left_out)
        output_path = folder / f"other-{number}"
        output_path.mkdir()
        seed = mapper.options.random_seed
        found = mapper.map(other, output_path, seed, progress.show)
        if not found:
            return
        judged.add([mapped.also_by(WITHOUT_FALSE_PAIRS) for mapped in found])


def _remove_unfinished(partial: Path) -> None:
    """Remove what mapping has not finished; a call of COLMAP that was left may still write there.

    What stays nevertheless, the next mapping removes.
    """
    for _ in range(NUM_REMOVALS):
        try:
            remove_own([partial])
            return
        except WorkspaceError:
            time.sleep(REMOVAL_INTERVAL_S)


def _write_models(
    models: Sequence[ScoredModel],
    task: MappingTask,
    last_points: LastPoints,
    folder: Path,
) -> list[ModelSummary]:
    """Write models, with their last points, and their summaries.

    Args:
        models: In the order of their numbers.
        task: What they were made from.
        last_points: Adds these points.
        folder: Of the models.
    """
    summaries = list[ModelSummary]()
    for index, model in enumerate(models):
        path = folder / str(index)
        finished = last_points.added_to(model.mapped)
        model.mapped = replace(model.mapped, reconstruction=finished)
        write_model(finished, path)
        summary = _summary(model, task)
        other = model.mapped.other_cameras
        findings = Findings(
            other_cameras=other if other and other.are_shared else None,
            share_as_modelled=model.mapped.share_as_modelled,
        )
        write_summary(summary, path, findings)
        summaries.append(summary)
    return summaries


def _summary(scored: ScoredModel, task: MappingTask) -> ModelSummary:
    """Count what a model holds, and say how sure it is of each photograph."""
    model = scored.mapped.reconstruction
    graph = graph_of(task, MIN_NUM_MATCHES)
    confidences = scored.confidences
    images = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    focals_px = {
        i.name: float(model.cameras[i.camera_id].mean_focal_length()) for i in images
    }
    bridges = scored.mapped.bridges
    everybody = {**scored.taken_out, **confidences}
    probabilities = {}
    doubtful = {}
    unsure = {}
    for name, one in confidences.items():
        kept = kept_probability(one.probability)
        probabilities[name] = kept
        if kept < DOUBTFUL:
            doubtful[name] = one.reasons
        elif kept < SURE:
            unsure[name] = one.reasons
    return ModelSummary(
        registered_names=tuple(sorted(focals_px)),
        num_points3D=model.num_points3D(),
        mean_track_length=float(model.compute_mean_track_length()),
        mean_reprojection_error_px=float(model.compute_mean_reprojection_error()),
        probabilities=probabilities,
        gains={name: round(one.gain, 3) for name, one in everybody.items()},
        doubtful=doubtful,
        unsure=unsure,
        bridges={name: bridge for name, bridge in bridges.items() if name in focals_px},
        taken_out={name: one.reasons for name, one in scored.taken_out.items()},
        focals_px=focals_px,
        hypotheses=scored.mapped.hypotheses,
        tie_points=tie_points_of(task, graph).report(model),
        one_view=_same_viewpoint_names(model, graph, task),
        principal_point_contradictions=tuple(scored.contradictions),
    )


def _same_viewpoint_names(
    model: pycolmap.Reconstruction, graph: PairGraph, task: MappingTask
) -> tuple[tuple[str, str], ...]:
    """Return the names of pairs in a model that were taken from the same viewpoint."""
    registered = set(model.reg_image_ids())
    found = list[tuple[str, str]]()
    for first, second in sorted(same_viewpoint_pairs(graph, task.image_path)):
        if first in registered and second in registered:
            found.append((graph.names[first], graph.names[second]))
    return tuple(found)
