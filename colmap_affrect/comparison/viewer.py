"""The models of a comparison as a recording for the viewer of rerun (the only user of rerun)."""

from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from colmap_affrect.comparison.results import Comparison
from colmap_affrect.errors import ComparisonError, ImageError
from colmap_affrect.images.reading import encode_jpeg, read_color
from colmap_affrect.project.outputs import new_results
from colmap_affrect.report.scene import CAMERA_DEPTH, read_models

FILE_NAME = "comparison.rrd"
IMAGE_SIZE_PX = 640
JPEG_QUALITY = 80


def require_viewer() -> None:
    """Raise ComparisonError when rerun is not installed."""
    if find_spec("rerun") is None:
        raise ComparisonError('the viewer needs rerun: pip install "colmap-affrect[viewer]"')


def log_comparison(comparison: Comparison, output_path: Path) -> Path:
    """Write ``comparison.rrd``: points, cameras and photographs of each method, in one frame.

    Open it with ``rerun comparison.rrd``. Raises ComparisonError when rerun is not installed.
    """
    require_viewer()
    import rerun

    path = output_path / FILE_NAME
    models, _ = read_models(comparison.model_paths(output_path))
    with (
        new_results(path, replaces=True) as (new,),
        rerun.RecordingStream("colmap_affrect") as recording,
    ):
        recording.save(new)
        recording.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for method, model in models.items():
            root = f"/{rerun.escape_entity_path_part(method)}"
            points = rerun.Points3D(model.points, colors=model.colors)
            recording.log(f"{root}/points", points, static=True)
            for index, name in enumerate(model.names):
                camera = f"{root}/cameras/{rerun.escape_entity_path_part(name)}"
                pose = rerun.Transform3D(translation=model.centers[index], mat3x3=model.axes[index])
                half_size = model.half_sizes[index]
                focal_px = IMAGE_SIZE_PX / 2 / float(half_size.max())
                width, height = 2 * focal_px * half_size
                pinhole = rerun.Pinhole(
                    focal_length=focal_px,
                    width=width,
                    height=height,
                    image_plane_distance=CAMERA_DEPTH,
                )
                recording.log(camera, pose, pinhole, static=True)
                with suppress(ImageError):
                    image = read_color(Path(comparison.image_path) / name, IMAGE_SIZE_PX)
                    picture = rerun.EncodedImage(
                        contents=encode_jpeg(image, JPEG_QUALITY), media_type="image/jpeg"
                    )
                    recording.log(camera, picture, static=True)
    return path
