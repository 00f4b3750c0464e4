r"""Sets of photographs in which something false ties them, from scenes whose poses are known.

Kinds: `poster`, the same print in two places; `posters`, three prints; `collage`, photographs of
two places side by side; `elsewhere`, a print of one place in photographs of another one; `statue`,
the same rough surface in two places; `tower`, a box whose four sides are the same; `moving`, a
surface that flows on from photograph to photograph, before a scene that stays; `drifting`, a rough
surface that travels as one, as ice does; `true`, none of this. A print is drawn as a board that
stands in the scene, in right perspective. Usage:

    python tests/benchmarks/made_up.py make OUT --kind poster --first SCENE --second SCENE \
        --print JPG
    python tests/benchmarks/made_up.py judge OUT/result OUT
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
from machine import parser_of
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import pose_errors, read_poses, relative_pose
from colmap_affrect.mappers.mapping import model_folders, read_summary
from colmap_affrect.project.report import SURE

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]

KINDS = (
    "poster",
    "posters",
    "collage",
    "elsewhere",
    "statue",
    "tower",
    "moving",
    "drifting",
    "true",
)
NUM_STRIPS = 6  # of a rough surface
ROUGHNESS = (
    0.12  # of the distance of a rough surface, that its strips are apart in depth
)
TRUTH = "truth.json"
MAX_ERROR_DEG = 5.0
SAME_PLACE = 1e-6  # of the units of a scene: nothing tells a direction


@dataclass
class Shot:
    """A photograph, shrunk, whose pose is known."""

    picture: Picture
    calibration: Array  # (3, 3)
    rotation: Array  # cam_from_world
    translation: Array

    @property
    def center(self) -> Array:
        return np.asarray(-self.rotation.T @ self.translation)

    @property
    def axis(self) -> Array:
        return np.asarray(self.rotation[2])


@dataclass
class Board:
    """A rectangle in a scene."""

    middle: Array
    right: Array  # half of its width
    down: Array  # half of its height

    def corners(self) -> Array:
        signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        return np.array(
            [self.middle + x * self.right + y * self.down for x, y in signs]
        )


def read_shots(scene: Path, chosen: slice, size_px: int) -> list[Shot]:
    """Read some photographs of a scene, shrunk, with their poses."""
    truth = next(
        scene / name
        for name in ("ground_truth", "pseudo_ground_truth")
        if (scene / name).exists()
    )
    model = pycolmap.Reconstruction(truth)
    images = {image.name: image for image in model.images.values()}
    shots = []
    for path in sorted((scene / "images").iterdir())[chosen]:
        if path.name not in images:
            continue
        image = images[path.name]
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        scale = size_px / max(picture.shape[:2])
        small = cv2.resize(
            picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
        )
        camera = model.cameras[image.camera_id]
        of_picture = scale * picture.shape[1] / camera.width
        calibration = (
            np.diag([of_picture, of_picture, 1.0]) @ camera.calibration_matrix()
        )
        pose = image.cam_from_world().matrix()
        shots.append(Shot(small, calibration, pose[:, :3], pose[:, 3]))
    return shots


def board_before(shots: list[Shot], share: float, aside: float) -> Board:
    """Place a board before a scene, facing its cameras.

    Args:
        shots: Of the scene.
        share: Of the width of photographs that it takes.
        aside: From the middle to the right, in widths of photographs.
    """
    normal_sum = np.zeros((3, 3))
    moment = np.zeros(3)
    for shot in shots:  # the point nearest to all optical axes
        across = np.eye(3) - np.outer(shot.axis, shot.axis)
        normal_sum += across
        moment += across @ shot.center
    focus = np.linalg.lstsq(normal_sum, moment, rcond=None)[0]
    viewer = np.mean([shot.center for shot in shots], axis=0)
    middle = viewer + 0.6 * (focus - viewer)
    ahead = (focus - viewer) / np.linalg.norm(focus - viewer)
    down = np.mean([shot.rotation[1] for shot in shots], axis=0)
    down -= ahead * (ahead @ down)
    down /= np.linalg.norm(down)
    right = np.cross(down, ahead)
    distance = float(np.linalg.norm(middle - viewer))
    shot = shots[0]
    width = distance * shot.picture.shape[1] / shot.calibration[0, 0]
    half = 0.5 * share * width
    return Board(middle + aside * width * right, half * right, 0.75 * half * down)


def draw(shot: Shot, board: Board, print_: Picture, flow: float = 0.0) -> None:
    """Draw a print onto a board in a photograph; with a flow, by so many widths further along."""
    cameras = board.corners() @ shot.rotation.T + shot.translation
    if cameras[:, 2].min() <= 0:
        return
    projected = cameras @ shot.calibration.T
    corners = (projected[:, :2] / projected[:, 2:]).astype(np.float32)
    height, width = print_.shape[:2]
    moved = np.roll(print_, round(flow * width), axis=1)
    source = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    homography = cv2.getPerspectiveTransform(source, corners)
    size = (shot.picture.shape[1], shot.picture.shape[0])
    warped = cv2.warpPerspective(moved, homography, size, flags=cv2.INTER_AREA)
    covered = cv2.warpPerspective(
        np.full(moved.shape[:2], 255, np.uint8), homography, size
    )
    soft = (cv2.GaussianBlur(covered, (0, 0), 0.7) / 255.0)[..., None]
    shot.picture = (soft * warped + (1.0 - soft) * shot.picture).astype(np.uint8)


def strips_of(board: Board, viewer: Array) -> list[Board]:
    """Cut a board into strips one above the other, every other one farther away."""
    found = []
    for index in range(NUM_STRIPS):
        place = (2 * index + 1) / NUM_STRIPS - 1.0
        middle = board.middle + place * board.down
        farther = 1.0 + ROUGHNESS * (index % 2)
        found.append(
            Board(
                viewer + farther * (middle - viewer),
                farther * board.right,
                farther * board.down / NUM_STRIPS,
            )
        )
    return found


def draw_solid(
    shots: list[Shot], print_: Picture, arguments: argparse.Namespace
) -> None:
    """Draw what is no board: a tower, or a rough surface."""
    if arguments.kind == "tower":
        draw_tower(shots, print_, arguments.share)
    else:
        draw_rough(shots, print_, arguments)


def draw_rough(
    shots: list[Shot], print_: Picture, arguments: argparse.Namespace
) -> None:
    """Draw a rough surface, which may travel as one from photograph to photograph.

    Args:
        shots: Of a scene, in the order of time.
        print_: What the surface shows.
        arguments: Its share, place, and how far it travels in how many photographs.
    """
    board = board_before(shots, arguments.share, 0.0)
    width = 2.0 * board.right / arguments.share
    height = 2.0 * board.down / arguments.share
    board.middle += arguments.below * height
    viewer = np.mean([shot.center for shot in shots], axis=0)
    depth = board.middle - viewer
    strips = strips_of(board, viewer)
    rows = np.array_split(np.arange(print_.shape[0]), NUM_STRIPS)
    for step, shot in enumerate(shots):
        time = step * arguments.times // len(shots)
        if arguments.times == 1:
            time = step // arguments.still_for
        right, down, ahead = arguments.travel
        if arguments.kind == "statue":
            time = 0
        way = time * (right * width + down * height + ahead * depth)
        for index in (1, 3, 5, 0, 2, 4):  # what is farther away first
            moved = Board(
                strips[index].middle + way, strips[index].right, strips[index].down
            )
            draw(shot, moved, print_[rows[index]])


def draw_tower(shots: list[Shot], print_: Picture, share: float) -> None:
    """Draw a box whose four sides show the same.

    Args:
        shots: Of a scene.
        print_: What each side shows.
        share: Of the width of photographs that a side takes.
    """
    front = board_before(shots, share, 0.0)
    up = front.down / np.linalg.norm(front.down)
    radius = float(np.linalg.norm(front.right))
    viewer = np.mean([shot.center for shot in shots], axis=0)
    ahead = np.cross(front.right / radius, up)
    ahead *= np.sign(ahead @ (front.middle - viewer))
    middle = front.middle + radius * ahead
    sides = []
    for normal, right in (
        (-ahead, front.right),
        (front.right / radius, radius * ahead),
        (ahead, -front.right),
        (-front.right / radius, -radius * ahead),
    ):
        sides.append((normal, Board(middle + radius * normal, right, front.down)))
    for shot in shots:
        for normal, board in sides:
            if normal @ (shot.center - board.middle) > 0.0:
                draw(shot, board, print_)


def read_print(path: Path, size_px: int) -> Picture:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    scale = size_px / max(picture.shape[:2])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def side_by_side(first: Picture, second: Picture) -> Picture:
    height = min(first.shape[0], second.shape[0])
    halves = []
    for picture in (first, second):
        width = round(picture.shape[1] * height / picture.shape[0])
        halves.append(
            cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        )
    return np.asarray(np.hstack(halves), np.uint8)


def change(
    groups: dict[str, list[Shot]], prints: list[Picture], arguments: argparse.Namespace
) -> dict[str, Picture]:
    """Draw what is false into photographs; return photographs that belong to no group."""
    kind = arguments.kind
    share = arguments.share
    if kind == "true":
        return {}
    if kind in ("drifting", "statue", "tower"):
        for shots in groups.values():
            draw_solid(shots, prints[0], arguments)
        return {}
    if kind == "collage":
        pictures = [shots[0].picture for shots in groups.values()]
        return {"collage.jpg": side_by_side(*pictures)}
    for number, shots in enumerate(groups.values()):
        sign = 1 if number else -1
        places = [0.15 * sign]
        if kind == "posters":
            places = [-0.35, 0.0, 0.35]
        if kind == "elsewhere" and number == 0:
            continue
        for place, print_ in zip(places, prints * len(places), strict=False):
            board = board_before(shots, share / len(places), place)
            for step, shot in enumerate(shots):
                flow = 0.04 * step if kind == "moving" else 0.0
                draw(shot, board, print_, flow)
    return {}


def make(arguments: argparse.Namespace) -> None:
    """Write the photographs of a set and its truth."""
    folder = arguments.folder
    images = folder / "images"
    images.mkdir(parents=True)
    scenes = {"a": (arguments.first, arguments.of_first)}
    if arguments.second:
        scenes["b"] = (arguments.second, arguments.of_second)
    groups: dict[str, list[Shot]] = {}
    for group, (scene, chosen) in scenes.items():
        numbers = slice(*[int(part) if part else None for part in chosen.split(":")])
        groups[group] = []
        for _ in range(arguments.times):  # from the same places once more
            groups[group] += read_shots(scene, numbers, arguments.size_px)
    prints = [read_print(path, arguments.size_px) for path in arguments.print]
    if arguments.kind == "elsewhere":
        prints = [groups["a"][0].picture.copy()]
    others = change(groups, prints, arguments)
    truth: dict[str, Any] = {}
    for group, shots in groups.items():
        for number, shot in enumerate(shots):
            name = f"{group}{number}.jpg"
            cv2.imwrite(
                str(images / name), shot.picture, [cv2.IMWRITE_JPEG_QUALITY, 93]
            )
            place = scenes[group][0].name  # two groups of one scene are one place
            truth[name] = [place, shot.rotation.tolist(), shot.translation.tolist()]
    for name, picture in others.items():
        cv2.imwrite(str(images / name), picture, [cv2.IMWRITE_JPEG_QUALITY, 93])
    (folder / TRUTH).write_text(json.dumps(truth), encoding="utf-8")


def wrong_names(folder: Path, truth: dict[str, Any]) -> set[str]:
    """Return the photographs of a model that are wrong beside those of its largest group."""
    poses = read_poses(folder)
    groups = Counter(truth[name][0] for name in poses if name in truth)
    main = groups.most_common(1)[0][0] if groups else ""
    inside = [name for name in poses if name in truth and truth[name][0] == main]
    wrong = set(poses) - set(inside)
    for name in inside:
        errors = []
        for other in inside:
            if other == name:
                continue
            estimated = relative_pose(poses[name], poses[other])
            poses_of_both = [
                (np.array(truth[n][1]), np.array(truth[n][2])) for n in (name, other)
            ]
            true = relative_pose(*poses_of_both)
            of_both = pose_errors(estimated, true)
            is_same_place = np.linalg.norm(true[1]) < SAME_PLACE
            errors.append(of_both[0] if is_same_place else max(of_both))
        if errors and median(errors) > MAX_ERROR_DEG:
            wrong.add(name)
    return wrong


def judge(arguments: argparse.Namespace) -> None:
    """Print how many photographs are right and wrong, and how many of each are sure."""
    truth = json.loads((arguments.truth / TRUTH).read_text(encoding="utf-8"))
    counts: Counter[str] = Counter()
    for folder in model_folders(arguments.folder / "sparse"):
        summary = read_summary(folder)
        wrong = wrong_names(folder, truth)
        for name, probability in summary.probabilities.items():
            is_right = "wrong" if name in wrong else "right"
            counts[is_right] += 1
            counts[f"sure and {is_right}"] += probability >= SURE
            counts[f"doubtful and {is_right}"] += name in summary.doubtful
    texts = [f"{counts[key]} {key}" for key in sorted(counts)]
    print(
        f"{arguments.folder.parent.name}: {len(truth)} photographs; {', '.join(texts)}"
    )


def main() -> None:
    """Make a set, or judge the models of one."""
    parser = parser_of(__doc__)
    commands = parser.add_subparsers(required=True)
    making = commands.add_parser("make", help="make a set")
    making.add_argument("folder", type=Path, help="new folder")
    making.add_argument("--kind", choices=KINDS, required=True)
    making.add_argument(
        "--first", type=Path, required=True, help="scene with true poses"
    )
    making.add_argument(
        "--of-first", default="::1", help="its photographs: first:end:step"
    )
    making.add_argument("--second", type=Path, help="another one")
    making.add_argument("--of-second", default="::1", help="its photographs")
    making.add_argument(
        "--print", type=Path, nargs="*", default=[], help="prints on boards"
    )
    making.add_argument(
        "--share", type=float, default=0.4, help="of a board, of the width"
    )
    making.add_argument(
        "--travel",
        type=float,
        nargs=3,
        default=[0.08, 0.0, 0.0],
        help="right, down (widths, heights of photographs) and ahead (of the distance)",
    )
    making.add_argument(
        "--still-for", type=int, default=1, help="photographs between two travels"
    )
    making.add_argument(
        "--times", type=int, default=1, help="that each place is photographed"
    )
    making.add_argument(
        "--below", type=float, default=0.15, help="the middle, of the height"
    )
    making.add_argument("--size-px", type=int, default=640, help="longer side")
    making.set_defaults(run=make)
    judging = commands.add_parser(
        "judge", help="count what is wrong, and what of it is sure"
    )
    judging.add_argument("folder", type=Path, help="output folder of a run")
    judging.add_argument("truth", type=Path, help="folder of the set")
    judging.set_defaults(run=judge)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
