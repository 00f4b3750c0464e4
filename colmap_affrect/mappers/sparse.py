"""The sparse mapper: mapping as one estimate, for small sets with few matches."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import keep_inliers
from colmap_affrect.colmap.database_copy import copy_database, copy_without_pairs
from colmap_affrect.colmap.sharing import share_cameras, with_shared_cameras
from colmap_affrect.mappers.adjustment import EXIF_SIGMA, NOISE_PX, Adjuster, priors_of
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.evidence import MIN_GAIN, Evidence
from colmap_affrect.mappers.incremental import IncrementalMapper, PipelineOptions
from colmap_affrect.mappers.loops import contradicting_pairs
from colmap_affrect.mappers.pair_graph import Ids, PairGraph, graph_of
from colmap_affrect.mappers.search import Search
from colmap_affrect.options import within

LARGE = 100  # images from which on COLMAP's own pipeline maps
NONE: frozenset[Ids] = frozenset()


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

        search = self._search(task, graph, native, shown)
        if task.extend or len(graph.keypoints) >= LARGE:
            found = super().map(task, output_path, random_seed, show)
            if found and graph.is_explained_by(found[0].reconstruction):
                return found
            models = sorted((m.reconstruction for m in found), key=search.evidence.of, reverse=True)
            best = search.joined(graph, search.grower(graph), models, num_starts=1)
            if task.extend:
                for model in best:
                    task.extend.restore(model.reconstruction)
        else:
            best = self._with_or_without_sharing(search, task, output_path)
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
        self, search: Search, task: MappingTask, output_path: Path
    ) -> list[MappedModel]:
        """Let images of one size share unknown cameras, unless the evidence is against that."""
        search.native.mapper.init_max_forward_motion = 1.0  # the evidence decides on such pairs
        cameras = with_shared_cameras(task.cameras)
        if not task.may_share or len(cameras) == len(task.cameras):
            return self._best(search, task, output_path)
        path = output_path / "shared.db"
        copy_database(task.database_path, path)
        share_cameras(path, cameras)
        sharing = replace(task, database_path=path, cameras=cameras)
        graph = graph_of(sharing, search.native.min_num_matches)
        together = self._search(sharing, graph, search.native, search.show)
        shared = self._best(together, sharing, output_path)
        if shared and graph.is_explained_by(shared[0].reconstruction):
            return shared
        free = self._best(search, task, output_path)
        is_worse = together.evidence_of(shared) < search.evidence_of(free) - MIN_GAIN
        return free if is_worse else shared

    def _best(self, search: Search, task: MappingTask, output_path: Path) -> list[MappedModel]:
        """Map with the pairs as some databases have them; return what has most evidence.

        In the first one pairs have the matches of measured frames only, where there are others:
        these are less exact, and verify sides that look the same. They join the rest to what is
        known by then, first without pairs that they alone verify. Pairs that contradict their
        loops, or the best model if it lacks images, are tried without.
        """
        graph, native = search.evidence.graph, search.native
        path, tried = output_path / "reduced.db", set[frozenset[Ids]]()
        best: list[MappedModel] = []
        if task.measured:
            path.unlink(missing_ok=True)
            copy_database(task.database_path, path)
            keep_inliers(path, task.measured)
            best = search.best(PairGraph.read(path, native.min_num_matches, task.depth_at))
        ids = {name: image_id for image_id, name in graph.names.items()}
        pairs = (
            sorted((ids[a], ids[b])) for (a, b), left in task.measured.items() if not len(left)
        )
        unmeasured = frozenset((first, second) for first, second in pairs)

        def contradicted() -> frozenset[Ids]:
            has_all = best and best[0].reconstruction.num_reg_images() == len(graph.keypoints)
            return graph.contradicted(best[0].reconstruction) if best and not has_all else NONE

        moves: tuple[Callable[[], frozenset[Ids]], ...] = (
            lambda: unmeasured,
            lambda: NONE,
            lambda: contradicting_pairs(graph, native.random_seed),
            contradicted,
        )
        for pairs_to_drop in moves:
            wrong = pairs_to_drop()
            if wrong in tried:
                continue
            tried.add(wrong)
            reduced = graph
            if wrong:
                path.unlink(missing_ok=True)
                copy_without_pairs(task.database_path, path, wrong)
                reduced = PairGraph.read(path, native.min_num_matches, task.depth_at)
            if best and reduced.is_explained_by(best[0].reconstruction):
                continue
            start = best[0].reconstruction if best else None
            best = max(best, search.best(reduced, start), key=search.evidence_of)
        return best
