"""Who may import whom, and what a user gets; change the tables when the design changes."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import colmap_affrect

PACKAGE = Path(colmap_affrect.__file__).parent

ROWS = [
    {"children", "conventions", "errors", "files", "progress"},
    {
        "geometry.affine", "geometry.canvas", "geometry.neighbors", "geometry.planes",
        "geometry.shapes", "geometry.tilts",
    },
    {"types", "interfaces", "outcomes", "options", "executor", "recipes"},
    {
        "features.affnet", "features.affnet_hardnet", "features.dog", "features.networks",
        "features.patches", "features.registry", "features.rootsift", "features.second_moment",
        "features.weights", "imaging", "depth", "cluster",
    },
    {
        "rectifiers.covers", "rectifiers.dense_shapes", "rectifiers.depth_affnet",
        "rectifiers.depth_planes", "rectifiers.regions", "rectifiers.registry",
    },
    {
        "rectified", "extraction", "store", "workspace",
        "matching.coarse", "matching.nearest", "matching.pairs", "matching.retrieval",
        "colmap", "colmap.checks", "colmap.copies", "colmap.database",
        "colmap.global_mapping", "colmap.mapping", "colmap.model_files", "colmap.native_options",
        "colmap.running", "colmap.verification",
    },
    {
        "doctor", "dropin", "pipeline", "escalation", "interchange", "photographs", "image_tasks",
        "pair_selection", "pair_tasks", "stages",
    },
    {
        "comparison.methods", "comparison.metrics", "comparison.request", "comparison.results",
        "comparison.sift", "comparison.tables", "comparison.verdict", "comparison.worker",
    },
    {
        "report.inspection", "report.levels", "report.match_plots", "report.page",
        "report.pictures", "report.scene", "report.sheet", "report.tilt_plot",
        "report.view_graph", "report.viewer", "report.warp_views",
    },
    {
        "comparison.compare",
        "evaluation.correspondences", "evaluation.costs", "evaluation.evaluate", "evaluation.evd",
        "evaluation.homographies", "evaluation.imc", "evaluation.pair_matches", "evaluation.pairs",
        "evaluation.plots", "evaluation.protocol", "evaluation.published",
        "evaluation.recipe_features", "evaluation.records", "evaluation.registry",
        "evaluation.relative_pose", "evaluation.results", "evaluation.statistics",
        "evaluation.svp", "evaluation.tables", "evaluation.truth_checks",
    },
    {"cli", "cli.arguments", "cli.commands", "__main__"},
]  # fmt: skip
"""A module imports from its own row and from those above it in this list."""

ROW_OF = {module: number for number, row in enumerate(ROWS) for module in row}

FREE = {"geometry", "features", "rectifiers", "matching", "comparison", "report", "evaluation", ""}
"""Packages whose __init__ holds no code, and the top one, which loads its names when used."""

WITHIN_ROW_5 = {("extraction", "rectified")}
"""Modules of row 5 do not know each other (those of colmap and matching do among themselves)."""

ARRAYS_ONLY = {"conventions", "errors"}
"""All that geometry may import beside itself: it takes and returns plain arrays."""

HOMES = {
    "cv2": {
        "matching.retrieval",
        "imaging",
        "depth",
        "features.affnet",
        "features.dog",
        "features.second_moment",
        "evaluation.correspondences",
        "evaluation.homographies",
        "evaluation.relative_pose",
    },
    "h5py": {"store", "depth", "interchange", "evaluation.imc"},
    "pycolmap": {"colmap"},
    "tqdm": {"progress"},
    "threadpoolctl": {"executor"},
    "filelock": {"workspace"},
    "argparse": {"cli", "cli.arguments", "cli.commands"},
    "torch": {
        "matching.coarse",
        "features.affnet",
        "features.affnet_hardnet",
        "features.networks",
        "features.patches",
        "features.weights",
    },
    "kornia": {
        "features.affnet",
        "features.affnet_hardnet",
        "features.networks",
        "features.patches",
        "features.weights",
    },
    "transformers": {"depth"},
    "matplotlib": {"report.sheet", "report.tilt_plot", "evaluation.plots"},
    "jinja2": {"report.page"},
    "networkx": {"report.view_graph"},
    "rerun": {"report.viewer"},
    "dask": {"cluster"},
    "distributed": {"cluster"},
    "scipy": set(),
    "sqlite3": {"colmap.checks", "colmap.copies"},
}

PUBLIC = [
    "AffrectError", "CameraOptions", "CompareOptions", "Comparison", "EvaluateOptions",
    "Evaluation", "ExtractionOptions", "LocalFeatures", "MappingOptions", "MaskOptions",
    "MatchingOptions", "PairOptions", "ReconstructionReport", "RunOptions",
    "VerificationOptions", "__version__", "compare", "evaluate", "extract_features",
    "extract_image", "load_recipe", "match_exhaustive", "match_image_pairs", "run", "verify",
]  # fmt: skip


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def nodes(path: Path) -> list[ast.AST]:
    """All nodes of the syntax tree of a file."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@cache
def imports(path: Path) -> set[str]:
    """Full names of all modules that a file imports, inside functions too."""
    found = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found |= {item.name for item in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names = {f"{node.module}.{item.name}" for item in node.names}
            # "from package import module" imports the module, else a name of the package.
            found |= {
                name if name.removeprefix("colmap_affrect.") in MODULES else str(node.module)
                for name in names
            }
    return found


OWN_IMPORTS = {
    module: {
        name.removeprefix("colmap_affrect").removeprefix(".")
        for name in imports(path)
        if name.split(".")[0] == "colmap_affrect"
    }
    for module, path in MODULES.items()
}


def test_layer_table_lists_every_module() -> None:
    assert set(MODULES) == set(ROW_OF) | FREE


@pytest.mark.parametrize("module", sorted(ROW_OF))
def test_module_imports_from_its_own_row_or_below(module: str) -> None:
    upward = {name for name in OWN_IMPORTS[module] - {""} if ROW_OF[name] > ROW_OF[module]}
    assert upward == set()


@pytest.mark.parametrize("module", sorted(FREE))
def test_package_without_code_imports_nothing_of_ours(module: str) -> None:
    assert OWN_IMPORTS[module] == set()


@pytest.mark.parametrize("module", sorted(ROWS[5]))
def test_modules_that_stages_join_do_not_know_each_other(module: str) -> None:
    known = {
        (module, other)
        for other in OWN_IMPORTS[module] & ROWS[5]
        if other.split(".")[0] != module.split(".")[0]
    }
    assert known <= WITHIN_ROW_5


@pytest.mark.parametrize("module", sorted(ROWS[1]))
def test_geometry_takes_and_returns_plain_arrays(module: str) -> None:
    assert OWN_IMPORTS[module] <= ROWS[1] | ARRAYS_ONLY


@pytest.mark.parametrize("package", sorted(HOMES))
def test_heavy_package_is_imported_at_home_only(package: str) -> None:
    users = {
        module
        for module, path in MODULES.items()
        if any(name.split(".")[0] == package for name in imports(path))
    }
    assert users == HOMES[package]


def test_pycolmap_is_imported_at_one_site() -> None:
    sites = [
        module
        for module, path in MODULES.items()
        for node in nodes(path)
        if isinstance(node, ast.Import) and any(item.name == "pycolmap" for item in node.names)
    ]
    assert sites == ["colmap"]


def test_half_pixels_are_added_in_conventions_only() -> None:
    # 0.5 stands for other things too: these modules compute with it, and not with positions.
    users = {
        module
        for module, path in MODULES.items()
        if any(
            isinstance(node, ast.BinOp)
            and isinstance(node.op, ast.Add | ast.Sub)
            and any(isinstance(s, ast.Constant) and s.value == 0.5 for s in (node.left, node.right))
            for node in nodes(path)
        )
    }
    assert users <= {"conventions"}


def test_library_neither_prints_nor_exits_outside_the_command_line() -> None:
    for module in set(MODULES) - {"cli", "cli.commands", "progress", "__main__"}:
        tree = nodes(MODULES[module])
        names = {node.id for node in tree if isinstance(node, ast.Name)}
        attributes = {node.attr for node in tree if isinstance(node, ast.Attribute)}
        assert not {"print", "SystemExit"} & names, module
        assert not {"exit", "_exit", "basicConfig"} & attributes, module


def test_public_names_are_the_promised_ones_and_load() -> None:
    assert colmap_affrect.__all__ == PUBLIC
    for name in PUBLIC:
        assert getattr(colmap_affrect, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        colmap_affrect.nothing  # noqa: B018


@pytest.mark.parametrize("name", [name for name in PUBLIC if name != "__version__"])
def test_public_name_has_a_docstring(name: str) -> None:
    assert getattr(colmap_affrect, name).__doc__.strip()


def test_import_is_light_and_emits_no_warning() -> None:
    script = (
        "import sys, colmap_affrect, logging\n"
        "heavy = {'numpy', 'pycolmap', 'cv2', 'h5py', 'torch', 'kornia', 'tqdm', 'filelock'}\n"
        "print(sorted(heavy & set(sys.modules)), 'zlib' in sys.modules, logging.root.handlers)"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "[] True []\n"
