"""Size of the page of a run, and how soon a browser has drawn it. Usage:

    python tests/benchmarks/page.py --pages out/report.html
    python tests/benchmarks/page.py --num-images 1000 --output-path out/page

The second makes up a run: photographs cut from those of a sample scene, a synthetic model that all
are in, as many points and observations as a page takes, and forty pairs of each photograph, most
of them in files beside the page. Each page is opened three times in headless Chromium, 1,400 px
wide. Prints a table.
"""

from __future__ import annotations

import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import cv2
import numpy as np
from machine import describe_machine, parser_of, table

from colmap_affrect.colmap import pycolmap
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.observations import ModelReader
from colmap_affrect.report.pair_lines import LinesOfRun
from colmap_affrect.report.pair_matches import MatchedPair, MatchKind
from colmap_affrect.report.photographs import photographs_of_report
from colmap_affrect.report.run_page import RunContent, write_run_page
from colmap_affrect.report.run_report import RunReport

sys.path.append(str(Path(__file__).parents[1]))

from browser import Browser, chromium, until_drawn

ROOT = Path(__file__).parents[2]
SOURCES = ROOT / "sample_scenes" / "courtyard_historical" / "images"
IMAGE_SIZE = (640, 480)
NUM_POINTS = 250_000  # more than a page draws
NUM_SEEN_POINTS = 600  # of them, by all photographs: more than a page tells of
NUM_NEIGHBOURS = 40  # photographs that each one is verified with
NUM_OPENINGS = 3
WIDTH = 1400
NUM_INLIERS = 60  # of a pair
TEXT = "60 matches by dense-shapes, 60 inliers, 97% of them agree with the model"
HEADER = (
    "page",
    "MB",
    "MB in files beside it",
    "first paint after, s",
    "drawn after, s",
    "pair of a file, s",
    "in the console",
    "asked for",
)
FIRST_PAINT = """return performance.getEntriesByName("first-contentful-paint")[0]?.startTime
    ?? NaN"""
PAIR_TEXT = "return document.querySelector('#pair .readout').textContent"
REQUESTS = """return performance.getEntriesByType("resource")
    .map((entry) => entry.name).filter((name) => !name.startsWith("data:"))"""


def draw_photographs(folder: Path, names: Sequence[str]) -> None:
    """Cut photographs from those of the sample scene, each somewhere else."""
    folder.mkdir(parents=True, exist_ok=True)
    sources = []
    for path in sorted(SOURCES.glob("*.jpg")):
        sources.append(cv2.imread(str(path)))
    random = np.random.default_rng(0)
    width, height = IMAGE_SIZE
    for number, name in enumerate(names):
        source = sources[number % len(sources)]
        left = int(random.integers(0, source.shape[1] - width // 2))
        top = int(random.integers(0, source.shape[0] - height // 2))
        part = source[top : top + height // 2, left : left + width // 2]
        cv2.imwrite(str(folder / name), cv2.resize(part, IMAGE_SIZE))


def make_model(names: Sequence[str]) -> pycolmap.Reconstruction:
    """Return a synthetic model that all photographs are in."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 1
    options.num_frames_per_rig = len(names)
    options.num_points3D = NUM_SEEN_POINTS
    options.camera_width, options.camera_height = IMAGE_SIZE
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    for image, name in zip(model.images.values(), names, strict=True):
        image.name = name
    random = np.random.default_rng(0)
    for _ in range(NUM_POINTS - model.num_points3D()):
        color = random.integers(0, 256, 3).astype(np.uint8)
        model.add_point3D(random.normal(size=3), pycolmap.Track(), color)
    return model


def make_page(num_images: int, folder: Path) -> Path:
    """Write the page of a made-up run."""
    names = [f"photograph_{number:04d}.jpg" for number in range(num_images)]
    draw_photographs(folder / "photographs", names)
    workspace = Workspace(folder / "out")
    (workspace.sparse / "0").mkdir(parents=True, exist_ok=True)
    model = make_model(names)
    model.write(workspace.sparse / "0")
    summary = ModelSummary(
        tuple(names), NUM_POINTS, 3.0, 0.5, probabilities=dict.fromkeys(names, 0.95)
    )
    num_inliers = dict[Pair, int]()
    for first in range(num_images):
        for second in range(first + 1, min(num_images, first + 1 + NUM_NEIGHBOURS)):
            num_inliers[names[first], names[second]] = 20 + (first * second) % 500
    report = RunReport(
        output_path=workspace.path,
        images_total=num_images,
        unregistered={},
        models=(summary,),
        num_verified_pairs=len(num_inliers),
        num_pairs=len(num_inliers),
        stages=(),
        recipe="default",
        versions={"colmap-affrect": "made up"},
        preset="sparse",
        verification={},
        mapping={"name": "sparse", "mapper_options": {}},
        photographs=photographs_of_report(
            ModelReader(workspace.sparse), names, (summary,), (), {}
        ),
    )
    lines = LinesOfRun(MadeUpPairs(), names, num_inliers)
    cameras = {}
    for image in model.images.values():
        cameras[image.name] = model.cameras[image.camera_id]
    content = RunContent(
        names,
        num_inliers,
        folder / "photographs",
        pair_lines=lines.of_page(),
        pair_files=lines.write_files(workspace),
        cameras=cameras,
    )
    return write_run_page(workspace, report, content)


class MadeUpPairs:
    """Reads pairs of a made-up run, as ``PairReader`` does those of a real one."""

    def __init__(self) -> None:
        self._random = np.random.default_rng(0)

    def read(self, _: Pair) -> MatchedPair:
        """Return matches anywhere in two photographs."""
        shape = (NUM_INLIERS, 2)
        points = [self._random.uniform(0.0, IMAGE_SIZE, shape) for _ in range(2)]
        kinds = np.full(NUM_INLIERS, MatchKind.OWN)
        return MatchedPair([IMAGE_SIZE, IMAGE_SIZE], points, kinds, TEXT)


def row_of(browser: Browser, page: Path) -> list[str]:
    """Open a page some times; return its cells."""
    times_s = []
    paints_s = []
    for _ in range(NUM_OPENINGS):
        begin_s = time.monotonic()
        browser.open(page)
        until_drawn(browser)
        times_s.append(time.monotonic() - begin_s)
        paints_s.append(browser.run(FIRST_PAINT) / 1e3)
    file_s = time_of_file(browser)
    said = browser.log()
    asked = browser.run(REQUESTS)
    beside = sorted(page.parent.glob("report.pairs-*.js"))
    beside_mb = sum(path.stat().st_size for path in beside) / 1e6
    return [
        page.parent.name,
        f"{page.stat().st_size / 1e6:.2f}",
        f"{beside_mb:.2f} in {len(beside)}",
        f"{median(paints_s):.1f}",
        f"{median(times_s):.1f}",
        file_s,
        str(len(said)),
        str(len(asked)),
    ]


def time_of_file(browser: Browser) -> str:
    """Return the seconds until a pair of the last file beside a page is shown; - without files."""
    numbers = browser.run("return page.data.pair_files.at(-1)?.slice(1) ?? null")
    if numbers is None:
        return "-"
    begin_s = time.monotonic()
    browser.run("page.showPair(...arguments)", *numbers)
    while TEXT not in browser.run(PAIR_TEXT):
        time.sleep(0.01)
    return f"{time.monotonic() - begin_s:.2f}"


def parsed_arguments() -> Namespace:
    """Return what the command line says."""
    parser = parser_of(__doc__)
    parser.add_argument("--pages", nargs="+", type=Path, default=[], help="HTML files")
    parser.add_argument("--num-images", type=int, help="of a run that is made up")
    parser.add_argument("--output-path", type=Path, help="folder for that run")
    return parser.parse_args()


def main() -> None:
    """Open the pages and print the table."""
    arguments = parsed_arguments()
    pages = list(arguments.pages)
    if arguments.num_images:
        if not arguments.output_path:
            raise SystemExit("--num-images: give --output-path, too")
        pages.append(make_page(arguments.num_images, arguments.output_path))
    with (
        tempfile.TemporaryDirectory() as profile,
        chromium(Path(profile)) as browser,
    ):
        browser.resize(WIDTH)
        rows = [row_of(browser, page) for page in pages]
    print(f"{describe_machine()}\n\n{table(HEADER, rows)}")


if __name__ == "__main__":
    main()
