"""From a verified database to a folder of models, by any mapper.

A summary of each finished model is kept beside it: COLMAP's files cannot hold it all.
"""

import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
from colmap_affrect.mappers.focal_observability import focal_growths
from colmap_affrect.mappers.given_principal_points import contradicted_principal_points
from colmap_affrect.mappers.other_motions import share_of_motion
from colmap_affrect.mappers.pair_graph import (
    MIN_NUM_MATCHES,
    MIN_SHARE,
    PairGraph,
    cameras_of,
    graph_of,
    poses_of,
)
from colmap_affrect.mappers.reliability import (
    NUM_REASONS,
    Confidence,
    score_images,
    share_within_limit,
)
from colmap_affrect.mappers.same_viewpoint import same_viewpoint_pairs
from colmap_affrect.mappers.snapshots import with_snapshots
from colmap_affrect.mappers.surer_apart import surer_apart
from colmap_affrect.mappers.surroundings import apart, known_places
from colmap_affrect.mappers.tie_points import tie_points_of
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.reasons import Doubt
from colmap_affrect.project.report import (
    DOUBTFUL,
    SURE,
    ModelSummary,
    PrincipalPointContradiction,
    kept_probability,
)
from colmap_affrect.project.sealed_json import read_sealed, write_sealed

MIN_PROBABILITY = 0.05
"""Images leave their model below this probability: nineteen of twenty such poses are wrong
(theory)."""
ENOUGH_OF_SMALL_SET = 0.8  # of all images: such a model is never too small (COLMAP)
# What was begun is removed while a call of COLMAP may still write there.
NUM_REMOVALS = 5  # times that this is tried; resource
REMOVAL_INTERVAL_S = 0.05  # between them; resource


@dataclass(frozen=True)
class _SummaryFile:
    model: dict[str, str]  # digests of its files by name
    summary: ModelSummary


_SUMMARY_FILE = TypeAdapter(_SummaryFile)


def write_summary(summary: ModelSummary, folder: Path) -> None:
    """Keep the summary of the model in a folder."""
    content = _SummaryFile(file_digests(folder), summary)
    write_sealed(folder / SUMMARY, _SUMMARY_FILE.dump_json(content))


def copy_with_keypoints(folder: Path, target: Path, database_path: Path) -> None:
    """Copy a model with the keypoints that the database has got since it was made.

    Args:
        folder: Of the model and its summary.
        target: New folder of the copy.
        database_path: The database of the model; new keypoints follow those that there were.
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
    again = how_to_make_again("map", folder.parent.parent)
    mend = f"if you have edited the model, copy it to a folder of its own; then {again}"
    with damage(folder / SUMMARY, mend):
        return _SUMMARY_FILE.validate_python(read_sealed(folder / SUMMARY)).summary


def read_summaries(sparse_path: Path) -> list[ModelSummary]:
    """Return the summaries of the models that mapping has written, in their order."""
    return [read_summary(folder) for folder in model_folders(sparse_path)]


def model_folders(sparse_path: Path) -> list[Path]:
    """Return the folders of the models that mapping has written, 0, 1, ..."""
    folders = sparse_path.iterdir() if sparse_path.is_dir() else ()
    return sorted((p for p in folders if p.name.isdecimal()), key=lambda p: int(p.name))


@dataclass
class _ScoredModel:
    """A model and the confidence in its images."""

    mapped: MappedModel
    # Of its images, by name
    confidences: dict[str, Confidence] = field(default_factory=dict)
    # Of images that it has lost
    taken_out: dict[str, Confidence] = field(default_factory=dict)
    contradictions: Sequence[PrincipalPointContradiction] = ()

    @property
    def size(self) -> tuple[int, int]:
        """Numbers of images and points."""
        model = self.mapped.reconstruction
        return model.num_reg_images(), model.num_points3D()


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
    num_images = len(graph_of(task, MIN_NUM_MATCHES).names)
    progress = _Progress(next_image, num_images)
    try:
        with with_snapshots(task, mapper.options, snapshots, num_images) as whole:
            raw = partial / "raw"
            raw.mkdir(parents=True)
            found = mapper.map(whole, raw, mapper.options.random_seed, progress.show)
            remove_own([raw])
        scored = list[_ScoredModel]()
        for model in found:
            scored += _scored_places(model, task)
        min_model_size = 1 if task.extend else mapper.options.min_model_size
        kept = _large_enough(scored, min_model_size, num_images)
        kept.sort(key=lambda model: model.size, reverse=True)
        _pass_on_reasons(scored, kept)
        summaries = _write_models(kept, task, partial)
        remove_own([sparse_path])
        partial.rename(sparse_path)
    finally:
        _remove_unfinished(partial)
    return summaries


def _large_enough(
    models: Sequence[_ScoredModel], min_model_size: int, num_images: int
) -> list[_ScoredModel]:
    """Return the models that are large enough, for the number of all images."""
    least = max(1, min(min_model_size, int(ENOUGH_OF_SMALL_SET * num_images)))
    return [model for model in models if len(model.confidences) >= least]


def _pass_on_reasons(models: Sequence[_ScoredModel], kept: list[_ScoredModel]) -> None:
    """Let the first model that is kept say of images of dropped ones why they were taken out."""
    inside = set[str]()
    for model in kept:
        inside |= model.confidences.keys() | model.taken_out.keys()
    for model in models:
        for name, one in model.taken_out.items():
            if kept and name not in inside:
                kept[0].taken_out[name] = one


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
    models: Sequence[_ScoredModel], task: MappingTask, folder: Path
) -> list[ModelSummary]:
    """Write models, with their last points, and their summaries.

    Args:
        models: In the order of their numbers.
        task: What they were made from.
        folder: Of the models.
    """
    summaries = list[ModelSummary]()
    for index, model in enumerate(models):
        path = folder / str(index)
        if model.mapped.add_last_points:
            model.mapped.add_last_points(model.mapped.reconstruction)
        write_model(model.mapped.reconstruction, path)
        summary = _summary(model, task)
        write_summary(summary, path)
        summaries.append(summary)
    return summaries


def _scored_places(mapped: MappedModel, task: MappingTask) -> list[_ScoredModel]:
    """Return a model for each place that a model holds, the largest first, with all scored.

    A model that is extended stays whole, what a person has tied by hand, and rigs.
    """
    graph = graph_of(task, MIN_NUM_MATCHES)
    if task.extend or task.tie_points or graph.has_rigs:
        whole = _without_wrong_images(mapped, task)
        _doubt_motion(whole, task)
        return [whole]
    places = known_places(mapped, graph)
    places = surer_apart(mapped, places, lambda one: _probabilities(one, task))
    largest, *others = apart(mapped, places)
    scored = _without_wrong_images(largest, task)
    for name, doubt in mapped.apart.items():
        scored.taken_out[name] = Confidence(0.0, (doubt,))
    found = [scored]
    for other in others:
        names = [graph.names[i] for i in sorted(other.reconstruction.reg_image_ids())]
        for name in names:
            scored.taken_out[name] = Confidence(0.0, (Doubt(places.why),))
        if len(names) > 1:
            found.append(_without_wrong_images(other, task))
    for model in found:
        _doubt_motion(model, task)
        for image_id in places.collages:
            _doubt(model, graph.names[image_id], 0.5, Doubt("two_places"))
        for image_id, share in places.unclear.items():
            _doubt(model, graph.names[image_id], share, Doubt("other_surroundings"))
    return found


def _probabilities(mapped: MappedModel, task: MappingTask) -> dict[int, float]:
    """Return the probability of each image that stays in a model, which is changed."""
    confidences = _without_wrong_images(mapped, task).confidences
    found = dict[int, float]()
    for name, one in confidences.items():
        image_id = mapped.reconstruction.find_image_with_name(name).image_id
        found[image_id] = one.probability
    return found


def _doubt_motion(model: _ScoredModel, task: MappingTask) -> None:
    """Doubt a model where something moves in another way: that may be the scene as well."""
    graph = graph_of(task, MIN_NUM_MATCHES)
    found = share_of_motion(model.mapped.reconstruction, graph)
    share = min(found, model.mapped.motion_share)
    if share < 1.0:
        doubt = Doubt("something_moves", {"percent": math.floor(100.0 * share)})
        for name in list(model.confidences):
            _doubt(model, name, share, doubt)


def _doubt_given_principal_points(scored: _ScoredModel, task: MappingTask) -> None:
    """Doubt rotations that hang on given principal points which the points contradict."""
    model = scored.mapped.reconstruction
    scored.contradictions = contradicted_principal_points(model, task)
    for one in scored.contradictions:
        for name, turn_deg in one.turns_deg.items():
            values = {
                "given_x_px": one.given_px[0],
                "given_y_px": one.given_px[1],
                "fitting_x_px": one.fitting_px[0],
                "fitting_y_px": one.fitting_px[1],
                "turn_deg": turn_deg,
            }
            doubt = Doubt("principal_point_contradicted", {**values})
            _doubt(scored, name, share_within_limit(turn_deg), doubt)


def _doubt(model: _ScoredModel, name: str, share: float, doubt: Doubt) -> None:
    """Multiply the probability of an image, if it is there.

    Args:
        model: Is changed.
        name: Of the image.
        share: Factor of the probability.
        doubt: The reason.
    """
    known = model.confidences.get(name)
    if known:
        others = known.reasons if known.probability < SURE else ()  # of sure ones: none
        reasons = (doubt, *others)[:NUM_REASONS]
        model.confidences[name] = replace(
            known, probability=share * known.probability, reasons=reasons
        )


def _without_wrong_images(mapped: MappedModel, task: MappingTask) -> _ScoredModel:
    """Take out the images that are surely wrong, the worst one first, and score all.

    The reconstruction itself is changed; nothing is left of it with fewer than two images. Of a rig
    all images leave that were taken at once. Those of a model that is extended stay.
    """
    model = mapped.reconstruction
    scored = _ScoredModel(mapped)
    growths = focal_growths(model, task)
    is_stale = False  # growths are of a model with a few images more
    while model.num_reg_images() > 1:
        confidences = _best_of_frames(model, score_images(mapped, task, growths))
        worst = min(confidences, key=lambda name: confidences[name].of_evidence)
        is_wrong = confidences[worst].of_evidence < MIN_PROBABILITY and not task.extend
        if is_wrong:
            for name in _deregister(model, worst):
                scored.taken_out[name] = confidences[worst]
            is_stale = True
        elif is_stale:
            growths = focal_growths(model, task)
            is_stale = False
        else:
            scored.confidences = _no_surer_than_ties(confidences, mapped, task)
            _doubt_given_principal_points(scored, task)
            return scored
    return scored


def _no_surer_than_ties(
    confidences: Mapping[str, Confidence], mapped: MappedModel, task: MappingTask
) -> dict[str, Confidence]:
    """Return confidences of which those of bridged images are at most what they hang on.

    A bridged image hangs on the surest image that an agreeing pair ties it to; where that is a
    bridged one, on what that hangs on, too. So what counts is the way to an image that was not
    bridged whose least sure image is surest. Images that no such way leads to stay as they are.

    Args:
        confidences: By image name.
        mapped: The model.
        task: What it was made from.
    """
    if not mapped.bridges:
        return dict(confidences)
    partners = _agreeing_partners(mapped, task)
    left = sorted(mapped.bridges.keys() & confidences.keys())
    found = {name: one for name, one in confidences.items() if name not in left}
    while left:
        best: tuple[float, str, str] | None = None
        for name in left:
            for other in sorted(partners[name] & found.keys()):
                probability = found[other].probability
                if best is None or probability > best[0]:
                    best = probability, name, other
        if best is None:
            break
        _, name, other = best
        found[name] = _no_surer_than(confidences[name], other, found[other])
        left.remove(name)
    return {name: found.get(name, one) for name, one in confidences.items()}


def _no_surer_than(one: Confidence, other_name: str, other: Confidence) -> Confidence:
    """Return the confidence in an image that hangs on another one, whose name the reason says."""
    if other.probability >= one.probability:
        return one
    percent = math.floor(100.0 * other.probability)
    doubt = Doubt("hangs_on", {"other": other_name, "percent": percent})
    reasons = (doubt, *one.reasons)[:NUM_REASONS]
    return replace(one, probability=other.probability, reasons=reasons)


def _agreeing_partners(
    mapped: MappedModel, task: MappingTask
) -> defaultdict[str, set[str]]:
    """Return the images that pairs which agree with a model tie each of its images to, by name."""
    graph = graph_of(task, MIN_NUM_MATCHES)
    poses = poses_of(mapped.reconstruction)
    cameras = cameras_of(mapped.reconstruction)
    partners = defaultdict[str, set[str]](set)
    for pair in graph.pairs_inside(poses):
        if graph.agreement(pair, poses, cameras) >= MIN_SHARE:
            first, second = (graph.names[image_id] for image_id in pair.ids)
            partners[first].add(second)
            partners[second].add(first)
    return partners


def _deregister(model: pycolmap.Reconstruction, name: str) -> list[str]:
    """Deregister an image with all that a rig took with it; return their names."""
    frame_id = model.find_image_with_name(name).frame_id
    names = list[str]()
    for image in model.images.values():
        if image.frame_id == frame_id and image.has_pose:
            names.append(image.name)
    model.deregister_frame(frame_id)
    return names


def _best_of_frames(
    model: pycolmap.Reconstruction, confidences: Mapping[str, Confidence]
) -> dict[str, Confidence]:
    """Return for each image the confidence in the surest one that a rig took with it.

    A rig is rigid: where the pose of one of its images is right, that of the others is, which may
    see next to nothing.
    """
    frames = {name: model.find_image_with_name(name).frame_id for name in confidences}
    best = dict[int, Confidence]()
    for name, confidence in confidences.items():
        known = best.get(frames[name])
        if not known or confidence.probability > known.probability:
            best[frames[name]] = confidence
    return {name: best[frame_id] for name, frame_id in frames.items()}


def _summary(scored: _ScoredModel, task: MappingTask) -> ModelSummary:
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
