"""The public names and where they are; ``__init__.py`` reads this."""

from colmap_affrect.colmap.by_hand import ByHand as ByHand
from colmap_affrect.colmap.verification import VerificationOptions as VerificationOptions
from colmap_affrect.comparison.compare import compare as compare
from colmap_affrect.comparison.method_run import CompareOptions as CompareOptions
from colmap_affrect.comparison.results import Comparison as Comparison
from colmap_affrect.data import LocalFeatures as LocalFeatures
from colmap_affrect.errors import AffrectError as AffrectError
from colmap_affrect.evaluation.evaluate import EvaluateOptions as EvaluateOptions
from colmap_affrect.evaluation.evaluate import evaluate as evaluate
from colmap_affrect.evaluation.results import Evaluation as Evaluation
from colmap_affrect.images.photographs import CameraOptions as CameraOptions
from colmap_affrect.images.photographs import MaskOptions as MaskOptions
from colmap_affrect.interop.pycolmap_api import extract_features as extract_features
from colmap_affrect.interop.pycolmap_api import incremental_mapping as incremental_mapping
from colmap_affrect.interop.pycolmap_api import match_exhaustive as match_exhaustive
from colmap_affrect.interop.pycolmap_api import match_image_pairs as match_image_pairs
from colmap_affrect.interop.pycolmap_api import match_sequential as match_sequential
from colmap_affrect.interop.pycolmap_api import match_spatial as match_spatial
from colmap_affrect.interop.pycolmap_api import verify as verify
from colmap_affrect.interop.pycolmap_api import verify_matches as verify_matches
from colmap_affrect.mappers.existing import Extension as Extension
from colmap_affrect.mappers.global_mapper import GlobalOptions as GlobalOptions
from colmap_affrect.mappers.incremental import IncrementalOptions as IncrementalOptions
from colmap_affrect.mappers.sparse import SparseOptions as SparseOptions
from colmap_affrect.matchers.nearest import NearestOptions as NearestOptions
from colmap_affrect.pairs.lists import PairOptions as PairOptions
from colmap_affrect.pipeline import RunOptions as RunOptions
from colmap_affrect.pipeline import map_from_database as map_from_database
from colmap_affrect.pipeline import run as run
from colmap_affrect.project.report import ReconstructionReport as ReconstructionReport
from colmap_affrect.recipes import ExtractionOptions as ExtractionOptions
from colmap_affrect.recipes import load_recipe as load_recipe
from colmap_affrect.stages.descriptors import match_descriptors as match_descriptors
from colmap_affrect.stages.descriptors import match_feature_sets as match_feature_sets

__version__: str
PYCOLMAP_CAME_FIRST: bool
