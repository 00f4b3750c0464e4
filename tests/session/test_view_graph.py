"""The database of a command is opened once, and what is read of it is what it holds now."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.colmap.tables import rows_digest
from colmap_affrect.errors import AffrectError
from colmap_affrect.session.view_graph import ViewGraph


def add_image(database: pycolmap.Database, name: str) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 80, 60)
    camera.camera_id = database.write_camera(camera)
    database.write_image(pycolmap.Image(name=name, camera_id=camera.camera_id))


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """Counts how often databases are opened."""
    counted = Mock(wraps=pycolmap.Database.open)
    monkeypatch.setattr(pycolmap.Database, "open", counted)
    return counted


def test_database_that_is_kept_open_is_opened_once_and_closed_in_the_end(
    tmp_path: Path, opened: Mock
) -> None:
    graph = ViewGraph(tmp_path / "database.db")
    with graph.keep_open():
        for number, name in enumerate(("a.png", "b.png"), start=1):
            with graph.open_to_change() as database:
                add_image(database, name)
            assert len(graph.ids) == len(graph.cameras) == number
        with graph.open_to_read() as database:
            assert database.num_images() == 2
        assert opened.call_count == 1
    assert not (tmp_path / "database.db-wal").exists()
    assert image_ids(graph.path).keys() == {"a.png", "b.png"}
    assert graph.ids.keys() == {"a.png", "b.png"}


def test_digest_is_of_what_was_written_while_the_database_is_kept_open(
    tmp_path: Path,
) -> None:
    graph = ViewGraph(tmp_path / "database.db")
    digests = []
    with graph.keep_open():
        for name in ("a.png", "b.png"):
            with graph.open_to_change() as database:
                add_image(database, name)
            digests.append(graph.digest())
            assert graph.digest() == digests[-1]
    assert digests[0] != digests[1] == rows_digest(graph.path)


def test_database_that_was_removed_or_replaced_meanwhile_is_opened_anew(
    tmp_path: Path,
) -> None:
    graph = ViewGraph(tmp_path / "database.db")
    other = tmp_path / "other.db"
    with open_database(other) as database:
        add_image(database, "other.png")
    with graph.keep_open():
        with graph.open_to_change() as database:
            add_image(database, "a.png")
        graph.path.unlink()
        with graph.open_to_change() as database:
            assert database.num_images() == 0
            add_image(database, "b.png")
        assert graph.ids.keys() == {"b.png"}
        graph.forget()
        other.replace(graph.path)
        assert graph.ids.keys() == {"other.png"}


def test_failure_of_the_database_is_one_line_and_it_is_opened_again(
    tmp_path: Path,
) -> None:
    graph = ViewGraph(tmp_path / "database.db")
    with graph.keep_open():
        with graph.open_to_change() as database:
            add_image(database, "a.png")
        failing = Mock(side_effect=RuntimeError("disk I/O error"))
        refused = pytest.raises(AffrectError, match=r"database\.db: cannot be written")
        with refused, graph.open_to_change() as database:
            add_image(database, "b.png")
            failing()
        assert graph.ids.keys() == {"a.png", "b.png"}


def test_inliers_are_counted_without_being_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = ViewGraph(tmp_path / "database.db")
    with graph.open_to_change() as database:
        for name in ("b.png", "a.png", "c.png"):
            add_image(database, name)
        for pair, count in (((2, 3), 4), ((1, 2), 9), ((1, 3), 0)):
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = np.zeros((count, 2), np.uint32)
            database.write_two_view_geometry(*pair, geometry)
    counted = [list(graph.num_inliers(limit).items()) for limit in (1, 4, 5)]
    assert [len(found) for found in counted] == [2, 2, 1]
    for limit, found in zip((1, 4, 5), counted, strict=True):
        read = graph.inliers(limit).items()
        assert found == [(pair, len(rows)) for pair, rows in read]
    monkeypatch.setattr("colmap_affrect.session.view_graph._read_num_inliers", None)
    assert list(graph.num_inliers(1).items()) == counted[0]  # once read, they are there
