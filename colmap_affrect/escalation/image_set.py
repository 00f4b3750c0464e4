"""What is known of the images and pairs of a set, as escalation sees it.

It is read anew for every decision, from the stores and the view graph: each step changes it.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence

from colmap_affrect.colmap.connections import weakly_connected_images
from colmap_affrect.escalation.expected_gain import PairState, insecure_images
from colmap_affrect.escalation.policy import Situation, learned_level_of
from colmap_affrect.mappers.mapping import read_summaries
from colmap_affrect.mappers.sparse import MIN_LARGE_SET
from colmap_affrect.mappers.wrong_models import read_thrown_away
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.match_state import Size
from colmap_affrect.project.report import NO_MODEL, ModelSummary
from colmap_affrect.recipes import EscalateOptions
from colmap_affrect.session.context import Context
from colmap_affrect.stages.match import num_consistent

# Share of its gain that an image weighs that is likely right already: matches mend few of these;
# judged on the sets of tests/benchmarks/effort.py
LIKELY = 0.25


class ImageSet:
    """Reads what is known of a set.

    Attributes:
        context: of the workspace.
        options: which pairs are strong.
        pairs: those that are listed.
        is_measured: whether local affine frames are measured one by one, by level.
    """

    def __init__(self, context: Context, options: EscalateOptions) -> None:
        """Read the list of pairs; all else is read when it is asked for."""
        self.context = context
        self.options = options
        self.pairs = context.listed_pairs()
        self.is_measured = [
            level.features.has_shapes for level in context.extraction.levels
        ]
        # Raw matches of pairs, and how many of them confirm each other
        self._consistent = dict[Pair, tuple[bytes, int]]()

    def num_inliers(self) -> dict[Pair, int]:
        """Return the inliers of the pairs that may be used, 0 of those that are not verified."""
        verified = self.context.num_verified_inliers()
        found = dict[Pair, int]()
        for first, second in self.context.usable(self.pairs):
            count = verified.get((first, second)) or verified.get((second, first), 0)
            found[first, second] = count
        return found

    def models(self) -> list[ModelSummary]:
        """Return what is known of the models before; an empty one where there are none."""
        return read_summaries(self.context.workspace.sparse) or [NO_MODEL]

    def weights(self, models: Sequence[ModelSummary]) -> dict[str, float]:
        """Return the images to match again, and how much more matches may bring to each.

        Images that no model has had weigh 1. Doubtful ones of the first model, and those that were
        taken out of it, weigh what matches may add to the probability that they are right. All
        that is a quarter where they are likely right in the model that they are in.

        Args:
            models: those before, the largest first.

        Returns:
            Weights in photographs, by image name.
        """
        names = set(self.context.features.names())
        names.difference_update(self.context.by_hand.left_out)
        wanted = names.difference(models[0].sure)
        if not self.is_mapped():
            wanted = self._insecure(wanted, num_images=len(names))
        likely = frozenset[str]().union(*(model.likely for model in models))
        weights = dict[str, float]()
        for name, gain in _gains(sorted(wanted), models).items():
            share = LIKELY if name in likely else 1.0
            weights[name] = share * gain
        return weights

    def is_mapped(self) -> bool:
        """Tell whether the models are those of the verified pairs."""
        return (
            self.context.workspace.model_inputs() == self.context.current_model_inputs()
        )

    def has_learned_level(self) -> bool:
        """Tell whether the recipe has a level of learned matching that can be used."""
        levels = self.context.extraction.levels
        return learned_level_of(levels, self._usable_levels()) is not None

    def _usable_levels(self) -> list[int]:
        """Return the numbers of the levels of escalation whose weights are there."""
        return self.context.resources.usable_levels(self.context.extraction)[1:]

    def _insecure(self, wanted: set[str], *, num_images: int) -> set[str]:
        """Return the images that the next model may well lose; none where it will tell of them."""
        insecure = insecure_images(
            num_inliers=self.num_inliers(),
            strong_num_inliers=self.options.strong_num_inliers,
            weakly_connected=self._weakly_connected(),
        )
        insecure &= wanted
        has_models = self.context.workspace.sparse.exists()
        # The next model tells of what has been verified since.
        maps_next = insecure != wanted and has_models and num_images < MIN_LARGE_SET
        return set() if maps_next else insecure

    def _anchored(
        self, model: ModelSummary, states: Mapping[Pair, PairState]
    ) -> set[str]:
        """Return the images of a model that measured frames connect to a likely one."""
        anchored = set[str]()
        for pair, state in states.items():
            is_verified = state.num_inliers and self.is_measured[state.level]
            if is_verified and not model.likely.isdisjoint(pair):
                anchored.update(pair)
        return anchored.intersection(model.registered_names)

    def _weakly_connected(self) -> set[str]:
        """Return the images with few features in tracks through three, where there are three."""
        if len(self.context.features.names()) < 3:
            return set()
        limit = self.context.guiding.min_num_tracks
        return weakly_connected_images(self.context.verified_inliers(), limit)

    def states(self) -> dict[Pair, PairState]:
        """Return what is known of the pairs that are in the database."""
        matches = self.context.matches
        num_inliers = self.num_inliers()
        failed = [pair for pair, count in num_inliers.items() if not count]
        consistent = self._num_consistent(failed)
        levels = matches.levels(num_inliers)
        tried = matches.levels(num_inliers, "tried")
        measured = matches.measured_worths(num_inliers)
        learned = matches.learned_levels(num_inliers)
        thrown_away = read_thrown_away(self.context.workspace.sparse)
        stood_on = thrown_away.num_inliers()
        states = dict[Pair, PairState]()
        for pair, count in num_inliers.items():
            states[pair] = PairState(
                num_inliers=count,
                num_consistent=consistent.get(pair, 0),
                level=levels[pair],
                tried=tried[pair],
                measured_worth=measured[pair],
                learned_level=learned[pair],
                # Until it has other matches, with another number of inliers
                is_questioned=stood_on.get(pair) == count,
            )
        return states

    def _num_consistent(self, pairs: Sequence[Pair]) -> dict[Pair, int]:
        """Return how many raw matches of pairs confirm each other."""
        if not pairs:
            return {}
        graph = self.context.graph
        found = dict[Pair, int]()
        with graph.open_to_read() as database:
            for pair in pairs:
                first, second = pair
                matches = database.read_matches(graph.ids[first], graph.ids[second])
                content = matches.tobytes()
                before = self._consistent.get(pair)
                if not before or before[0] != content:
                    count = num_consistent(self.context.features, pair, matches)
                    self._consistent[pair] = content, count
                found[pair] = self._consistent[pair][1]
        return found

    def situation(
        self, weights: Mapping[str, float], models: Sequence[ModelSummary]
    ) -> Situation:
        """Return what the policy decides by.

        Args:
            weights: of the images to match again, by name.
            models: those that are there, the largest first.

        Returns:
            The state of all pairs and images.
        """
        extraction = self.context.extraction
        sizes = self.context.features.image_sizes()
        states = self.states()
        return Situation(
            levels=extraction.levels,
            usable=self._usable_levels(),
            states=states,
            weights=weights,
            gains=_gains(weights, models),
            weakly_connected=self._weakly_connected(),
            anchored=self._anchored(models[0], states),
            megapixels=self._megapixels_by_level(sizes),
            lacking=self._lacking_by_level(sizes),
            registered=models[0].registered_names,
            strong_num_inliers=self.options.strong_num_inliers,
            rounds=self.context.matches.state.rounds,
        )

    def _megapixels_by_level(self, sizes: Mapping[str, Size]) -> list[dict[str, float]]:
        """Return how large each image is when features of a level are extracted."""
        by_level = list[dict[str, float]]()
        for level in self.context.extraction.levels:
            megapixels = dict[str, float]()
            for name, size in sizes.items():
                megapixels[name] = _megapixels(size, level.max_image_size_px)
            by_level.append(megapixels)
        return by_level

    def _lacking_by_level(self, names: Collection[str]) -> list[set[str]]:
        """Return the images without features of each level."""
        by_level = [set(names) for _ in self.context.extraction.levels]
        for name in names:
            for number in self.context.features.level_ranges(name):
                if number < len(by_level):
                    by_level[number].discard(name)
        return by_level


def _gains(names: Iterable[str], models: Sequence[ModelSummary]) -> dict[str, float]:
    """Return what more matches may bring to images, in photographs, by name.

    Args:
        names: of the images.
        models: those that are there, the largest first.
    """
    return {name: models[0].gains.get(name, 1.0) for name in names}


def _megapixels(size: Size, limit_px: int) -> float:
    """Return the megapixels of an image of (width, height) px, shrunk to a longest side."""
    scale = min(1.0, limit_px / max(size))
    return math.prod(size) * scale**2 / 1e6
