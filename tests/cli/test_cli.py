"""The command line: what it prints where, and how it ends; where that matters, in a process."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from command import Call, on_photographs
from small_scene import write_photographs

from colmap_affrect.cli import commands, main
from colmap_affrect.colmap.model_files import model_poses
from colmap_affrect.errors import OptionError
from colmap_affrect.mappers import scored_models
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.reliability import Confidence
from colmap_affrect.project.reasons import Doubt
from colmap_affrect.project.workspace import Workspace


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("rum", "invalid choice: 'rum'"),
        ("run --image-path x", "required: --output-path"),
        (
            "pairs --output-path {out} --camera-mode single",
            "unknown argument --camera-mode",
        ),
        ("match --output_path {out} -q -v", "not allowed with argument"),
        (
            "run --image-path x --output-path {out} --recipie x",
            "--recipie (did you mean --recipe?)",
        ),
    ],
)
def test_wrong_usage_ends_with_2_and_does_nothing(
    tmp_path: Path, arguments: str, message: str, call: Call
) -> None:
    out = tmp_path / "out"
    done = call(*arguments.format(out=out).split())
    assert (done.code, done.stdout) == (2, "")
    (line,) = done.stderr
    assert line.startswith("error: ")
    assert message in line
    assert "; see colmap-affrect" in line
    assert not out.exists()


def test_failure_prints_one_line_and_leaves_the_traceback_in_the_log(
    tmp_path: Path, call: Call
) -> None:
    arguments = [
        "run",
        "--image-path",
        tmp_path / "none",
        "--output-path",
        tmp_path / "out",
    ]
    done = call(*arguments)
    assert (done.code, done.stdout) == (2, "")
    assert done.stderr == [
        f"error: {tmp_path / 'none'}: no such folder; give the folder of the photographs"
    ]
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    call(*arguments)
    log = (tmp_path / "out" / "run.log").read_text()
    assert "Traceback" in log
    assert "OptionError" in log


def test_what_libraries_warn_of_is_in_the_log_alone(
    tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    def warn(*_: object, **__: object) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.warn("tag 256\nis odd", UserWarning, stacklevel=1)
        raise OptionError("no")

    monkeypatch.setattr(commands, "stage", warn)
    (tmp_path / "out").mkdir()
    done = call("match", "--output-path", tmp_path / "out")
    assert done.stderr == ["error: no"]
    log = (tmp_path / "out" / "run.log").read_text()
    assert "UserWarning: tag 256\\u000ais odd" in log


def test_page_is_written_unless_it_is_left_out(verified: Path, call: Call) -> None:
    page = verified / "report.html"
    assert re.search("<title>.*3 photographs", page.read_text(encoding="utf-8"))
    done = call("map", "--output-path", verified, "-q", "--no-page")
    assert (done.code, page.exists(), "report.html" in done.stdout) == (0, False, False)
    done = call("map", "--output-path", verified)
    assert page.exists()
    assert f"to look at: {page}\n" in done.stdout


def test_preset_mapper_and_its_options_are_in_the_report_and_on_record(
    verified: Path, call: Call
) -> None:
    given = {
        "mapper.init_min_num_inliers": 40,
        "min_model_size": 3,
        "triangulation.min_angle": 1.25,
    }
    report = json.loads((verified / "report.json").read_text(encoding="utf-8"))
    assert report["images_registered"] == 3
    assert (report["preset"], report["mapper"]) == ("colmap", "incremental")
    assert report["mapper_options"] == given
    assert report["verification"]["min_num_inliers"] == 15
    record = Workspace(verified).record()["map"]
    assert record["name"] == "incremental"
    assert record["mapper_options"]["triangulation.min_angle"] == 1.25
    again = ["map", "--output-path", verified, "-q", "--preset", "colmap", "--mapper"]
    done = call(*again, "incremental")
    assert (done.code, done.stdout) == (2, "")
    assert "init_min_num_inliers=40, and it is None now" in done.errors[0]


SELECTED = (
    "--image-list-path --mask-path --camera-mask-path --from-database --cameras-path"
)
RUN = "--image-path PHOTOS --output-path NEW"
H5 = "--features-path OUT/features.h5 --matches-path OUT/matches.h5 --database-path NEW"
MODEL = "--model-path OUT/sparse/0 --output-path NEW"

INPUTS = {
    f"run {RUN}": f"{SELECTED} --recipe --weights --depth-path --match-list-path --extend",
    f"compare {RUN}": "--ground-truth-path",
    "match --output-path OUT": "--weights",
    "map --output-path NEW --from-database OUT/database.db": "--image-path",
    f"import-h5 --image-path PHOTOS {H5}": "--cameras-path",
    "show-pair OUT a.png side/č.png": "--image-path",
    f"align {MODEL}": "--gps --positions --points",
    # what a command cannot do without
    "extract --output-path NEW --image-path NONE": "",
    "match --output-path NONE": "",
    "map --output-path NEW --from-database NONE": "",
    "evaluate evd --output-path NEW --dataset-path NONE": "",
    "convert --output-path NEW --image-path NONE": "",
    "inspect NONE --output-path NEW": "",
    f"import-h5 --image-path PHOTOS {H5} --features-path NONE": "",
    "export-h5 --database-path NONE --features-path NEW --matches-path NEW.h5": "",
    "export-database NONE NEW": "",
    "export --output-path NEW --model-path NONE": "",
    "doctor NONE": "",
    "show-pair NONE a.png side/č.png": "",
    "recipes NONE": "",
}
"""Commands with options of inputs that they may be given."""


@pytest.mark.parametrize(
    "text",
    [f"{text} {flag} NONE" for text, flags in INPUTS.items() for flag in flags.split()]
    + [text for text, flags in INPUTS.items() if not flags],
)
def test_file_or_folder_that_is_not_there_is_wrong_usage_before_anything_is_made(
    verified: Path, photos: Path, tmp_path: Path, text: str, call: Call
) -> None:
    places = {"PHOTOS": photos, "OUT": verified, "NEW": tmp_path / "new"}
    places["NONE"] = tmp_path / "none.toml"
    for name, path in places.items():
        text = re.sub(rf"\b{name}\b", str(path), text)

    def times() -> dict[Path, int]:
        """Of all results; the log may grow, and some versions of filelock write locks."""
        kept = (p for p in verified.rglob("*.*") if p.name not in (".lock", "run.log"))
        return {path: path.stat().st_mtime_ns for path in kept}

    before = times()
    done = call(*text.split())
    assert (done.code, done.stdout, len(done.stderr)) == (2, "", 1)
    assert str(places["NONE"]) in done.stderr[0]
    assert not list(tmp_path.iterdir())
    assert times() == before


def test_page_of_a_run_has_pictures_of_pairs(verified: Path, call: Call) -> None:
    assert call("map", "--output-path", verified, "-q").code == 0
    page = (verified / "report.html").read_text(encoding="utf-8")
    section = page.partition('<section id="looks">')[2].partition("</section>")[0]
    assert "the strongest pair of a.png" in section
    figures = section.partition("<figure")[2]
    assert "--reject-pair" not in figures  # the rest of the model speaks for all
    widths = re.findall(
        r'src="data:image/jpeg;base64,[^"]{9999,}" width="(\d+)"', section
    )
    assert 1 <= len(widths) <= 3
    assert set(widths) == {"760"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--device gpu", "--device gpu: not one of auto, cpu, cuda"),
        ("--recipe depth-planes", "give --depth-path FOLDER"),
        ("--recipe defalt", "did you mean 'default'"),
        ("--pairs vocab", "--pairs: methods='vocab': should be"),
        ("--refine-existing", "--refine-existing: only with --extend MODEL"),
        ("--camera-params 1,2", "SIMPLE_RADIAL needs 4 values"),
        ("--preset dense", "invalid choice: 'dense'"),
        ("--mapper-options min_model_size", "min_model_size: expected OPTION=VALUE"),
        ("--mapper-options __import__('os')=1", "pycolmap has no such option"),
    ],
)
def test_wrong_options_are_refused_before_any_image_is_read(
    tmp_path: Path, arguments: str, message: str, call: Call
) -> None:
    write_photographs(tmp_path / "photos", 2)
    out = tmp_path / "out"
    given = [
        "--image-path",
        tmp_path / "photos",
        "--output-path",
        out,
        *arguments.split(),
    ]
    done = call("run", *given)
    assert (done.code, done.stdout) == (2, "")
    (line,) = done.stderr
    assert line.startswith("error: ")
    assert message in line
    assert not out.exists()


def test_weights_of_recipes_are_listed_by_their_names(call: Call) -> None:
    def keys(*names: str) -> list[str]:
        lines = call("weights", "list", *names).stdout.splitlines()
        return [line.split()[0] for line in lines if not line.startswith(" ")]

    assert keys("aliked-lightglue", "aliked-n16") == ["aliked-n16", "lightglue-aliked"]
    assert keys("aliked") == ["aliked-n16", "aliked-n16rot"]
    done = call("weights", "fetch", "rectified")
    assert (done.code, done.stdout) == (0, "rectified: no weights are needed\n")


@pytest.mark.long
def test_what_is_printed_may_end_early() -> None:
    command = f"{sys.executable} -m colmap_affrect recipes on-demand | head -n 1"
    done = subprocess.run(
        command, shell=True, capture_output=True, text=True, check=True
    )
    assert (len(done.stdout.splitlines()), done.stderr) == (1, "")


@pytest.mark.long
def test_finished_model_is_extended_and_another_database_mapped(
    photos: Path, tmp_path: Path, call: Call
) -> None:
    first = tmp_path / "first"
    out = tmp_path / "out"
    listed = tmp_path / "names.txt"
    names = sorted(str(p.relative_to(photos)) for p in photos.rglob("*.png"))
    listed.write_text("\n".join(names[:2]))
    small = call(
        "run", *on_photographs(photos, first), "--image-list-path", listed, "-q"
    )
    assert small.code == 0
    model = first / "sparse" / "0"
    done = call("run", *on_photographs(photos, out), "--extend", model, "--json", "-q")
    assert (done.code, done.stderr) == (0, [])
    report = json.loads(done.stdout)
    assert (report["extended"], report["added"]) == (names[:2], names[2:])
    refused = call("map", "--output-path", out, "-q")
    assert refused.code == 2
    assert (
        "its model extends another one; give --extend again, or --over"
        in refused.errors[-1]
    )
    copied = [
        "map",
        "--output-path",
        tmp_path / "copied",
        "--from-database",
        out / "database.db",
    ]
    mapped = call(*copied, "--extend", model, "-q")
    assert (mapped.code, mapped.errors) == (0, [])
    assert "extended    2 were there, 1 came in" in mapped.stdout
    wrong = call(
        "run", *on_photographs(photos, tmp_path / "no"), "--extend", photos, "-q"
    )
    assert "not a COLMAP model" in wrong.errors[-1]
    assert not (tmp_path / "no" / "features.h5").exists()


def test_model_that_nobody_can_trust_ends_with_3(
    verified: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def score(mapped: MappedModel, *_: object) -> dict[str, Confidence]:
        return dict.fromkeys(
            model_poses(mapped.reconstruction), Confidence(0.3, (Doubt("few_matches"),))
        )

    monkeypatch.setattr(scored_models, "score_images", score)
    assert main(["map", "--output-path", str(verified), "--overwrite"]) == 3
    printed = capfd.readouterr()
    assert "results " in printed.out
    assert not {"colmap gui", "colmap-affrect export"} & set(printed.out.splitlines())
    assert "\nnext" not in printed.out
    assert ": few matches support its position\n" in printed.out
    assert printed.err.splitlines()[-1].startswith(
        "error: nothing in the model can be trusted: it is doubtful throughout, but written;"
    )
    assert (verified / "sparse" / "0" / "images.bin").exists()
    assert json.loads((verified / "report.json").read_text())["status"] == "doubtful"
