"""Errors that a user can act on: one line that says what, where, and what to do."""

INTERRUPTED = "interrupted; run the same command again to go on"

MEMORY_HINT = (
    "not enough memory; close other programs or raise the limit (ulimit -v), give smaller "
    "photographs, or --set max_image_size_px=1600"
)
NO_MEMORY = (
    "insufficient memory", "out of memory", "can't allocate memory", "cannot allocate memory",
    "bad_alloc", "can't start new thread", "failed to allocate", "unable to allocate",
)  # fmt: skip


def lacks_memory(error: BaseException) -> bool:
    """Tell whether Python, numpy, OpenCV, torch or COLMAP has found no memory."""
    return isinstance(error, MemoryError) or any(t in str(error).lower() for t in NO_MEMORY)


class AffrectError(Exception):
    """Base of all errors that the command line prints as one line (exit code 1)."""


class OptionError(AffrectError, ValueError):
    """An option is unknown, out of range, contradicts another one, or names what is not there."""


class ImageError(AffrectError):
    """An image cannot be read or used."""


class PairListError(AffrectError):
    """A pair list is unreadable or names images that are not there."""


class StoreError(AffrectError):
    """A file of features or matches is foreign, incomplete, or of another format version."""


class StaleStoreError(StoreError):
    """Results of other options or inputs are in the way of the ones asked for."""


class DatabaseError(AffrectError):
    """A COLMAP database cannot be used as asked."""


class WorkspaceError(AffrectError):
    """The output folder cannot be used: not writable, or in use by another run."""


class MappingError(AffrectError):
    """COLMAP's mapper ended with an error."""


class DepthError(AffrectError):
    """The depth map of a photograph is missing or cannot be used."""


class WeightsError(AffrectError):
    """The weights of a network are missing, damaged, or those of another network."""


class DeviceError(AffrectError):
    """The device asked for is not there."""


class ClusterError(AffrectError):
    """The cluster is not there, has no workers, or ones that would give other results."""


class ComparisonError(AffrectError):
    """Methods cannot be compared as asked."""


class EvaluationError(AffrectError):
    """A dataset cannot be evaluated as asked."""
