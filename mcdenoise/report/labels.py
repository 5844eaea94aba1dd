"""Places for the labels of about a dozen points."""

from __future__ import annotations

import math
from collections.abc import Sequence

# An upright rectangle: left, bottom, right, top.
Box = tuple[float, float, float, float]

# Distances between point and label in parts of the label's height, and the directions that are tried at each of them.
_DISTANCES, _DIRECTIONS = (0.55, 0.9, 1.4, 2.0, 2.8, 3.8, 5.0, 6.5, 8.5), 16


def place_labels(
    points: Sequence[tuple[float, float]],
    sizes: Sequence[tuple[float, float]],
    bounds: Box,
    obstacles: Sequence[Box],
) -> list[Box]:
    """Boxes of some sizes beside their points, one after the other: the nearest that covers nothing, or else least.

    Args:
        points: at most about a dozen; more leave no room.
        sizes: width and height of each point's label.
        bounds: area that no label leaves.
        obstacles: areas that labels should not cover, such as the markers of the points.
    """
    taken = list(obstacles)
    for point, size in zip(points, sizes, strict=True):
        boxes = [
            _beside(point, size, distance, 2 * math.pi * step / _DIRECTIONS, bounds)
            for distance in _DISTANCES
            for step in range(_DIRECTIONS)
        ]
        costs = [(sum(_overlap(box, one) for one in taken), math.dist(nearest(box, point), point)) for box in boxes]
        taken.append(boxes[costs.index(min(costs))])
    return taken[len(obstacles) :]


def _beside(point: tuple[float, float], size: tuple[float, float], distance: float, angle: float, bounds: Box) -> Box:
    """A box in a direction from a point, moved into the bounds."""
    width, height = size
    across, up = math.cos(angle), math.sin(angle)
    # To the left corner: the gap, and as much of the label as lies between its centre and that side.
    left = point[0] + across * distance * height + width / 2 * (max(-1.0, min(1.0, 1.5 * across)) - 1)
    bottom = point[1] + up * (distance * height + height / 2) - height / 2
    # The right and upper bounds are those of the figure, which cuts off what lies beyond.
    left = min(max(left, bounds[0]), bounds[2] - width)
    bottom = min(max(bottom, bounds[1]), bounds[3] - height)
    return left, bottom, left + width, bottom + height


def _overlap(box: Box, other: Box) -> float:
    """Area that both cover."""
    width, height = (min(box[axis + 2], other[axis + 2]) - max(box[axis], other[axis]) for axis in (0, 1))
    return max(width, 0.0) * max(height, 0.0)


def nearest(box: Box, point: tuple[float, float]) -> tuple[float, float]:
    """The point of a box that is nearest to a point."""
    return min(max(point[0], box[0]), box[2]), min(max(point[1], box[1]), box[3])
