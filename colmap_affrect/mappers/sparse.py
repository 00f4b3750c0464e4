"""The sparse mapper: mapping as one estimate, for small sets with few matches."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import with_shared_cameras
from colmap_affrect.mappers.adjustment import EXIF_SIGMA, NOISE_PX, Adjuster, FocalPrior, priors_of
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.evidence import MIN_GAIN, Evidence
from colmap_affrect.mappers.final_points import complete_points
from colmap_affrect.mappers.incremental import IncrementalMapper, PipelineOptions
from colmap_affrect.mappers.pair_graph import Ids, PairGraph, graph_of, has_rigs
from colmap_affrect.mappers.search import Search, with_own_images
from colmap_affrect.mappers.tie_joining import TieJoiner
from colmap_affrect.mappers.tie_points import tie_points_of
from colmap_affrect.options import within

MEASURED_PAIRS = "with the pairs of measured frames"  # others also verify sides that look the same
ALL_PAIRS = "with all pairs"
SOME_TRACKS = "from some of the tracks"  # the move that makes easy models
AGAIN = "after pairs were matched again"
OWN_CAMERAS = "with a camera for each photograph"
LARGE = 100  # images from which on COLMAP's own pipeline maps


class SparseOptions(PipelineOptions):
    """Incremental mapping with priors of the cameras, and bridges by single pairs."""

    name: Literal["sparse"] = "sparse"
    init_min_num_inliers: Annotated[int, within(1, 1_000_000)] = 40
    init_min_tri_angle_deg: Annotated[float, within(0.0, 180.0)] = 4.0
    noise_px: Annotated[float, within(0.01, 100.0)] = NOISE_PX
    """Standard deviation of keypoints; larger errors count less and less."""
    num_seeds: Annotated[int, within(1, 1000)] = 6
    """First pairs in a row that bring nothing, after which no others are tried."""


class SparseMapper(IncrementalMapper):
    """Maps small sets as one estimate; large ones, and into a model, as COLMAP, and by bridges."""

    Options = SparseOptions
    options: SparseOptions

    def map(
        self, task: MappingTask, output_path: Path, random_seed: int, show: Callable[[int], None]
    ) -> list[MappedModel]:
        """See :class:`colmap_affrect.mappers.base.Mapper`."""
        native = self.native(task, random_seed)
        graph = graph_of(task, native.min_num_matches)

        def shown(count: int) -> None:
            if task.cancellation and task.cancellation.is_cancelled:
                raise KeyboardInterrupt
            show(count)

        is_large = len(graph.keypoints) >= LARGE
        if is_large or task.extend:
            search = replace(self._search(task, graph, native, shown), num_starts=1)
            if task.before:
                found = _again(search, graph, task.before)
            else:
                found = super().map(task, output_path, random_seed, show)
                is_whole = found and not graph.unexplained_by(found[0].reconstruction)
                if is_whole and not task.tie_points:
                    return found
                found.sort(key=search.evidence_of, reverse=True)
            best = _joined_by_hand(search, graph, search.joined(graph, found))
            for model in best:
                if task.extend:
                    task.extend.restore(model.reconstruction)
        else:
            native.mapper.init_max_forward_motion = 1.0  # the evidence decides on such pairs
            best = self._best(task, graph, native, shown)
            for model in best:
                if not has_rigs(model.reconstruction):  # which tell the scale
                    model.reconstruction.normalize()  # as COLMAP does
        if task.extend:
            for mapped in best:
                _extract_colors(mapped.reconstruction, task, native)
            return best
        finish = partial(self._finish, task, graph, native)
        return [replace(m, finish=partial(finish, m.reconstruction)) for m in best]

    def _finish(
        self,
        task: MappingTask,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
        model: pycolmap.Reconstruction,
    ) -> None:
        """Give a model the points of all tracks, and their colours."""
        tie_points = tie_points_of(task, graph)
        complete_points(model, graph, native, self.options.noise_px, tie_points)
        _extract_colors(model, task, native)

    def _search(
        self,
        task: MappingTask,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
        show: Callable[[int], None],
    ) -> Search:
        priors = priors_of(graph.cameras.values(), task.cameras)
        constant, frames = frozenset[int](), frozenset[int]()
        if self.options.keep_given_intrinsics:
            constant = frozenset(key for key, record in task.cameras.items() if record.is_fixed)
        else:
            priors = {k: replace(p, sigma=p.sigma or EXIF_SIGMA) for k, p in priors.items()}
        if not native.ba_refine_focal_length:  # then they are those of the database
            used = {camera.camera_id: camera for camera in graph.cameras.values()}
            priors = {k: FocalPrior(float(c.mean_focal_length()), 0.0) for k, c in used.items()}
            if not (native.ba_refine_extra_params or native.ba_refine_principal_point):
                constant |= used.keys()
        if task.extend:
            task.extend.constrain(native)
            constant |= native.constant_cameras
            if not task.extend.refine:
                frames = frozenset(image.frame_id for image in task.extend.images)
        refining, tie_points = native.get_global_bundle_adjustment(), tie_points_of(task, graph)
        adjuster = Adjuster(priors, self.options.noise_px, refining, constant, frames, tie_points)
        return Search(adjuster, Evidence(graph, priors), native, self.options.num_seeds, show)

    def _best(
        self,
        task: MappingTask,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
        show: Callable[[int], None],
    ) -> list[MappedModel]:
        """Return what has most evidence after all moves.

        Images of one size share unknown cameras at first. Cameras of their own are one more move,
        which the evidence is for where they differ, or some images are parts of others.
        """
        cameras = with_shared_cameras(task.cameras) if task.may_share else task.cameras
        is_sharing = len(cameras) < len(task.cameras)
        own = graph, self._search(task, graph, native, show)
        if is_sharing:
            graph = graph.with_cameras(cameras)
        search = self._search(replace(task, cameras=cameras), graph, native, show)
        ids = {name: image_id for image_id, name in graph.names.items()}
        pairs = ((ids[a], ids[b]) for a, b in task.unmeasured)
        unmeasured = {(min(pair), max(pair)) for pair in pairs}
        best = _again(search, graph, task.before)
        most = search.evidence_of(*best)
        measured = {MEASURED_PAIRS: unmeasured} if unmeasured else {}
        for name, left_out in {**measured, ALL_PAIRS: set[Ids]()}.items():
            start = best[0].reconstruction if best else None
            if start and search.is_certain(start, graph):
                break
            reduced = graph.without(left_out)
            if start and not reduced.unexplained_by(start):
                continue
            if start:
                models = search.beyond(reduced, best)
            else:
                models = _of_some_tracks(search, reduced, graph) or search.best(reduced)
            evidence = search.evidence_of(*models)
            if not models or (best and evidence <= most):
                continue
            before = best[0].moves if best else ()
            moves = tuple(dict.fromkeys((*before, name, *models[0].moves)))
            best, most = [replace(model, moves=moves) for model in models], evidence
            if is_sharing:
                model = _with_own_cameras(own[1], own[0].without(left_out), search, best[0])
                if model and own[1].evidence.of(model) > most + MIN_GAIN:
                    is_sharing, (graph, search) = False, own
                    first = replace(best[0], reconstruction=model, moves=(*moves, OWN_CAMERAS))
                    best = with_own_images([first, *best[1:]])
                    most = search.evidence_of(*best)
        if not best and is_sharing:
            return self._best(replace(task, may_share=False), own[0], native, show)
        return _joined_by_hand(search, graph, best)


def _extract_colors(
    model: pycolmap.Reconstruction,
    task: MappingTask,
    native: pycolmap.IncrementalPipelineOptions,
) -> None:
    if native.extract_colors and task.image_path:
        model.extract_colors_for_all_images(task.image_path)


def _joined_by_hand(
    search: Search, graph: PairGraph, models: Sequence[MappedModel]
) -> list[MappedModel]:
    joiner = TieJoiner(search.adjuster.tie_points, search.grower(graph), search.evidence)
    return joiner.join(models)


def _again(search: Search, graph: PairGraph, before: Sequence[MappedModel]) -> list[MappedModel]:
    """Return models with the poses of some before, and all that their tracks now register."""
    grower, found = search.grower(graph), list[MappedModel]()
    for mapped in before:
        model = grower.again(mapped.reconstruction)
        grower.finish(model)
        moves = tuple(dict.fromkeys((*mapped.moves, AGAIN)))
        found.append(replace(mapped, reconstruction=model, moves=moves))
    return with_own_images(found)


def _with_own_cameras(
    own: Search, graph: PairGraph, shared: Search, found: MappedModel
) -> pycolmap.Reconstruction | None:
    """Return a model with a camera for each image; None where some tracks already tell against."""
    thin, model = graph.thinned(), found.reconstruction
    if thin is not graph:
        trial = own.grower(thin).again(model)
        before, after = (replace(s.evidence, graph=thin) for s in (shared, own))
        if after.of(trial) <= before.of(model) + MIN_GAIN:
            return None
    grower = own.grower(graph)
    model = grower.again(model)
    grower.finish(model)
    return model


def _of_some_tracks(search: Search, reduced: PairGraph, graph: PairGraph) -> list[MappedModel]:
    """Return a model, with all points, if some tracks of a reduced graph make a certain one."""
    thin = reduced.thinned()
    if thin is reduced:
        return []
    quick = replace(search, evidence=replace(search.evidence, graph=thin), num_starts=0)
    models = quick.best(thin)
    has_all = models and models[0].reconstruction.num_reg_images() == len(graph.keypoints)
    if not has_all or not quick.is_certain(models[0].reconstruction, graph):
        return []
    search.grower(reduced).fill(models[0].reconstruction)  # poses are right
    return [replace(models[0], moves=(SOME_TRACKS,))]
