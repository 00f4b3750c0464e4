"""The commands that BENCHMARKS.md names start."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from pathlib import Path

import cv2
import many_images
import numpy as np
import pytest
from advice import follow, read_set
from prints import KINDS, make_prints
from synthetic import blobs, centroid

from colmap_affrect.colmap import pycolmap

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(
    set(re.findall(r"tests/benchmarks/\w+\.py", (ROOT / "BENCHMARKS.md").read_text()))
)


def run_script(script: str, *arguments: object) -> str:
    command = [sys.executable, script, *map(str, arguments)]
    return subprocess.run(
        command, check=True, capture_output=True, text=True, cwd=ROOT
    ).stdout


@pytest.mark.long
@pytest.mark.parametrize("script", SCRIPTS)
def test_benchmark_starts(script: str) -> None:
    assert "usage:" in run_script(script, "--help")


@pytest.mark.long
def test_speed_and_complexity_are_measured(tmp_path: Path) -> None:
    photos = ["--image-path", "sample_scenes/courtyard/images", "--num-rounds", 1]
    result = tmp_path / "speed.json"
    given = [*photos, "--num-images", 2, "--methods", "sift", "unrectified-rootsift"]
    text = run_script("tests/benchmarks/speed.py", *given, "--output-path", result)
    assert '"extract_s"' in result.read_text()
    assert "| unrectified-rootsift | " in text
    given = [*photos, "--num-images", 1, "--methods", "rectified"]
    assert "| rectified | " in run_script("tests/benchmarks/complexity.py", *given)


@pytest.mark.long
def test_whole_runs_are_timed_in_turn_and_judged(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("distributed")
    result = tmp_path / "new" / "whole.json"
    diagram = tmp_path / "drawn" / "whole.png"
    given = ["--scenes-path", "sample_scenes", "--sets", "courtyard:3"]
    given += ["--peers", "sift-colmap", "rectified", "rectified+workers"]
    given += ["--num-rounds", "1"]
    written = ["--output-path", result, "--diagram-path", diagram]
    text = run_script("tests/benchmarks/whole_run.py", *given, *written)
    runs = json.loads(result.read_text())["runs"]
    assert [run["correct"] for run in runs] == [0, 3, 3]
    for run in runs:
        assert 0.0 < sum(run["stages_s"].values()) < run["wall_s"]
    assert "| courtyard:3 | 3 | rectified | " in text
    assert "| courtyard:3 | 3 | rectified+workers | " in text
    assert diagram.read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
@pytest.mark.parametrize(
    ("given", "why"),
    [
        (["--sets", "court"], "--sets court: no folder court/images"),
        (["--sets", "courtyard:0"], "STEP is 1 or more, as in courtyard:2"),
        (["--sets", "courtyard", "--peers", "rectifid"], "did you mean 'rectified'"),
        (["--sets", "courtyard", "--num-rounds", "0"], "--num-rounds: give 1 or more"),
    ],
)
def test_whole_runs_that_cannot_end_well_do_not_begin(
    tmp_path: Path, given: list[str], why: str
) -> None:
    where = ["--scenes-path", "sample_scenes", "--output-path", tmp_path / "a.json"]
    with pytest.raises(subprocess.CalledProcessError) as failed:
        run_script("tests/benchmarks/whole_run.py", *where, *given)
    assert why in failed.value.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", KINDS)
def test_a_print_has_the_camera_that_is_written_beside_it(
    tmp_path: Path, kind: str
) -> None:
    """A blob beside the optical axis is where the print's camera projects it to."""
    image_path = tmp_path / "photos"
    image_path.mkdir()
    blob_px = np.array([[345.0, 225.0]])  # from the centre of the first pixel
    photograph = blobs((640, 480), blob_px, 6.0 * np.eye(2))
    cv2.imwrite(str(image_path / "a.png"), photograph)
    truth = pycolmap.Reconstruction()
    params = [700.0, 320.5, 236.5]  # from its corner
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=640, height=480, params=params, camera_id=1
    )
    truth.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name="a.png", camera_id=1, image_id=1)
    truth.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    (tmp_path / "truth").mkdir()
    truth.write_text(str(tmp_path / "truth"))
    out = tmp_path / "out"
    make_prints(image_path, tmp_path / "truth", out, kind, step=1, seed=3)
    model = pycolmap.Reconstruction(str(out / "ground_truth"))
    (made,) = model.cameras.values()
    (print_image,) = model.images.values()
    seen = cv2.imread(str(out / "images" / "a.jpg"), cv2.IMREAD_GRAYSCALE)
    assert seen.shape == (made.height, made.width)
    in_world = np.append((blob_px[0] + 0.5 - params[1:]) / params[0], 1.0)
    in_camera = print_image.cam_from_world() * in_world
    found = centroid(seen, float(np.median(seen)))
    assert found + 0.5 == pytest.approx(made.img_from_cam(in_camera), abs=0.15)
    center = np.array([made.principal_point_x, made.principal_point_y])
    zoom = made.mean_focal_length() / 700.0
    offset = center - np.array([made.width, made.height]) / 2.0
    assert zoom > 1.5
    turn_deg = math.degrees(print_image.cam_from_world().rotation.angle())
    assert (turn_deg > 1.0) == (kind == "turned")
    if kind == "whole":
        assert np.abs(offset).max() < 0.02 * made.width
    else:
        assert np.abs(offset).max() > 0.02 * made.width


def test_advice_is_followed_by_its_command_and_by_photographs_between(
    tmp_path: Path,
) -> None:
    photographs = tmp_path / "scene" / "images"
    photographs.mkdir(parents=True)
    for number in range(6):
        (photographs / f"{number}.jpg").touch()
    chosen = read_set("scene:4:1", tmp_path)
    assert chosen.names(chosen.step) == ["1.jpg", "5.jpg"]
    base = ["colmap-affrect", "run", "--output-path", "out"]
    more = {"code": "photographs", "command": ""}
    assert follow(chosen, more, base, tmp_path) == base
    assert (tmp_path / "names.txt").read_text() == "1.jpg\n3.jpg\n5.jpg\n"
    command = {"code": "recipe", "command": "colmap-affrect run --output-path 'a b'"}
    assert follow(chosen, command, base, tmp_path)[-1] == "a b"
    marks = {"code": "tie_points", "command": "colmap-affrect run"}
    assert follow(chosen, marks, base, tmp_path) == []


def costs_of(count: int, *, alone: bool = True) -> dict[str, object]:
    """What a call has measured; mapping memory is known by its stage alone."""
    first = {"match": [count / 10, 300.0], "guide": [0.01, 300.0], "other": [9.0, 0.0]}
    if count > 50:
        first["map"] = [count / 5, 2.0 * count]
    own = {"num_images": count, "beside_other_work": not alone}
    return own | {"first": first, "scores": f"all of {count}"}


def test_costs_of_several_calls_are_ordered_and_small_stages_left_out() -> None:
    again = costs_of(200) | {"scores": "measured again"}
    found = many_images.by_number([costs_of(200), costs_of(50), again])
    assert [one["scores"] for one in found] == ["all of 50", "measured again"]
    assert many_images.drawn_stages(found) == ["match", "map"]
    assert many_images.points_of(found, "match", 0) == ([50, 200], [5.0, 20.0])
    assert many_images.points_of(found, "map", 1) == ([200], [400.0])
    counts, seconds = many_images.guide_line(found)
    assert counts == [50, 200]
    assert seconds[0] == pytest.approx(14.01)
    growth = 200 * math.log(200) / (50 * math.log(50))
    assert seconds[1] == pytest.approx(14.01 * growth)


def test_costs_of_several_calls_stand_in_one_diagram(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "a.json").write_text(json.dumps([costs_of(50), costs_of(200)]))
    (tmp_path / "b.json").write_text(json.dumps([costs_of(5000, alone=False)]))
    diagram = tmp_path / "new" / "many.png"
    given = ["--output-path", tmp_path, "--diagram-path", diagram, "--costs-paths"]
    given += [tmp_path / "a.json", tmp_path / "b.json"]
    monkeypatch.setattr(sys, "argv", ["many_images.py", *map(str, given)])
    many_images.main()
    text = capsys.readouterr().out
    assert "| match | 5.0 s, 300 MiB | 20.0 s, 300 MiB | 500.0 s, 300 MiB |" in text
    assert "all of 5000" in text
    assert diagram.read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "images").exists()
