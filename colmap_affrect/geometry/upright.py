"""Where up is, by what several photographs say of it."""

import math

import numpy as np

from colmap_affrect.geometry.arrays import Bools, Floats

# Between the uprights of two photographs that agree; judged
MAX_ANGLE = math.radians(4.0)
MIN_NUM_AGREEING = 2  # photographs; theory
MIN_SHARE = 0.5  # of those that say something; more than so many must agree; theory
# Of the upright from how cameras are held on average; theory
MAX_LEAN = math.radians(45.0)
# Length of the mean upright of cameras, below which they are held in all ways; judged
MIN_COMMON = 0.3


def agreed_up(directions: Floats, image_ups: Floats) -> tuple[Floats, Bools] | None:
    """Return the direction that most photographs agree on.

    Args:
        directions: (N, 3) unit vectors upwards, by the lines of each photograph, in one frame.
        image_ups: (M, 3) unit vectors upwards in the images of all cameras, in the same frame.

    Returns:
        (3,) unit vector upwards, and (N,) which photographs agree; None where they contradict each
        other, or how the cameras are held.
    """
    if len(directions) < MIN_NUM_AGREEING:
        return None
    is_near = directions @ directions.T > math.cos(MAX_ANGLE)
    agrees = is_near[is_near.sum(axis=1).argmax()]
    num_agreeing = int(np.count_nonzero(agrees))
    if num_agreeing < MIN_NUM_AGREEING or num_agreeing <= MIN_SHARE * len(directions):
        return None
    mean = directions[agrees].mean(axis=0)
    up = mean / np.linalg.norm(mean)
    common = image_ups.mean(axis=0)
    length = float(np.linalg.norm(common))
    if length >= MIN_COMMON and float(up @ common) < length * math.cos(MAX_LEAN):
        return None
    return up, agrees


def upright_rotation(up: Floats, ahead: Floats) -> Floats:
    """Return the rotation after which z points up, and y ahead as far as that is level.

    Args:
        up: (3,) unit vector.
        ahead: (3,) of any length; where it has no level part of ``MIN_COMMON``, any y.

    Returns:
        (3, 3), rows are right, ahead and up.
    """
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < MIN_COMMON:
        right = np.linalg.svd(up[None])[2][1]
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])
