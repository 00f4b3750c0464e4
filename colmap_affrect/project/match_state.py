"""How far matching and escalation of a set have come: one record, kept with the raw matches.

It changes together with matches, all or nothing, so that an interrupted run resumes as it was. The
rest of what is done tell the matches themselves: a pair is matched when it is there.
"""

from collections.abc import Collection
from dataclasses import dataclass

from pydantic import TypeAdapter

from colmap_affrect.options import EffortName

Names = tuple[str, str]  # of a pair of images
# Inliers; where there are none, how many matches confirm each other
Worth = tuple[int, int]
Size = tuple[int, int]  # width and height in px
Cell = tuple[int, int]  # column and row

NOTHING_TO_GO_ON_FROM = 1.0
"""Score of models below which not one relative pose is expected to be right; theory."""


@dataclass(frozen=True)
class Begun:
    """Pairs that are being matched again: what is needed would look different meanwhile."""

    level: int
    pairs: tuple[Names, ...]
    follows_mapping: bool = False  # all that was verified before was mapped


@dataclass(frozen=True)
class LearnedModels:
    """What models of learned matches are worth."""

    of_set: str  # digest of the set that they are of
    score: float  # 0 where there are none
    score_without: float  # of the first models
    is_of_most: bool = False  # most poses are expected to be right in one of them
    is_chosen: bool = False

    @property
    def is_enough(self) -> bool:
        """Whether all else goes on from them, and nothing from the first models.

        The first models are left where not one of their relative poses is expected to be right, or
        where one model of learned matches has most poses right, so that no better model is without
        some of these poses.
        """
        is_better = self.score > self.score_without
        return is_better and (
            self.is_of_most or self.score_without < NOTHING_TO_GO_ON_FROM
        )


@dataclass(frozen=True)
class MatchState:
    """What is known of all pairs together."""

    listed: str = ""
    """Digest of the list whose pairs have all been matched, and looked at for what never moves."""
    in_vain: tuple[str, bool] | None = None
    """Digest of a list, and whether all features tie its pairs no better than some."""
    stationary: tuple[tuple[Size, tuple[Cell, ...]], ...] = ()
    """Places where nothing moves, by size of the photographs."""
    still_cameras: tuple[Size, ...] = ()
    """Sizes of photographs whose camera stood still, while something turned before it."""
    backgrounds: tuple[tuple[str, str], ...] = ()
    """Places of each photograph that show what never moves: its name, and a bit for each cell."""
    modelled: str = ""
    """Digest of the list of which there was a model before pairs were matched again."""
    effort: EffortName | None = None
    """How much was tried for images to match again."""
    learned_matching: Begun | None = None
    """What learned matching is for, whose matches are kept beside those in use."""
    learned_models: LearnedModels | None = None
    """What models of these matches are worth."""
    unlearned_set: str = ""
    """Digest of the set that was gone on with without learned matching, though it was possible."""
    step: Begun | None = None
    """The step of escalation that has begun and not ended."""
    has_stepped: bool = False
    """Whether any step has begun."""
    rounds: tuple[int, ...] = ()
    """Levels of the steps that mapping follows, since the first model."""
    follows: str = ""
    """Folder of better models whose matches these are already, while ``sparse/`` has others."""

    def without_pairs(self, images: Collection[str] = ()) -> "MatchState":
        """Return what is left where pairs have gone: which ones escalate depends on all others.

        Of images that have gone nothing is left; others may get their names.
        """
        return MatchState(
            stationary=self.stationary,
            still_cameras=self.still_cameras,
            backgrounds=tuple(
                (name, cells) for name, cells in self.backgrounds if name not in images
            ),
            effort=self.effort,
        )


STATE_JSON = TypeAdapter(MatchState)
