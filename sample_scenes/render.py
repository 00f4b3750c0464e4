"""Render the sample scenes: photographs of a procedural building with exact ground truth.

Run ``python sample_scenes/render.py``; see ``README.md`` next to this file for what it writes.
The result depends on nothing but this code: the same versions write the same bytes.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import procedural as materials

Array = np.ndarray[Any, Any]

SUPERSAMPLING = 4
BAND_ROWS = 90
JPEG_QUALITY = 88
LENS_BLUR = 0.5
SHADE, SUNSHINE = 0.62, 0.9
DEPTH_SCALE = 500.0
SUN = np.array([-0.45, -0.75, 0.8]) / np.linalg.norm([-0.45, -0.75, 0.8])
ASHLAR = [(0.56, 0.66, 0.74), (0.5, 0.6, 0.66), (0.6, 0.68, 0.73), (0.44, 0.55, 0.64)]
BRICK = [(0.26, 0.33, 0.56), (0.3, 0.38, 0.6), (0.22, 0.28, 0.47), (0.33, 0.45, 0.64)]
PAVING = [(0.5, 0.54, 0.56), (0.44, 0.5, 0.55), (0.55, 0.57, 0.57), (0.4, 0.44, 0.5)]
CARVED = (0.62, 0.71, 0.77)


@dataclass
class Plane:
    """A textured rectangle.

    Attributes:
        origin: World position of the top left corner.
        right: World unit vector along the rows of the texture.
        down: World unit vector along the columns of the texture.
        width: Size along ``right`` in metres.
        height: Size along ``down`` in metres.
        surface: The texture.
        pyramid: Texture with sunlight as a fourth channel, and its halved versions.
    """

    origin: Array
    right: Array
    down: Array
    width: float
    height: float
    surface: materials.Surface
    pyramid: list[Array] = field(default_factory=list)

    @property
    def frame(self) -> Array:
        """Return the 3x3 matrix from (metres right, metres down, 1) to world positions."""
        return np.stack([self.right, self.down, self.origin], axis=1)

    @property
    def normal(self) -> Array:
        """Return the unit normal on the side from which the texture reads correctly."""
        return np.asarray(np.cross(self.down, self.right))


@dataclass
class View:
    """A photograph to take.

    Attributes:
        name: File name of the image.
        rotation: World to camera rotation.
        center: Position of the camera in the world.
        focal: Focal length in pixels.
        size: Width and height in pixels.
        exposure: Brightness factor.
        sunlight: Strength of the direct light, 0 for an overcast sky.
        warmth: Shift of the white balance towards red.
    """

    name: str
    rotation: Array
    center: Array
    focal: float
    size: tuple[int, int]
    exposure: float = 1.0
    sunlight: float = 0.5
    warmth: float = 0.0

    @property
    def translation(self) -> Array:
        """Return the world to camera translation."""
        return -self.rotation @ self.center

    @property
    def calibration(self) -> Array:
        """Return the calibration matrix; (0, 0) is the corner of the first pixel."""
        width, height = self.size
        return np.array(
            [[self.focal, 0, width / 2], [0, self.focal, height / 2], [0, 0, 1.0]]
        )

    def from_plane(self, plane: Plane) -> Array:
        """Return the homography from (metres right, metres down, 1) to the image."""
        camera = self.rotation @ plane.frame
        camera[:, 2] += self.translation
        return np.asarray(self.calibration @ camera)


def look_at(center: Array, target: Array, roll: float = 0.0) -> Array:
    """Return the world to camera rotation of a camera that looks at a target; world z is up."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cos, sin = math.cos(math.radians(roll)), math.sin(math.radians(roll))
    return np.stack([cos * right + sin * down, cos * down - sin * right, forward])


# ---------------------------------------------------------------------------------- rendering


def _sun_on(plane: Plane, planes: Sequence[Plane], sun: Array) -> Array:
    """Return how much direct light reaches a coarse grid over a plane, shadows included."""
    facing = max(0.0, float(plane.normal @ sun))
    step = 0.04
    rows, cols = max(2, round(plane.height / step)), max(2, round(plane.width / step))
    ys, xs = np.mgrid[0:rows, 0:cols]
    across = (xs.ravel() + 0.5) * plane.width / cols
    along = (ys.ravel() + 0.5) * plane.height / rows
    points = plane.origin + np.outer(across, plane.right) + np.outer(along, plane.down)
    points = points + 0.01 * plane.normal
    light = np.full(len(points), facing, np.float32)
    for other in planes:
        if other is plane or abs(other.normal @ sun) < 1e-6:
            continue
        distance = ((other.origin - points) @ other.normal) / (other.normal @ sun)
        hits = points + distance[:, None] * sun - other.origin
        u, v = hits @ other.right, hits @ other.down
        inside = (u > 0) & (u < other.width) & (v > 0) & (v < other.height)
        light[inside & (distance > 1e-3)] = 0
    return cv2.GaussianBlur(light.reshape(rows, cols), (0, 0), 0.8)


def prepare(planes: Sequence[Plane], sun: Array = SUN) -> None:
    """Bake the sunlight into the textures and build their pyramids."""
    for plane in planes:
        rows, cols = plane.surface.color.shape[:2]
        light = cv2.resize(
            _sun_on(plane, planes, sun), (cols, rows), interpolation=cv2.INTER_LINEAR
        )
        texels = np.dstack([plane.surface.color, light]) * 255 + 0.5
        plane.pyramid = [texels.astype(np.uint8)]
        while min(plane.pyramid[-1].shape[:2]) > 8:
            plane.pyramid.append(cv2.pyrDown(plane.pyramid[-1]))


def _sample(plane: Plane, u: Array, v: Array, footprint: Array) -> Array:
    """Look up a plane's texture at positions in metres, blurred to a footprint in metres."""
    ppm = plane.surface.ppm
    level = np.clip(
        np.log2(np.maximum(footprint * ppm, 1e-6)), 0, len(plane.pyramid) - 1
    )
    result = np.zeros((len(u), 4), np.float32)
    for index in range(int(level.min()), min(int(level.max()) + 2, len(plane.pyramid))):
        weight = 1 - np.abs(level - index)
        chosen = np.flatnonzero(weight > 0)
        if not len(chosen):
            continue
        texels = plane.pyramid[index]
        count = -(-len(chosen) // 1024) * 1024
        maps = np.zeros((2, count), np.float32)
        maps[0, : len(chosen)] = (u[chosen] * ppm - 0.5) / 2**index
        maps[1, : len(chosen)] = (v[chosen] * ppm - 0.5) / 2**index
        map_x, map_y = maps.reshape(2, -1, 1024)
        values = cv2.remap(
            texels, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ).reshape(-1, 4)[: len(chosen)]
        result[chosen] += weight[chosen, None] * values
    return result / 255


def _sky(view: View, x: Array, y: Array) -> Array:
    """Return a smooth sky, brighter towards the horizon, neither sunlit nor shaded."""
    a, b, c = np.linalg.inv(view.calibration).T @ view.rotation[:, 2]
    across = (x - view.size[0] / 2) / view.focal
    along = (y - view.size[1] / 2) / view.focal
    up = (a * x + b * y + c) / np.sqrt(across**2 + along**2 + 1)
    blend = materials.smoothstep(up, -0.05, 0.6)[..., None]
    low = np.array([0.93, 0.9, 0.88, SHADE / SUNSHINE])
    high = np.array([0.84, 0.74, 0.66, SHADE / SUNSHINE])
    return np.asarray(low + blend * (high - low))


def trace(
    view: View, planes: Sequence[Plane], xs: Array, ys: Array
) -> tuple[Array, Array]:
    """Find the nearest plane along the rays through a grid of image positions.

    Args:
        view: The camera.
        planes: The scene.
        xs: Horizontal positions, (0, 0) being the corner of the first pixel.
        ys: Vertical positions.

    Returns:
        The index of the plane hit (-1 for the sky), and the inverse of the z-depth (0 for sky).
    """
    x, y = np.meshgrid(xs.astype(np.float32), ys.astype(np.float32))
    index = np.full(x.shape, -1, np.int16)
    nearest = np.zeros(x.shape, np.float32)
    for number, plane in enumerate(planes):
        if (view.center - plane.origin) @ plane.normal <= 0:
            continue
        h = np.linalg.inv(view.from_plane(plane)).astype(np.float32)
        inverse_depth = h[2, 0] * x + h[2, 1] * y + h[2, 2]
        u = h[0, 0] * x + h[0, 1] * y + h[0, 2]
        v = h[1, 0] * x + h[1, 1] * y + h[1, 2]
        hit = (inverse_depth > np.maximum(nearest, 1e-3)) & (u >= 0) & (v >= 0)
        hit &= (u <= plane.width * inverse_depth) & (v <= plane.height * inverse_depth)
        index[hit] = number
        nearest[hit] = inverse_depth[hit]
    return index, nearest


def _shade(view: View, planes: Sequence[Plane], xs: Array, ys: Array) -> Array:
    """Return colour (and sunlight) along the rays through a grid of image positions."""
    index, _ = trace(view, planes, xs, ys)
    x, y = np.meshgrid(xs, ys)
    result = np.empty((*index.shape, 4), np.float32)
    empty = index < 0
    result[empty] = _sky(view, x[empty], y[empty])
    spacing = xs[1] - xs[0]
    for number in np.unique(index[~empty]):
        chosen = index == number
        px, py = x[chosen], y[chosen]
        h = np.linalg.inv(view.from_plane(planes[number]))
        u, v, w = (h[row, 0] * px + h[row, 1] * py + h[row, 2] for row in range(3))
        u, v = u / w, v / w
        steps = [
            np.hypot((h[0, k] - u * h[2, k]) / w, (h[1, k] - v * h[2, k]) / w)
            for k in range(2)
        ]
        footprint = spacing * np.maximum(*steps)
        result[chosen] = _sample(planes[number], u, v, footprint)
    return result


def photograph(view: View, planes: Sequence[Plane], rng: np.random.Generator) -> Array:
    """Render a view, anti-aliased, with its exposure and sensor noise.

    Args:
        view: The camera.
        planes: The scene, after `prepare`.
        rng: The source of the sensor noise.

    Returns:
        A float32 BGR image in 0..1.
    """
    width, height = view.size
    xs = (np.arange(width * SUPERSAMPLING) + 0.5) / SUPERSAMPLING
    bands = []
    for top in range(0, height, BAND_ROWS):
        rows = min(BAND_ROWS, height - top)
        ys = top + (np.arange(rows * SUPERSAMPLING) + 0.5) / SUPERSAMPLING
        fine = _shade(view, planes, xs, ys)
        light = 1 + view.sunlight * (SUNSHINE * fine[..., 3:] - SHADE)
        lit = fine[..., :3] * light
        bands.append(cv2.resize(lit, (width, rows), interpolation=cv2.INTER_AREA))
    image = cv2.GaussianBlur(np.concatenate(bands), (0, 0), LENS_BLUR)
    balance = np.array([1 - view.warmth, 1.0, 1 + view.warmth], np.float32)
    image = image * view.exposure * balance
    image += 0.012 * rng.standard_normal(image.shape).astype(np.float32)
    return np.asarray(np.clip(image, 0, 1))


def depth_map(view: View, planes: Sequence[Plane]) -> Array:
    """Return the z-depth in metres at the pixel centres, 0 where there is only sky."""
    width, height = view.size
    _, inverse = trace(view, planes, np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse > 0)


def age(image: Array, rng: np.random.Generator) -> Array:
    """Make a photograph look a century old: soft, sepia, grainy, vignetted and scratched."""
    rows, cols = image.shape[:2]
    gray = image @ np.array([0.3, 0.5, 0.2], np.float32)
    gray = cv2.GaussianBlur(gray, (0, 0), rng.uniform(0.6, 0.9))
    y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : cols * 1j]
    gray = gray * (1 - rng.uniform(0.22, 0.38) * (x**2 + y**2) ** 1.2 / 2)
    gray = materials.smoothstep(gray, -0.12, 1.08) * rng.uniform(0.9, 1.0)
    gray = gray + 0.018 * materials.noise(rng, (rows, cols), 3, gain=1.2, finest=1.2)
    gray = gray + 0.02 * materials.noise(rng, (rows, cols), 200.0)
    gray = _scratched(gray.astype(np.float32), rng)
    shadow = np.array([0.1, 0.13, 0.17])
    paper = np.array([0.72, 0.86, 0.94]) + 0.015 * rng.standard_normal(3)
    toned = shadow + gray[..., None] * (paper - shadow)
    return np.asarray(np.clip(toned, 0, 1), np.float32)


def _scratched(gray: Array, rng: np.random.Generator) -> Array:
    """Add a few scratches and specks of dust."""
    rows, cols = gray.shape
    marks = np.zeros(gray.shape, np.uint8)
    for _ in range(int(rng.integers(3, 7))):
        x, y = rng.uniform(0, cols), rng.uniform(0, rows)
        bend = rng.normal(0, 12, 2)
        length = rng.uniform(30, 220)
        curve = [
            (x + bend[0] * t + bend[1] * t * t, y + length * t)
            for t in np.linspace(0, 1, 9)
        ]
        cv2.polylines(
            marks,
            [np.round(np.array(curve) * 16).astype(np.int32)],
            False,
            int(rng.integers(60, 180)),
            1,
            cv2.LINE_AA,
            4,
        )
    for _ in range(int(rng.integers(15, 40))):
        center = int(rng.integers(0, cols)), int(rng.integers(0, rows))
        cv2.circle(
            marks,
            center,
            int(rng.integers(0, 2)),
            int(rng.integers(60, 200)),
            -1,
            cv2.LINE_AA,
        )
    opacity = marks.astype(np.float32) / 255
    return gray + opacity * (0.95 - gray)


# -------------------------------------------------------------------------------------- output


def _quaternion(rotation: Array) -> Array:
    """Convert a rotation matrix into a unit quaternion (w, x, y, z) with w >= 0."""
    r = rotation
    scaled = (
        np.array(
            [
                [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
                [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
                [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], 0],
                [
                    r[2, 1] - r[1, 2],
                    r[0, 2] - r[2, 0],
                    r[1, 0] - r[0, 1],
                    r[0, 0] + r[1, 1] + r[2, 2],
                ],
            ]
        )
        / 3
    )
    _, vectors = np.linalg.eigh(scaled)
    x, y, z, w = vectors[:, -1]
    quaternion = np.array([w, x, y, z])
    return quaternion if w >= 0 else -quaternion


def write_model(
    path: Path, views: Sequence[View], planes: Sequence[Plane], single: bool
) -> None:
    """Write cameras, poses and a few surface points as a COLMAP text model.

    Args:
        path: Folder to write to.
        views: The photographs.
        planes: The scene; points are taken from the surfaces that the views see.
        single: Write one camera for all images rather than one for each.
    """
    path.mkdir(parents=True, exist_ok=True)
    cameras, images = [], []
    for number, view in enumerate(views, 1):
        width, height = view.size
        if number == 1 or not single:
            cameras.append(
                f"{number} PINHOLE {width} {height} {view.focal:.6f} {view.focal:.6f} "
                f"{width / 2:.6f} {height / 2:.6f}\n"
            )
        pose = " ".join(
            f"{value:.12f}"
            for value in [*_quaternion(view.rotation), *view.translation]
        )
        images.append(f"{number} {pose} {1 if single else number} {view.name}\n\n")
    (path / "cameras.txt").write_text(
        "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + "".join(cameras),
        encoding="utf-8",
    )
    (path / "images.txt").write_text(
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# (no observations)\n"
        + "".join(images),
        encoding="utf-8",
    )
    points = [line for view in views for line in _surface_points(view, planes)]
    (path / "points3D.txt").write_text(
        "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n"
        + "".join(f"{number} {line}\n" for number, line in enumerate(points, 1)),
        encoding="utf-8",
    )


def _surface_points(view: View, planes: Sequence[Plane]) -> list[str]:
    """Return positions and colours of a coarse grid of surface points that a view sees."""
    width, height = view.size
    xs, ys = np.arange(32, width, 64) + 0.5, np.arange(32, height, 64) + 0.5
    index, inverse = trace(view, planes, xs, ys)
    colors = _shade(view, planes, xs, ys)[..., 2::-1] * 255
    x, y = np.meshgrid(xs, ys)
    rays = (
        np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(view.calibration).T
    )
    lines = []
    for ray, depth, color in zip(
        rays[index >= 0], 1 / inverse[index >= 0], colors[index >= 0], strict=True
    ):
        if depth < 25:
            world = view.rotation.T @ (ray * depth) + view.center
            lines.append(
                " ".join(
                    [*(f"{c:.4f}" for c in world), *(f"{c:.0f}" for c in color), "0"]
                )
            )
    return lines


def write_jpeg(path: Path, image: Array) -> None:
    """Write a float BGR image in 0..1 as a JPEG file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = (image * 255 + 0.5).astype(np.uint8)
    _, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    path.write_bytes(data.tobytes())


def write_depth(path: Path, depth: Array) -> None:
    """Write a depth map as a 16-bit PNG file of ``DEPTH_SCALE`` units per metre."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scaled = np.clip(np.round(depth * DEPTH_SCALE), 0, 65535).astype(np.uint16)
    _, data = cv2.imencode(".png", scaled, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    path.write_bytes(data.tobytes())


# -------------------------------------------------------------------------------------- facade


def facade_planes() -> list[Plane]:
    """Build the facade: one wall of ashlar and plaster with windows, posters and a frieze."""
    rng = np.random.default_rng(11)
    width, height, ppm = 12.0, 8.0, 240.0
    shape = materials.texture_shape(width, height, ppm)
    wall = materials.masonry(
        rng, shape, ppm, ASHLAR, course=(0.2, 0.36), stone=(0.3, 0.75)
    )
    coat = materials.plaster(rng, wall, (0.56, 0.71, 0.8), fallen=0.85, cracks=16)
    plinth = round(5.6 * ppm)
    wall.color[:plinth] = coat.color[:plinth]
    painter = materials.Painter(rng, wall)
    materials.frieze(painter, 0, width, 3.65, 0.42, CARVED)
    for x, top, arched in (
        (1.2, 1.6, False),
        (3.0, 1.5, True),
        (4.95, 1.6, False),
        (7.0, 1.45, True),
        (9.1, 1.6, False),
        (11.0, 1.5, True),
    ):
        materials.window(painter, x, top, 0.95, 1.5, CARVED, arched=arched)
    materials.window(painter, 3.7, 4.6, 1.0, 1.35, CARVED)
    materials.window(painter, 10.4, 4.7, 1.0, 1.4, CARVED)
    materials.door(painter, 8.1, 5.1, 1.15, 2.6, (0.24, 0.33, 0.4), CARVED)
    for order, (x, y, wide, high) in enumerate(
        (
            (4.75, 4.55, 0.55, 0.8),
            (5.45, 4.45, 0.7, 1.0),
            (6.3, 4.7, 0.5, 0.7),
            (5.0, 5.5, 0.8, 0.55),
            (6.05, 5.55, 0.6, 0.85),
            (2.25, 4.8, 0.6, 0.85),
            (1.1, 4.6, 0.7, 0.9),
        )
    ):
        materials.poster(painter, x, y, wide, high, materials.POSTER_WORDS[order])
    materials.leaves(
        painter, [(9.6, 7.6), (11.6, 8.0), (1.7, 7.4), (0.2, 8.0)], 3.4, 650
    )
    painter.finish()
    materials.weather(rng, wall)
    plane = Plane(
        np.array([-width / 2, 0, height / 2]),
        np.array([1.0, 0, 0]),
        np.array([0, 0, -1.0]),
        width,
        height,
        wall,
    )
    prepare([plane])
    return [plane]


def facade_views() -> list[View]:
    """Return a frontal view of the facade and views with growing tilt from several sides."""
    poses = [
        (0, 0, 0),
        (30, 10, 2),
        (45, 205, -3),
        (60, -25, 4),
        (70, 168, 0),
        (75, 8, -2),
    ]
    views = []
    for number, (tilt, side, roll) in enumerate(poses, 1):
        sine, cosine = math.sin(math.radians(tilt)), math.cos(math.radians(tilt))
        around = math.radians(side)
        distance = 7.5 if tilt < 65 else 6.5
        center = distance * np.array(
            [sine * math.cos(around), -cosine, sine * math.sin(around)]
        )
        views.append(
            View(
                f"view_{number}_tilt{tilt:02d}.jpg",
                look_at(center, np.zeros(3), roll),
                center,
                720.0,
                (720, 540),
                exposure=1.0 + 0.05 * math.sin(2.1 * number),
                sunlight=0.5 + 0.1 * math.cos(1.7 * number),
                warmth=0.02 * math.sin(number),
            )
        )
    return views


def render_facade(path: Path) -> None:
    """Render the facade with its homographies and cameras."""
    planes, views = facade_planes(), facade_views()
    for number, view in enumerate(views, 1):
        image = photograph(view, planes, np.random.default_rng([21, number]))
        write_jpeg(path / "images" / view.name, image)
    to_center = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
    first = to_center @ views[0].from_plane(planes[0])
    for number, view in enumerate(views[1:], 2):
        homography = to_center @ view.from_plane(planes[0]) @ np.linalg.inv(first)
        np.savetxt(
            path / f"H_1_{number}.txt", homography / homography[2, 2], fmt="%.12g"
        )
    write_model(path / "ground_truth", views, planes, single=True)


# ----------------------------------------------------------------------------------- courtyard


def _box(
    corner: tuple[float, float, float],
    size: tuple[float, float, float],
    turn: float,
    paint: Callable[[float, float], materials.Surface],
) -> list[Plane]:
    """Build the five visible sides of a box.

    Args:
        corner: World position of the middle of the bottom.
        size: Width, depth and height in metres.
        turn: Rotation about the vertical in degrees.
        paint: Returns the surface of a side of a given width and height.

    Returns:
        The planes.
    """
    width, depth, height = size
    cos, sin = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    x_axis, y_axis = np.array([cos, sin, 0.0]), np.array([-sin, cos, 0.0])
    up, middle = np.array([0, 0, 1.0]), np.array(corner)
    planes = []
    for right, outward, across, reach in (
        (x_axis, -y_axis, width, depth),
        (-x_axis, y_axis, width, depth),
        (y_axis, x_axis, depth, width),
        (-y_axis, -x_axis, depth, width),
    ):
        origin = middle + outward * reach / 2 - right * across / 2 + up * height
        planes.append(Plane(origin, right, -up, across, height, paint(across, height)))
    origin = middle - x_axis * width / 2 + y_axis * depth / 2 + up * height
    planes.append(Plane(origin, x_axis, -y_axis, width, depth, paint(width, depth)))
    return planes


def _plain_painter(
    rng: np.random.Generator, color: materials.Color, ppm: float = 160.0
) -> Callable[[float, float], materials.Surface]:
    """Return a function that builds the smooth, stained sides of a box of a single stone."""

    def paint(width: float, height: float) -> materials.Surface:
        shape = materials.texture_shape(width, height, ppm)
        stains = materials.noise(rng, shape, 0.5 * ppm, gain=0.5)[..., None]
        grain = materials.noise(rng, shape, 6, gain=0.8)[..., None]
        tone = np.asarray(color, np.float32) * (1 + 0.08 * stains + 0.03 * grain)
        return materials.Surface(np.clip(tone, 0, 1).astype(np.float32), ppm)

    return paint


def _main_wall(
    rng: np.random.Generator, width: float, height: float
) -> materials.Surface:
    """Build the long wall: brick under plaster, windows, a door, posters, ivy, a plinth."""
    ppm = 230.0
    shape = materials.texture_shape(width, height, ppm)
    brick = materials.masonry(
        rng,
        shape,
        ppm,
        BRICK,
        course=(0.07, 0.085),
        stone=(0.17, 0.27),
        joint=0.005,
        variation=0.13,
    )
    wall = materials.plaster(rng, brick, (0.58, 0.72, 0.79), fallen=0.55, cracks=26)
    plinth = materials.masonry(
        rng, shape, ppm, ASHLAR, course=(0.25, 0.4), stone=(0.35, 0.9)
    )
    foot = round((height - 0.95) * ppm)
    wall.color[foot:] = plinth.color[foot:]
    painter = materials.Painter(rng, wall)
    materials.frieze(painter, 0, width, 2.35, 0.36, CARVED)
    windows = (
        (1.1, True),
        (3.3, False),
        (5.6, True),
        (7.7, True),
        (10.0, False),
        (12.3, True),
    )
    for x, arched in windows:
        materials.window(painter, x, 0.85, 0.9, 1.2, CARVED, arched=arched)
    for x, arched in ((1.6, False), (4.3, False), (9.3, False), (12.5, False)):
        materials.window(painter, x, 3.15, 1.0, 1.25, CARVED, arched=arched)
    materials.door(painter, 6.9, 3.35, 1.2, 2.15, (0.2, 0.36, 0.26), CARVED)
    places = (
        (2.75, 3.05, 0.6, 0.85),
        (5.25, 3.2, 0.55, 0.8),
        (7.95, 3.0, 0.5, 0.7),
        (8.1, 3.85, 0.45, 0.6),
        (10.35, 3.05, 0.65, 0.9),
        (11.15, 3.3, 0.5, 0.75),
        (5.3, 4.1, 0.5, 0.4),
        (10.6, 4.05, 0.7, 0.45),
    )
    for order, place in enumerate(places):
        materials.poster(painter, *place, materials.POSTER_WORDS[6 + order])
    materials.leaves(painter, [(0.3, height), (3.4, height), (13.4, height)], 3.6, 900)
    painter.finish()
    materials.weather(rng, wall)
    return wall


def courtyard_planes() -> list[Plane]:
    """Build the courtyard: a long wall, a receding wing, paving, steps, piers and a trough."""
    rng = np.random.default_rng(5)
    x_axis, y_axis, up = np.eye(3)
    wall = _main_wall(rng, 14.0, 5.5)
    fold, bend = 8.56, math.radians(6)
    split = round(fold * wall.ppm)
    left = materials.Surface(wall.color[:, :split], wall.ppm)
    right = materials.Surface(wall.color[:, split:], wall.ppm)
    along = np.array([math.cos(bend), -math.sin(bend), 0])
    corner = np.array([fold - 7.0, 0, 5.5])
    walls = [
        Plane(np.array([-7.0, 0, 5.5]), x_axis, -up, fold, 5.5, left),
        Plane(corner, along, -up, 14.0 - fold, 5.5, right),
    ]
    ppm = 150.0
    paving = materials.masonry(
        rng,
        materials.texture_shape(18, 12, ppm),
        ppm,
        PAVING,
        joint=0.012,
        joint_color=(0.25, 0.32, 0.3),
        flagstones=0.55,
    )
    paving.color *= 0.9
    floor = Plane(np.array([-9.0, 0, 0]), x_axis, -y_axis, 18.0, 12.0, paving)
    lawn = Plane(
        np.array([-40.0, 40, -0.03]),
        x_axis,
        -y_axis,
        80.0,
        80.0,
        materials.grass(rng, (2400, 2400), 30.0),
    )
    planes = [lawn, floor, *walls]
    stone = _plain_painter(rng, (0.52, 0.6, 0.65))
    planes += _box((-0.1, -0.35, 0), (2.0, 0.7, 0.17), 0, stone)
    planes += _box((-0.1, -0.2, 0), (1.7, 0.4, 0.34), 0, stone)
    planes += _box((-4.0, -2.2, 0), (0.45, 0.45, 1.1), -10, stone)
    planes += _box(
        (3.6, -2.6, 0), (1.3, 0.6, 0.5), 7, _plain_painter(rng, (0.3, 0.4, 0.48))
    )
    prepare(planes)
    return planes


def _walk_view(
    name: str,
    pose: tuple[float, float, float, float],
    roll: float,
    focal: float,
    size: tuple[int, int],
) -> View:
    """Place a camera that looks at the foot of the long wall.

    Args:
        name: File name of the image.
        pose: The angle in degrees between the wall's normal and the way to the camera (positive
            to the right); the horizontal distance to the point looked at, the height of the
            camera and the position along the wall of the point looked at, all in metres.
        roll: Rotation about the viewing direction in degrees.
        focal: Focal length in pixels.
        size: Width and height of the image in pixels.

    Returns:
        The view.
    """
    azimuth, distance, height, aim = pose
    around = math.radians(azimuth)
    center = np.array(
        [aim + distance * math.sin(around), -distance * math.cos(around), height]
    )
    rotation = look_at(center, np.array([aim, 0.0, 1.6]), roll)
    return View(name, rotation, center, focal, size)


def courtyard_views() -> list[View]:
    """Return the photographs of the courtyard, taken on a walk from end to end of the wall."""
    poses = [
        (-77, 11.5, 1.8, 0.3),
        (-76.5, 10.8, 3.2, 0.2),
        (-35, 10.0, 2.0, -1.5),
        (-18, 10.5, 2.9, -0.6),
        (0, 10.0, 1.7, 0.0),
        (17, 10.3, 2.5, 0.6),
        (32, 10.0, 1.9, 1.7),
        (74, 10.0, 2.9, 0.1),
        (76.5, 11.3, 1.9, -0.2),
    ]
    views = []
    for number, pose in enumerate(poses, 1):
        roll = 1.5 * math.sin(3 * number)
        view = _walk_view(
            f"court_{number}.jpg", pose, roll, focal=1080.0, size=(720, 540)
        )
        views.append(
            replace(
                view,
                exposure=1.0 + 0.06 * math.sin(1.9 * number),
                sunlight=0.55 + 0.12 * math.cos(2.3 * number),
                warmth=0.025 * math.sin(1.3 * number),
            )
        )
    return views


def historical_views() -> list[View]:
    """Return photographs of the same courtyard by many hands: other cameras and formats."""
    poses = [
        (-76, 11.0, 2.6, 0.2), (-75, 10.5, 3.4, 0.0), (-35, 10.0, 2.4, -1.4),
        (-20, 11.0, 3.4, -0.6), (-4, 10.0, 3.8, 0.0), (16, 9.5, 3.0, 0.5),
        (32, 10.5, 2.3, 1.6), (74, 10.2, 3.2, 0.1),
    ]  # fmt: skip
    focals = [1040.0, 980.0, 1120.0, 1180.0, 960.0, 1000.0, 1100.0, 1060.0]
    sizes = [(704, 528), (680, 540), (720, 520), (640, 540), (720, 500), (680, 540), (700, 520),
             (720, 540)]  # fmt: skip
    views = []
    for number, (pose, focal, size) in enumerate(
        zip(poses, focals, sizes, strict=True), 1
    ):
        roll = 1.5 * math.sin(2 * number)
        view = _walk_view(f"plate_{number}.jpg", pose, roll, focal, size)
        views.append(
            replace(
                view,
                exposure=1.0 + 0.08 * math.sin(1.1 * number),
                sunlight=0.5 + 0.25 * math.cos(2.9 * number),
            )
        )
    return views


def render_courtyard(path: Path) -> None:
    """Render the courtyard, as it is and as if long ago, with cameras and depth maps."""
    planes, views = courtyard_planes(), courtyard_views()
    for number, view in enumerate(views, 1):
        image = photograph(view, planes, np.random.default_rng([31, number]))
        write_jpeg(path / "courtyard" / "images" / view.name, image)
        write_depth(
            path / "courtyard" / "depth" / f"{Path(view.name).stem}.png",
            depth_map(view, planes),
        )
    write_model(path / "courtyard" / "ground_truth", views, planes, single=True)
    views = historical_views()
    for number, view in enumerate(views, 1):
        rng = np.random.default_rng([41, number])
        image = age(photograph(view, planes, rng), rng)
        write_jpeg(path / "courtyard_historical" / "images" / view.name, image)
    write_model(
        path / "courtyard_historical" / "ground_truth", views, planes, single=False
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and render."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0] if __doc__ else None
    )
    parser.add_argument(
        "--output-path",
        type=Path,
        default=Path(__file__).resolve().parent,
        help="folder to write to (default: the folder of this script)",
    )
    parser.add_argument(
        "--scene",
        choices=("facade", "courtyard", "all"),
        default="all",
        help="what to render; courtyard includes its historical rendition",
    )
    options = parser.parse_args(arguments)
    if options.scene in ("facade", "all"):
        render_facade(options.output_path / "facade")
    if options.scene in ("courtyard", "all"):
        render_courtyard(options.output_path)


if __name__ == "__main__":
    main()
