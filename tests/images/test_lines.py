"""Straight segments of pictures: where they are, without frames and what masks leave out."""

from __future__ import annotations

import cv2
import numpy as np
from line_scenes import SIZE, Building
from numpy.testing import assert_allclose

from colmap_affrect.geometry.arrays import Bytes
from colmap_affrect.images.lines import lines_of, segments_of


def bright_rectangle() -> Bytes:
    """A picture of 600 x 400 px whose columns 150 to 449 and rows 90 to 289 are bright."""
    image = np.full((400, 600), 40, np.uint8)
    image[90:290, 150:450] = 200
    return image


def drawn(edges: np.ndarray) -> Bytes:
    """Edges as dark strokes on white."""
    image = np.full(SIZE[::-1], 230, np.uint8)
    for x1, y1, x2, y2 in edges.round().astype(int).tolist():
        cv2.line(image, (x1, y1), (x2, y2), 30, 3, cv2.LINE_AA)
    return image


def test_segments_lie_between_the_pixels_that_differ() -> None:
    segments = segments_of(bright_rectangle())
    assert len(segments) == 4
    positions = segments.middles * 600.0 + [299.5, 199.5]  # pixel-centre px
    is_level = np.abs(segments.directions[:, 0]) > 0.99
    # Columns 149 and 150 differ, and 449 and 450; rows 89 and 90, and 289 and 290.
    assert_allclose(np.sort(positions[~is_level, 0]), [149.5, 449.5], atol=0.6)
    assert_allclose(np.sort(positions[is_level, 1]), [89.5, 289.5], atol=0.6)
    assert_allclose(segments.lengths.max() * 600.0, 300.0, atol=8.0)


def test_large_pictures_have_the_same_segments_as_small_ones() -> None:
    image = bright_rectangle()
    large = cv2.resize(image, (2400, 1600), interpolation=cv2.INTER_NEAREST)
    small_segments = segments_of(image)
    large_segments = segments_of(large)
    assert len(small_segments) == len(large_segments)
    order = np.lexsort(small_segments.middles.round(1).T)
    other = np.lexsort(large_segments.middles.round(1).T)
    assert_allclose(
        small_segments.middles[order], large_segments.middles[other], atol=1.5 / 600.0
    )


def test_frames_at_the_border_are_left_out_and_lines_that_only_end_there_stay() -> None:
    image = np.full((400, 600), 235, np.uint8)
    cv2.rectangle(
        image, (6, 6), (593, 393), 20, 2
    )  # a print's frame, 1 % of the size inside
    cv2.line(image, (10, 60), (590, 340), 20, 3)
    segments = segments_of(image)
    assert len(segments) >= 2
    slopes = segments.directions[:, 1] / segments.directions[:, 0]
    assert_allclose(slopes, 280.0 / 580.0, atol=0.02)


def test_what_a_mask_leaves_out_has_no_segments() -> None:
    image = bright_rectangle()
    mask = np.ones((200, 300), np.bool_)  # of half the size of the picture
    mask[:, :100] = False  # its left edge is at column 75 of the mask
    left = segments_of(image, mask).middles[:, 0] * 600.0 + 299.5
    assert left.min() > 200.0
    assert len(left) == 3


def test_an_empty_picture_has_no_lines() -> None:
    lines = lines_of(np.full((80, 120), 128, np.uint8))
    assert len(lines.segments) == 0
    assert lines.camera() is None


def test_the_camera_of_a_drawing_is_found() -> None:
    building = Building(focal=0.85, num_each=30, noise_px=0.0)
    camera = lines_of(drawn(building.edges(11))).camera()
    assert camera is not None
    assert camera.is_known
    assert abs(np.log(camera.focal / 0.85)) < 0.1
    assert camera.up @ -building.rotation[:, 1] > np.cos(np.deg2rad(2.0))


def test_strokes_of_a_hundredth_of_the_picture_are_no_lines() -> None:
    """Stones and leaves have such edges; windows are longer."""
    image = np.full((700, 1000), 230, np.uint8)
    for x in range(100, 900, 60):
        for y in range(100, 600, 60):
            cv2.line(image, (x, y), (x + 8, y + 5), 30, 2, cv2.LINE_AA)
    assert len(segments_of(image)) == 0
    cv2.line(image, (110, 80), (140, 86), 30, 2, cv2.LINE_AA)
    assert len(segments_of(image)) > 0
