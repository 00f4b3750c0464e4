"""Rectified wide-baseline features for COLMAP.

Photographs in, COLMAP model out: ``colmap_affrect.run(image_path, output_path)``. What else there
is, ``docs/python.md`` lists.

A public name is loaded when it is first used, so that importing the package takes no time: these
are the first lines of a command, too, which Ctrl-C may already meet. Type checkers and editors read
the same names in ``__init__.pyi``.
"""

import sys
import zlib

__version__ = "0.1.0"

# The wheels of pycolmap 4.2 export zlib's symbols: if libz is first loaded by
# "import pycolmap", the process dies or hangs when it compresses. Loading it before, as numpy does
# too, keeps both working; after, it must not be touched.
_first = next(
    n for n in sys.modules if n.partition(".")[0] in {"numpy", "pycolmap", "zlib"}
)
PYCOLMAP_CAME_FIRST = _first.startswith("pycolmap")
if not PYCOLMAP_CAME_FIRST:
    zlib.decompress(zlib.compress(b"warm"))

_NAMES_OF_MODULES = {
    # Photographs to a model: everything, the database of others, or one stage after the other.
    "pipeline": ("map_database", "run"),
    "pipeline.single_stages": (
        "choose_pairs",
        "extract",
        "map_images",
        "match",
        "verify",
    ),
    # What a run is made of, and what it returns.
    "colmap.by_hand": ("ByHand",),
    "colmap.verification": ("VerificationOptions",),
    "features.sift": ("SiftOptions",),
    "images.depth": ("DepthOptions",),
    "images.photographs": ("CameraOptions", "MaskOptions"),
    "mappers.existing": ("Extension",),
    "mappers.global_mapper": ("GlobalOptions",),
    "mappers.incremental": ("IncrementalOptions",),
    "mappers.sparse": ("SparseOptions",),
    "matchers.nearest": ("NearestOptions",),
    "pairs.lists": ("PairOptions",),
    "progress": ("Progress",),
    "project.reasons": ("Doubt", "Missing"),
    "project.report": ("ModelSummary", "ReconstructionReport"),
    "project.stage_report": ("StageReport",),
    "recipes": ("ExtractionOptions", "Recipe", "load_recipe", "recipe_names"),
    "project.line_report": ("LineReport",),
    "report.line_pictures": ("LineReports", "camera_from_lines", "report_lines"),
    "report.run_report": ("RunReport",),
    "session.context": ("Resources",),
    "session.run_options": ("RunOptions",),
    # Models and files for and from other programs.
    "colmap.old_databases": ("export_database",),
    "images.conversion": ("convert_images",),
    "interop.align": ("Alignment", "Reference", "align"),
    "interop.export": ("export",),
    "interop.hdf5": ("export_h5", "import_h5"),
    "interop.panoramas": ("reconstruct_panoramas",),
    # What is good, what is wrong.
    "comparison.compare": ("compare",),
    "comparison.method_run": ("CompareOptions",),
    "comparison.results": ("Comparison",),
    "doctor": ("Diagnosis", "diagnose"),
    "errors": (
        "AffrectError",
        "DatabaseError",
        "DepthError",
        "ImageError",
        "NoModelError",
        "OptionError",
        "PartError",
        "StoreError",
        "WorkspaceError",
    ),
    "evaluation.evaluate": ("EvaluateOptions", "evaluate"),
    "evaluation.results": ("Evaluation",),
    "evaluation.truths": ("ScoreOptions",),
    # Functions with pycolmap's names, and arrays of any program.
    "data": ("LocalFeatures",),
    "interop.pycolmap_api": (
        "extract_features",
        "incremental_mapping",
        "match_exhaustive",
        "match_image_pairs",
        "match_sequential",
        "match_spatial",
        "verify_matches",
    ),
    "stages.descriptors": ("match_descriptors", "match_feature_sets"),
}
_MODULES = {
    name: module for module, names in _NAMES_OF_MODULES.items() for name in names
}

__all__ = ["__version__", *_MODULES, "pycolmap"]  # noqa: PLE0604 (all are strings)


def __dir__() -> list[str]:
    return sorted(__all__)


def __getattr__(name: str) -> object:
    from importlib import import_module

    if name == "pycolmap":
        return import_module(f"{__name__}.pycolmap")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
