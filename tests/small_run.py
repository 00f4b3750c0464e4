"""A finished run whose photographs, database and model are on disk, made without running it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from small_comparison import IMAGE_SIZE, write_scene
from synthetic import texture, write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.project.advised import Advice
from colmap_affrect.project.image_failures import ImageFailure
from colmap_affrect.project.reasons import Doubt, Missing
from colmap_affrect.project.report import Bridge, ModelSummary
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.stage_warnings import StageWarning
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.observations import ModelReader
from colmap_affrect.report.pair_lines import LinesOfRun
from colmap_affrect.report.pair_matches import PairReader
from colmap_affrect.report.pairs import PairPicture
from colmap_affrect.report.photographs import photographs_of_report
from colmap_affrect.report.pictures import Picture
from colmap_affrect.report.run_page import RunContent, write_run_page
from colmap_affrect.report.run_report import RunReport
from colmap_affrect.session.context import Context
from colmap_affrect.session.view_graph import ViewGraph

NAMES = (
    "<img src=x onerror=alert(1)>.png",
    "b\u202egnp.c",
    "c.png",
    "d.png",
    "e.png",
    "f.png",
)
"""The second one is shown turned round where nobody takes care."""

MORE = Advice("photographs", "more photographs")


def small_report(folder: Path) -> RunReport:
    """Four of six photographs, each of which came in in another way; paths in what is said."""
    model = ModelSummary(
        NAMES[:4],
        90,
        3.5,
        0.25,
        doubtful={NAMES[3]: (Doubt("mirrored_copy", {"original": "<b>.jpg"}),)},
        unsure={NAMES[2]: (Doubt("few_matches"),)},
        probabilities=dict(zip(NAMES, (0.99, 0.95, 0.7, 0.4), strict=False)),
        bridges={NAMES[2]: Bridge(NAMES[0], 12, 15, 0.031)},
    )
    camera = {
        "id": 1, "num_images": 6, "names": list(NAMES), "source": "exif", "focal_px": 200.0,
        "refined_px": 204.4, "why": "one of them",
    }  # fmt: skip
    failure = ImageFailure("no_image", str(folder / "photographs" / "f.png"))
    return RunReport(
        output_path=folder,
        images_total=6,
        unregistered={
            NAMES[4]: Missing("no_verified_pair"),
            NAMES[5]: Missing("unreadable"),
        },
        models=(model,),
        num_verified_pairs=15,
        num_pairs=15,
        stages=(
            StageReport("extract", 6.5, 5, failed={NAMES[5]: failure}),
            StageReport(
                "map",
                3.25,
                1,
                warned=(
                    StageWarning(
                        "not_rectified",
                        "/home/someone/model",
                        {"reason": "an <old> one"},
                    ),
                ),
            ),
        ),
        recipe="default",
        versions={"colmap-affrect": "1.2.3"},
        preset="sparse",
        verification={"max_error_px": 3.0},
        mapping={"name": "sparse", "mapper_options": {}},
        advice=(
            Advice(
                "effort",
                "one camera",
                f"colmap-affrect run --output-path {folder}/out-2",
            ),
            MORE,
        ),
        guided={"pairs": 2, "matches_before": 20, "matches_after": 1050},
        cameras=(camera,),
    )


def make_run_page(folder: Path) -> Path:
    """Write the page of the small run."""
    photographs_path = folder / "photographs"
    photographs_path.mkdir()
    for number, name in enumerate(NAMES[:5]):
        write_image(folder / "texture.png", texture(IMAGE_SIZE, number))
        (folder / "texture.png").rename(photographs_path / name)
    (photographs_path / NAMES[5]).write_bytes(b"no image")
    workspace = Workspace(folder / "out")
    (workspace.sparse / "0").mkdir(parents=True)
    model, pairs = write_scene(workspace.database, NAMES)
    for image in list(model.images.values()):
        if image.name not in NAMES[:4]:
            model.deregister_frame(image.frame_id)
    pycolmap.Reconstruction(model).write(workspace.sparse / "0")
    pair = PairPicture(
        names=NAMES[:2],
        why=f"{NAMES[0]} is doubtful; guided",
        text="120 matches by dense-shapes, 60 inliers",
        option=f"--reject-pair '{NAMES[0]},{NAMES[1]}'",
        picture=Picture.from_image(np.zeros((450, 900, 3), np.uint8)),
    )
    graph = ViewGraph(workspace.database)
    reader = PairReader(graph, Context(workspace))
    report = small_report(folder)
    photographs = photographs_of_report(
        ModelReader(workspace.sparse), NAMES, report.models, report.cameras, {}
    )
    lines = LinesOfRun(reader, NAMES, pairs)
    content = RunContent(
        NAMES,
        pairs,
        photographs_path,
        pairs_to_check=[pair] * 3,
        pair_lines=lines.of_page(),
        pair_files=lines.write_files(workspace),
        num_pairs_left_out=lines.num_left_out,
        cameras=graph.cameras,
    )
    return write_run_page(workspace, replace(report, photographs=photographs), content)
