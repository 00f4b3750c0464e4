"""The public names for type checkers and editors; ``__init__.py`` loads them."""

from colmap_affrect import pycolmap as pycolmap
from colmap_affrect.colmap.by_hand import ByHand as ByHand
from colmap_affrect.colmap.old_databases import export_database as export_database
from colmap_affrect.colmap.verification import (
    VerificationOptions as VerificationOptions,
)
from colmap_affrect.comparison.compare import compare as compare
from colmap_affrect.comparison.method_run import CompareOptions as CompareOptions
from colmap_affrect.comparison.results import Comparison as Comparison
from colmap_affrect.data import LocalFeatures as LocalFeatures
from colmap_affrect.doctor import Diagnosis as Diagnosis
from colmap_affrect.doctor import diagnose as diagnose
from colmap_affrect.errors import AffrectError as AffrectError
from colmap_affrect.errors import DatabaseError as DatabaseError
from colmap_affrect.errors import DepthError as DepthError
from colmap_affrect.errors import ImageError as ImageError
from colmap_affrect.errors import NoModelError as NoModelError
from colmap_affrect.errors import OptionError as OptionError
from colmap_affrect.errors import PartError as PartError
from colmap_affrect.errors import StoreError as StoreError
from colmap_affrect.errors import WorkspaceError as WorkspaceError
from colmap_affrect.evaluation.evaluate import EvaluateOptions as EvaluateOptions
from colmap_affrect.evaluation.evaluate import evaluate as evaluate
from colmap_affrect.evaluation.results import Evaluation as Evaluation
from colmap_affrect.evaluation.truths import ScoreOptions as ScoreOptions
from colmap_affrect.features.sift import SiftOptions as SiftOptions
from colmap_affrect.images.conversion import convert_images as convert_images
from colmap_affrect.images.depth import DepthOptions as DepthOptions
from colmap_affrect.images.photographs import CameraOptions as CameraOptions
from colmap_affrect.images.photographs import MaskOptions as MaskOptions
from colmap_affrect.interop.align import Alignment as Alignment
from colmap_affrect.interop.align import Reference as Reference
from colmap_affrect.interop.align import align as align
from colmap_affrect.interop.export import export as export
from colmap_affrect.interop.hdf5 import export_h5 as export_h5
from colmap_affrect.interop.hdf5 import import_h5 as import_h5
from colmap_affrect.interop.panoramas import (
    reconstruct_panoramas as reconstruct_panoramas,
)
from colmap_affrect.interop.pycolmap_api import extract_features as extract_features
from colmap_affrect.interop.pycolmap_api import (
    incremental_mapping as incremental_mapping,
)
from colmap_affrect.interop.pycolmap_api import match_exhaustive as match_exhaustive
from colmap_affrect.interop.pycolmap_api import match_image_pairs as match_image_pairs
from colmap_affrect.interop.pycolmap_api import match_sequential as match_sequential
from colmap_affrect.interop.pycolmap_api import match_spatial as match_spatial
from colmap_affrect.interop.pycolmap_api import verify_matches as verify_matches
from colmap_affrect.mappers.existing import Extension as Extension
from colmap_affrect.mappers.global_mapper import GlobalOptions as GlobalOptions
from colmap_affrect.mappers.incremental import IncrementalOptions as IncrementalOptions
from colmap_affrect.mappers.sparse import SparseOptions as SparseOptions
from colmap_affrect.matchers.nearest import NearestOptions as NearestOptions
from colmap_affrect.pairs.lists import PairOptions as PairOptions
from colmap_affrect.pipeline import map_database as map_database
from colmap_affrect.pipeline import run as run
from colmap_affrect.pipeline.single_stages import choose_pairs as choose_pairs
from colmap_affrect.pipeline.single_stages import extract as extract
from colmap_affrect.pipeline.single_stages import map_images as map_images
from colmap_affrect.pipeline.single_stages import match as match
from colmap_affrect.pipeline.single_stages import verify as verify
from colmap_affrect.progress import Progress as Progress
from colmap_affrect.project.line_report import LineReport as LineReport
from colmap_affrect.project.reasons import Doubt as Doubt
from colmap_affrect.project.reasons import Missing as Missing
from colmap_affrect.project.report import ModelSummary as ModelSummary
from colmap_affrect.project.report import ReconstructionReport as ReconstructionReport
from colmap_affrect.project.stage_report import StageReport as StageReport
from colmap_affrect.recipes import ExtractionOptions as ExtractionOptions
from colmap_affrect.recipes import Recipe as Recipe
from colmap_affrect.recipes import load_recipe as load_recipe
from colmap_affrect.recipes import recipe_names as recipe_names
from colmap_affrect.report.line_pictures import LineReports as LineReports
from colmap_affrect.report.line_pictures import camera_from_lines as camera_from_lines
from colmap_affrect.report.line_pictures import report_lines as report_lines
from colmap_affrect.report.run_report import RunReport as RunReport
from colmap_affrect.session.context import Resources as Resources
from colmap_affrect.session.run_options import RunOptions as RunOptions
from colmap_affrect.stages.descriptors import match_descriptors as match_descriptors
from colmap_affrect.stages.descriptors import match_feature_sets as match_feature_sets

__version__: str
PYCOLMAP_CAME_FIRST: bool
