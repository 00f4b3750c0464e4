"""Parts of a model that is doubtful throughout are kept apart where each alone is surer."""

from __future__ import annotations

import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.surer_apart import Score, surer_apart
from colmap_affrect.mappers.surroundings import Places

HERE = {1, 2, 3}
THERE = {4, 5}


def synthetic_model() -> MappedModel:
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_frames_per_rig=5, num_points3D=20
    )
    return MappedModel(pycolmap.synthesize_dataset(options))


def places(unclear: dict[int, float] | None = None) -> Places:
    return Places([HERE | THERE], unclear=unclear or {}, tied=[HERE, THERE])


def scores(together: float, alone: float) -> Score:
    """Score images by one probability in the whole model and another one in parts."""

    def score(mapped: MappedModel) -> dict[int, float]:
        images = mapped.reconstruction.reg_image_ids()
        probability = together if len(images) == 5 else alone
        return dict.fromkeys(images, probability)

    return score


@pytest.mark.parametrize(
    ("together", "alone", "is_cut"),
    [(0.3, 0.95, True), (0.3, 0.3, False), (0.6, 0.95, False)],
)
def test_parts_are_apart_where_the_whole_is_doubtful_and_they_are_sure(
    together: float, alone: float, is_cut: bool
) -> None:
    mapped = synthetic_model()
    found = surer_apart(mapped, places(), scores(together, alone))
    assert found.images == ([HERE, THERE] if is_cut else [HERE | THERE])
    assert found.why == ("surer_apart" if is_cut else "other_surroundings")
    assert mapped.reconstruction.num_reg_images() == 5


def test_a_whole_that_is_unclear_is_doubtful() -> None:
    of_all = dict.fromkeys(HERE | THERE, 0.4)
    found = surer_apart(synthetic_model(), places(of_all), scores(0.9, 0.9))
    assert found.images == [HERE, THERE]
    assert not found.unclear


def test_a_single_image_is_a_place_of_its_own_which_is_told_why() -> None:
    tied = Places([HERE | THERE], tied=[{5}, {1, 2}, {3, 4}])
    found = surer_apart(synthetic_model(), tied, scores(0.3, 0.95))
    assert found.images == [{1, 2}, {3, 4}, {5}]
    alone = Places([HERE | THERE], tied=[{5}, {1, 2, 3, 4}])
    assert surer_apart(synthetic_model(), alone, scores(0.3, 0.95)) is alone


def test_one_part_alone_stays_as_it_is() -> None:
    one = Places([HERE | THERE], tied=[HERE | THERE])
    assert surer_apart(synthetic_model(), one, scores(0.1, 0.9)) is one
