"""The sparse mapper: mapping as one estimate, for small sets with few matches."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import with_shared_cameras
from colmap_affrect.mappers.adjustment import EXIF_SIGMA, FAST, NOISE_PX, Adjuster, priors_of
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.evidence import MIN_GAIN, Evidence
from colmap_affrect.mappers.incremental import IncrementalMapper, PipelineOptions
from colmap_affrect.mappers.moves import MOVES, State
from colmap_affrect.mappers.pair_graph import Ids, PairGraph, graph_of
from colmap_affrect.mappers.search import Search
from colmap_affrect.options import within

SOME_TRACKS = "from some of the tracks"  # the move that makes easy models
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
    """Maps small sets as one estimate; COLMAP maps large ones, and registers into a model.

    What that leaves out is joined by bridges here, too.
    """

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

        if task.extend or len(graph.keypoints) >= LARGE:
            found = super().map(task, output_path, random_seed, show)
            if found and graph.is_explained_by(found[0].reconstruction):
                return found
            search = self._search(task, graph, native, shown)
            models = sorted((m.reconstruction for m in found), key=search.evidence.of, reverse=True)
            best = search.joined(graph, search.adjuster, models, num_starts=1)
            if task.extend:
                for model in best:
                    task.extend.restore(model.reconstruction)
        else:
            native.mapper.init_max_forward_motion = 1.0  # the evidence decides on such pairs
            best = self._with_or_without_sharing(task, graph, native, shown)
            for model in best:
                model.reconstruction.normalize()  # as COLMAP does
        if native.extract_colors and task.image_path:
            for model in best:
                model.reconstruction.extract_colors_for_all_images(task.image_path)
        return best

    def _search(
        self,
        task: MappingTask,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
        show: Callable[[int], None],
    ) -> Search:
        priors = priors_of(graph.cameras.values(), task.cameras)
        if self.options.keep_given_intrinsics:
            constant = {key for key, record in task.cameras.items() if record.is_fixed}
        else:
            constant = set()
            priors = {k: replace(p, sigma=p.sigma or EXIF_SIGMA) for k, p in priors.items()}
        frames: set[int] = set()
        if task.extend:
            task.extend.constrain(native)
            constant |= native.constant_cameras
            if not task.extend.refine:
                frames = {image.frame_id for image in task.extend.images}
        adjuster = Adjuster(
            priors,
            self.options.noise_px,
            native.get_global_bundle_adjustment(),
            frozenset(constant),
            frozenset(frames),
        )
        return Search(adjuster, Evidence(graph, priors), native, self.options.num_seeds, show)

    def _with_or_without_sharing(
        self,
        task: MappingTask,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
        show: Callable[[int], None],
    ) -> list[MappedModel]:
        """Let images of one size share unknown cameras, unless the evidence is against that."""
        cameras = with_shared_cameras(task.cameras)
        if not task.may_share or len(cameras) == len(task.cameras):
            return self._best(task, graph, native, show)[0]
        sharing = replace(task, cameras=cameras)
        shared, most = self._best(sharing, graph.with_cameras(cameras), native, show)
        if not shared:
            return self._best(task, graph, native, show)[0]
        search, best = self._search(task, graph, native, show), shared[0]
        own = search.with_own_cameras(graph, best.reconstruction)
        if search.evidence.of(own) > most + MIN_GAIN:
            return [replace(best, reconstruction=own, moves=(*best.moves, OWN_CAMERAS)), *shared[1:]]
        return shared

    def _best(
        self,
        task: MappingTask,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
        show: Callable[[int], None],
    ) -> tuple[list[MappedModel], float]:
        """Return what has most evidence, and how much, after all moves."""
        ids = {name: image_id for image_id, name in graph.names.items()}
        measured = {(ids[a], ids[b]): inliers for (a, b), inliers in task.measured.items()}
        search = self._search(task, graph, native, show)
        if easy := self._of_some_tracks(task, graph, graph.with_inliers(measured), search):
            return easy, search.evidence_of(easy)
        best: list[MappedModel] = []
        most, tried = 0.0, set[frozenset[tuple[Ids, int]]]()
        for name, move in MOVES.items():
            start = best[0].reconstruction if best else None
            if start and search.is_certain(start, graph):
                break
            reduction = move(State(graph, measured, native.random_seed, start))
            if not reduction:
                continue
            reduced = reduction(graph)
            pairs = frozenset((pair.ids, len(pair.matches)) for pair in reduced.pairs)
            if pairs in tried or (start and reduced.is_explained_by(start)):
                continue
            tried.add(pairs)
            models = search.best(reduced, start)
            evidence = search.evidence_of(models)
            if not best or evidence > most:
                moves = (*(best[0].moves if best else ()), name)
                best, most = [replace(model, moves=moves) for model in models], evidence
        return best, most

    def _of_some_tracks(
        self, task: MappingTask, graph: PairGraph, reduced: PairGraph, search: Search
    ) -> list[MappedModel]:
        """Return a model of all images if some tracks make one that is certain.

        It has the points of all tracks of ``reduced``.
        """
        thin = reduced.thinned()
        if thin is reduced:
            return []
        quick = self._search(task, thin, search.native, search.show)
        models = replace(quick, num_starts=0).best(thin)
        has_all = models and models[0].reconstruction.num_reg_images() == len(graph.keypoints)
        if not has_all or not quick.is_certain(models[0].reconstruction, graph):
            return []
        search.grower(reduced).fill(models[0].reconstruction, FAST)  # poses are right
        return [replace(models[0], moves=(SOME_TRACKS,))]
