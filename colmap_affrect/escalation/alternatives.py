"""Models beside those that grow step by step: of learned matches, and the best ones so far.

Matches of measured frames and learned ones err in different ways: where sides of a thing look
alike, or only a flat part of a scene is tied, one kind may place photographs wrongly that the other
places right, and mixed they may not agree at all. More matches can make a model worse, too. So of
small sets models are looked at for which all pairs with learned matches use these, and the best
models so far are kept with their matches. Those stay in the end of which most relative poses are
expected to be right.
"""

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from colmap_affrect.errors import DAMAGE
from colmap_affrect.escalation.escalate import Escalation
from colmap_affrect.escalation.policy import SMALL
from colmap_affrect.mappers.base import Mapper
from colmap_affrect.mappers.mapping import (
    copy_with_keypoints,
    model_folders,
    read_summaries,
)
from colmap_affrect.mappers.wrong_models import copy_thrown_away
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.atomic_files import cannot_write
from colmap_affrect.project.match_state import (
    NOTHING_TO_GO_ON_FROM,
    LearnedModels,
    Worth,
)
from colmap_affrect.project.match_store import MatchStore, PairMatches
from colmap_affrect.project.outputs import remove_own, temporary_folder
from colmap_affrect.project.report import ModelSummary, expected_right_poses
from colmap_affrect.project.sealed_json import read_sealed, write_sealed
from colmap_affrect.session.context import Context
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.map import map_images
from colmap_affrect.stages.verify import verify_matches

SCORE = "score.json"  # in the folder of the best models


def num_right_poses(models: Sequence[ModelSummary]) -> float:
    """Return how many poses relative to a first image are expected to be right.

    >>> model = ModelSummary(("a", "b", "c"), 9, 2.0, 0.5, {"a": 1.0, "b": 1.0, "c": 0.5})
    >>> num_right_poses([model]), num_right_poses([model, model]), num_right_poses([])
    (1.5, 3.0, 0.0)
    """
    found = 0.0
    for model in models:
        found += expected_right_poses(model.probabilities.values())
    return found


def num_right_poses_now(context: Context) -> float:
    """Return the same of the models that are there."""
    return num_right_poses(read_summaries(context.workspace.sparse))


# Learned matches


def learned_models_on_record(context: Context) -> LearnedModels | None:
    """Return what is on record of these pairs; None before learned matching."""
    known = context.matches.state.learned_models
    return known if known and known.of_set == context.set_digest() else None


@dataclass(frozen=True)
class Choice:
    """Learned matches of pairs that use others."""

    matches: Sequence[PairMatches]
    measured_worths: dict[Pair, Worth]  # of those that are used


def map_learned_matches(escalation: Escalation, mapper: Mapper) -> None:
    """Map with all learned matches, and keep the models and what they are worth.

    Args:
        escalation: of the workspace; its models are those of the first matches.
        mapper: what makes models.
    """
    context = escalation.context
    choice = _choice_of_learned_matches(escalation)
    learned = context.workspace.learned
    with _replaced(learned) as new:
        new.mkdir()
        if choice.matches:
            _map_copy(context, mapper, choice, new)
    found = read_summaries(learned)
    names = set(context.features.names()).difference(context.by_hand.left_out)
    learned_models = LearnedModels(
        of_set=context.set_digest(),
        score=num_right_poses(found),
        score_without=num_right_poses_now(context),
        is_of_most=2.0 * num_right_poses(found[:1]) > len(names) - 1,
    )
    context.matches.update_state(learned_models=learned_models)


def has_models_to_go_on_from(context: Context) -> bool:
    """Return whether any relative pose of the models that are there is expected to be right."""
    return num_right_poses_now(context) >= NOTHING_TO_GO_ON_FROM


def give_up_learned_models(context: Context) -> None:
    """Put on record that there are no models of learned matches: they are expected to be worse."""
    score_without = num_right_poses_now(context)
    learned_models = LearnedModels(context.set_digest(), 0.0, score_without)
    context.matches.update_state(learned_models=learned_models)


def needs_learned_models(context: Context) -> bool:
    """Return whether models of learned matches may be better, and are not there to be chosen."""
    learned_models = learned_models_on_record(context)
    if not learned_models:
        return True
    is_decided = (
        learned_models.is_chosen or learned_models.score <= num_right_poses_now(context)
    )
    return not is_decided and not context.workspace.learned.exists()


def choose_learned(escalation: Escalation, *, at_once: bool) -> bool:
    """Let learned matches and their models take the place of the others if these are worse.

    Args:
        escalation: of the workspace, with the models that are there.
        at_once: choose them only if they are enough.

    Returns:
        Whether they were chosen.
    """
    context = escalation.context
    learned_models = learned_models_on_record(context)
    if (
        not learned_models
        or learned_models.is_chosen
        or not context.workspace.learned.exists()
    ):
        return False
    # At once: as it was then, also for a run that was killed since.
    is_wanted = (
        learned_models.is_enough
        if at_once
        else learned_models.score > num_right_poses_now(context)
    )
    choice = _choice_of_learned_matches(escalation) if is_wanted else None
    if not choice or not choice.matches:
        return False
    decided = replace(learned_models, is_chosen=True)
    _choose(context, choice, context.workspace.learned, learned_models=decided)
    adopt_chosen_models(escalation)
    return True


def _choice_of_learned_matches(escalation: Escalation) -> Choice:
    states = escalation.image_set.states()
    learned = escalation.matches.learned(list(states))
    levels = {pair: found.matches.level for pair, found in learned.items()}
    changed = [pair for pair, level in levels.items() if states[pair].level != level]
    measured = [
        pair for pair in changed if escalation.image_set.is_measured[states[pair].level]
    ]
    worths = {pair: states[pair].worth for pair in measured}
    return Choice([learned[pair].matches for pair in changed], worths)


def _map_copy(context: Context, mapper: Mapper, choice: Choice, target: Path) -> None:
    """Map a copy of the workspace in which some pairs have other matches.

    Args:
        context: of the workspace, which stays as it is.
        mapper: what makes models.
        choice: the other matches.
        target: folder that gets the folders of the models.
    """
    workspace = context.workspace
    with temporary_folder(workspace.path) as folder:
        branch = workspace.branch(folder / "branch")
        branch.matches.unlink()  # a link perhaps
        shutil.copy(workspace.matches, branch.matches)
        shown = replace(context.progress, title="learned matches: ", forecast=None)
        other = replace(context, workspace=branch, progress=shown)
        other.matches.choose(choice.matches, choice.measured_worths)
        verify_matches(other, context.verification)
        guide(other, context.guiding)
        map_images(other, mapper)
        for model_folder in model_folders(branch.sparse):
            model_folder.rename(target / model_folder.name)
        copy_thrown_away(branch.sparse, target)


# Going over to other models


def _choose(context: Context, choice: Choice, folder: Path, **changes: Any) -> None:
    """Choose matches, and keep in mind that the models in a folder are to follow them."""
    matches = context.matches
    changes |= {"modelled": matches.state.listed, "follows": folder.name}
    matches.choose(choice.matches, choice.measured_worths, **changes)


def adopt_chosen_models(escalation: Escalation) -> None:
    """Let models follow the matches that were chosen, if they have not yet; a run was killed."""
    context = escalation.context
    name = context.matches.state.follows
    if not name:
        return
    escalation.write()
    folder = context.workspace.path / name
    if folder.exists():
        guide(context, context.guiding)
        _adopt(context, folder)
    context.matches.update_state(follows="")


def update_keypoints_of_models(context: Context) -> None:
    """Give the models that are there the keypoints that images have got; nothing else has changed.

    Mapping again would be of the same pairs, and might end elsewhere.
    """
    if context.workspace.model_inputs() != context.current_model_inputs():
        _adopt(context, context.workspace.sparse)


def _adopt(context: Context, sparse_path: Path) -> None:
    """Let models be those of the verified pairs that are there, with all keypoints."""
    workspace = context.workspace
    with _replaced(workspace.sparse) as new:
        new.mkdir()
        for folder in model_folders(sparse_path):
            copy_with_keypoints(folder, new / folder.name, workspace.database)
        copy_thrown_away(sparse_path, new)
    workspace.record_mapping(context.current_model_inputs())


# The best models so far


def keep_best(context: Context) -> None:
    """Keep the models that are there, with their matches, if none were better so far.

    Of small sets, and where the models are those of the verified pairs.
    """
    workspace = context.workspace
    is_small = len(context.features.names()) <= SMALL
    if not is_small or workspace.model_inputs() != context.current_model_inputs():
        return
    present = num_right_poses_now(context)
    if present < num_right_poses_of_best(context):
        return
    with _replaced(workspace.best) as new:
        new.mkdir()
        for folder in model_folders(workspace.sparse):
            shutil.copytree(folder, new / folder.name)
        copy_thrown_away(workspace.sparse, new)
        shutil.copy(workspace.matches, new / workspace.matches.name)
        kept = {"of_set": context.set_digest(), "num_right_poses": present}
        write_sealed(new / SCORE, json.dumps(kept))


def num_right_poses_of_best(context: Context) -> float:
    """Return the same of the best models so far; 0 where none of these pairs are kept."""
    path = context.workspace.best / SCORE
    if not path.exists():
        return 0.0
    try:
        kept = read_sealed(path)
        is_same = kept["of_set"] == context.set_digest()
        return float(kept["num_right_poses"]) if is_same else 0.0
    except DAMAGE:
        return 0.0


def has_become_worse(context: Context) -> bool:
    """Return whether the models that are there are worse than the best ones so far."""
    return num_right_poses_of_best(context) > num_right_poses_now(context)


def restore_best(escalation: Escalation) -> bool:
    """Go back to the best models so far, and to their matches, if those that are there are worse.

    Returns:
        Whether there were better ones.
    """
    context = escalation.context
    best = context.workspace.best
    if not has_become_worse(context):
        return False
    before = MatchStore(best / context.workspace.matches.name)
    pairs = list(escalation.image_set.num_inliers())
    levels = context.matches.levels(pairs)
    changed = [p for p, level in before.levels(pairs).items() if level != levels[p]]
    choice = Choice(list(before.read(changed)), before.measured_worths(changed))
    _choose(context, choice, best)
    adopt_chosen_models(escalation)
    return True


def remove_alternatives(context: Context) -> None:
    """Remove other models: those that are there are as good, or of other pairs."""
    for folder in (context.workspace.best, context.workspace.learned):
        remove_own([folder, _partial(folder)])


def _partial(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.partial")


@contextmanager
def _replaced(folder: Path) -> Iterator[Path]:
    """Yield the name of a new folder that takes the place of another; AffrectError if it cannot."""
    new = _partial(folder)
    remove_own([new])
    try:
        yield new
        remove_own([folder])
        new.rename(folder)
    except OSError as error:
        raise cannot_write(folder, error) from error
