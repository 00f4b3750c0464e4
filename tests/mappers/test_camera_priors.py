"""What is known of cameras before mapping, combined as distributions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.geometry import lines
from colmap_affrect.geometry.lines import MIDDLE_SIGMA, SHIFTED_SIGMA, LineCamera
from colmap_affrect.mappers import camera_priors as module
from colmap_affrect.mappers.camera_priors import (
    EXIF_SIGMA,
    LINES_SIGMA,
    USUAL_FOCAL,
    USUAL_SIGMA,
    ZOOMS,
    CameraPrior,
    LogNormal,
    Measurement,
    camera_prior,
    camera_priors,
    combined,
    focal_contradictions,
    measurement_of_lines,
    usual_principal_point,
)

SIZE = (1000, 700)
NOTHING = CameraRecord(("a.jpg",), "guess", 1200.0, size=SIZE)
USUAL = LogNormal(USUAL_FOCAL, USUAL_SIGMA)


def camera(focal_px: float = 1200.0) -> pycolmap.Camera:
    return pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal_px, *SIZE)


def by_lines(
    focal: float,
    sigma: float = 0.06,
    shift: float = 0.0,
    shift_sigma: float = SHIFTED_SIGMA,
) -> LineCamera:
    return LineCamera(
        focal=focal,
        focal_sigma=sigma,
        shift=shift,
        shift_sigma=shift_sigma,
        rotation=np.eye(3),
        up=np.array([0.0, -1.0, 0.0]),
        up_sigma=0.0,
    )


def test_log_normals_multiply_by_their_precisions() -> None:
    measured = Measurement(LogNormal(2.0, 0.2), 1e-12)
    found = combined(USUAL, [measured])
    precision = USUAL_SIGMA**-2 + 0.2**-2
    mean = (
        math.log(USUAL_FOCAL) * USUAL_SIGMA**-2 + math.log(2.0) * 0.2**-2
    ) / precision
    assert found.focal == pytest.approx(math.exp(mean), rel=1e-3)
    assert found.sigma == pytest.approx(precision**-0.5, rel=1e-2)


def test_one_of_three_measurements_that_is_far_from_the_others_hardly_counts() -> None:
    near = Measurement(LogNormal(1.0, 0.06), 0.1)
    far = Measurement(LogNormal(2.5, 0.06), 0.1)
    assert combined(USUAL, [near, near, far]).focal == pytest.approx(1.0, rel=0.06)
    alone = combined(USUAL, [near, far])  # the one that is the more usual is likelier
    assert alone.focal == pytest.approx(1.0, rel=0.06)
    assert alone.sigma > 1.5 * combined(USUAL, [near]).sigma


def test_what_is_usual_is_divided_out_of_what_lines_say() -> None:
    nothing = by_lines(lines.USUAL_FOCAL, lines.USUAL_FOCAL_SIGMA)
    assert measurement_of_lines(nothing) is None
    for hardly_anything in (0.49999, 0.495):
        assert measurement_of_lines(by_lines(1.5, hardly_anything)) is None
    assert measurement_of_lines(by_lines(1.5, 0.48)) is not None
    sharp = measurement_of_lines(by_lines(0.9, 0.06))
    assert sharp
    assert sharp.focal.focal == pytest.approx(0.9, rel=0.01)
    vague = measurement_of_lines(by_lines(1.6, 0.35))
    assert vague
    assert vague.focal.focal > 1.6
    assert vague.focal.sigma > 0.35


def test_lines_tell_an_unknown_focal_length_and_leave_a_known_one_as_it_is() -> None:
    said = [by_lines(0.9)]
    prior = camera_prior(camera(), NOTHING, said)
    assert prior.focal_px == pytest.approx(900.0, rel=0.04)
    assert LINES_SIGMA <= prior.sigma < 0.2
    assert not prior.has_prior_focal_length
    assert prior.starts_px == (prior.focal_px,)
    given = replace(NOTHING, source="given", given=("focal",))
    assert camera_prior(camera(), given, said) == CameraPrior(1200.0, 0.0)


def with_exif(
    difference: float, sigma: float, num_images: int = 1, source: str = "exif"
) -> CameraPrior:
    """Return the prior where lines differ from EXIF by a logarithm."""
    exif = replace(NOTHING, source=source)
    said = [with_usual(1.2 * math.exp(difference), sigma)] * num_images
    return camera_prior(camera(), exif, said)


@pytest.mark.parametrize(
    ("exif", "lines"),
    [(12.0, 1.6), (4.0, 1.2), (3.0, 1.2), (0.5, 1.2), (0.45, 1.5)],
)
def test_vague_lines_that_are_far_from_exif_leave_it_as_it_is(
    exif: float, lines: float
) -> None:
    """Also where EXIF is of a lens that is not usual."""
    record = replace(NOTHING, source="exif")
    said = [with_usual(lines, 0.2)]
    native = camera()
    native.params = [1000.0 * exif, *native.params[1:]]
    prior = camera_prior(native, record, said)
    assert prior.focal_px == pytest.approx(1000.0 * exif, rel=0.005)
    assert prior.sigma == pytest.approx(EXIF_SIGMA, rel=0.02)


@pytest.mark.parametrize("source", ["exif", "exif-rescaled"])
@pytest.mark.parametrize(("difference", "sigma"), [
    (0.0, 0.1), (0.1, 0.1), (-0.12, 0.12), (0.08, 0.2),
])  # fmt: skip
def test_exif_and_lines_that_agree_are_multiplied(
    difference: float, sigma: float, source: str
) -> None:
    """Lines that lie in a tenth of all photographs count a little less than others."""
    prior = with_exif(difference, sigma, source=source)
    precision = EXIF_SIGMA**-2 + sigma**-2
    product = math.exp(difference * sigma**-2 / precision) * 1200.0
    assert math.log(prior.focal_px / product) == pytest.approx(0.0, abs=0.012)
    assert prior.sigma == pytest.approx(precision**-0.5, rel=0.06)
    assert prior.has_prior_focal_length


def test_lines_of_many_images_count_no_more_beside_exif_than_lines_may_be_wrong() -> (
    None
):
    precision = EXIF_SIGMA**-2 + LINES_SIGMA**-2
    many = with_exif(0.1, 0.06, num_images=20)
    assert many.sigma == pytest.approx(precision**-0.5, rel=0.05)
    moved = math.log(many.focal_px / 1200.0)
    assert moved == pytest.approx(0.1 * LINES_SIGMA**-2 / precision, abs=0.008)


def test_lines_that_contradict_exif_or_say_little_leave_it_as_it_is() -> None:
    assert with_exif(0.4, 0.1) == CameraPrior(pytest.approx(1200.0), EXIF_SIGMA)
    vague = with_exif(0.3, 0.45)
    assert vague.focal_px == pytest.approx(1200.0, rel=0.02)
    assert 0.95 * EXIF_SIGMA < vague.sigma <= EXIF_SIGMA
    doubtful = with_exif(0.3, 0.1)
    assert doubtful.sigma <= EXIF_SIGMA
    assert math.log(doubtful.focal_px / 1200.0) < 0.1
    exif = replace(NOTHING, source="exif")
    assert camera_prior(camera(), exif) == CameraPrior(
        pytest.approx(1200.0), EXIF_SIGMA
    )


def test_what_the_user_gives_is_not_combined_with_lines() -> None:
    """Neither a focal length that stays nor, of databases, one that is only trusted."""
    said = [by_lines(0.9)]
    given = replace(NOTHING, source="given", given=("focal",))
    assert camera_prior(camera(), given, said) == CameraPrior(1200.0, 0.0)
    trusted = replace(NOTHING, source="given")
    assert camera_prior(camera(), trusted, said).focal_px == pytest.approx(1200.0)


def test_lines_of_many_images_leave_a_tenth_of_a_focal_length_open() -> None:
    sharp = [by_lines(0.9, 0.06)] * 20
    assert camera_prior(camera(), NOTHING, sharp).sigma == pytest.approx(0.1)


def test_the_prior_of_a_camera_of_many_images_is_made_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked_at = []
    by_number = {f"{number}.jpg": by_lines(0.9) for number in range(50)}
    shared = CameraRecord(tuple(by_number), "guess", 1200.0, size=SIZE)

    def look(lines_of_image: LineCamera) -> Measurement | None:
        looked_at.append(lines_of_image)
        return measurement_of_lines(lines_of_image)

    monkeypatch.setattr(module, "measurement_of_lines", look)
    camera_priors([camera()] * 50, {1: shared}, by_number)
    assert len(looked_at) == 50


def test_without_lines_models_begin_with_lenses_from_wide_to_long() -> None:
    prior = camera_prior(camera(), NOTHING)
    assert (prior.focal_px, prior.sigma) == (USUAL_FOCAL * 1000, USUAL_SIGMA)
    assert prior.starts_px == pytest.approx(
        [zoom * USUAL_FOCAL * 1000 for zoom in ZOOMS]
    )
    absurd = camera_prior(
        camera(), NOTHING, [by_lines(4.0)]
    )  # lines lie more often than that
    assert absurd.focal_px < 1600.0
    vague = camera_prior(camera(), NOTHING, [by_lines(1.6, 0.3)])
    assert len(vague.starts_px) == len(ZOOMS)
    assert max(vague.starts_px) / min(vague.starts_px) < max(ZOOMS) / min(ZOOMS)


def test_models_of_crops_begin_with_the_focal_length_of_the_whole_photograph() -> None:
    crop = replace(NOTHING, uncropped_px=2400.0)
    prior = camera_prior(camera(), crop)
    assert prior.starts_px[0] == pytest.approx(2400.0)
    assert prior.cost(1.5 * 2400.0) == pytest.approx(
        2.05, abs=0.1
    )  # it may have been scaled, too
    by_lines_too = camera_prior(camera(), crop, [by_lines(2.3)])
    assert by_lines_too.focal_px == pytest.approx(2320.0, rel=0.02)
    assert prior.principal_point
    assert prior.principal_point.sigmas_px == pytest.approx([150.0, 150.0])


def test_a_shift_that_lines_tell_frees_the_principal_point_and_others_do_not() -> None:
    shifted = camera_prior(camera(), NOTHING, [by_lines(1.2, 0.1, 0.18, 0.04)])
    assert shifted.principal_point
    assert shifted.principal_point.center_px == pytest.approx((500.0, 350.0 + 180.0))
    assert shifted.principal_point.sigmas_px == pytest.approx(
        [1000 * MIDDLE_SIGMA, 40.0]
    )
    for unclear in (by_lines(1.2, 0.1, 0.05, 0.09), by_lines(1.2, 0.1, 0.01, 0.02)):
        assert camera_prior(camera(), NOTHING, [unclear]).principal_point is None
    twice = [by_lines(1.2, 0.1, 0.08, 0.04)] * 3  # of one camera
    assert camera_prior(camera(), NOTHING, twice).principal_point
    given = replace(NOTHING, given=("principal-point",))
    assert camera_prior(camera(), given, twice).principal_point is None


def test_a_principal_point_costs_by_its_deviation() -> None:
    moved = camera(1150.0)
    prior = replace(
        camera_prior(moved, NOTHING), principal_point=usual_principal_point(moved)
    )
    assert prior.cost_of(moved) == pytest.approx(0.0)
    assert usual_principal_point(moved).sigmas_px == (20.0, 20.0)
    moved.principal_point_y += 2.0 * MIDDLE_SIGMA * 1000
    assert prior.cost_of(moved) == pytest.approx(2.0)


@pytest.mark.parametrize(("focal", "sigma", "is_named"), [
    (0.9, 0.06, True), (1.25, 0.06, False), (0.9, 0.3, False),
])  # fmt: skip
def test_exif_and_given_focal_lengths_that_lines_contradict_are_named(
    focal: float, sigma: float, *, is_named: bool
) -> None:
    said = {"a.jpg": by_lines(focal, sigma)}
    for source in ("exif", "given"):
        record = replace(NOTHING, source=source)
        found = focal_contradictions([camera()], {1: record}, said)
        assert [c.names for c in found] == ([("a.jpg",)] if is_named else [])
    assert not focal_contradictions([camera()], {1: NOTHING}, said)


def with_usual(focal: float, sigma: float) -> LineCamera:
    """Return a camera by lines that alone say a focal length, together with what is usual."""
    precision = sigma**-2 + lines.USUAL_FOCAL_SIGMA**-2
    weighted = math.log(focal) * sigma**-2
    weighted += math.log(lines.USUAL_FOCAL) * lines.USUAL_FOCAL_SIGMA**-2
    return by_lines(math.exp(weighted / precision), precision**-0.5)


def test_what_lines_measure_is_without_what_is_usual_beforehand() -> None:
    measured = measurement_of_lines(with_usual(2.0, 0.2))
    assert measured is not None
    assert measured.focal.focal == pytest.approx(2.0)
    assert measured.focal.sigma == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("difference", "is_contradicted"), [(0.28, False), (0.4, True)]
)
def test_lines_contradict_exif_beyond_what_both_may_be_wrong(
    difference: float, *, is_contradicted: bool
) -> None:
    """Lines are certain to a tenth, EXIF to 8 hundredths; two and a half deviations are 0.32."""
    record = replace(NOTHING, source="exif")
    told = {"a.jpg": with_usual(1.2 * math.exp(difference), 0.1)}
    found = focal_contradictions([camera()], {1: record}, told)
    assert bool(found) == is_contradicted
