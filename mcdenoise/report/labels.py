"""Places for the labels of points, so that none covers another label or a point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

# Distances between point and label in parts of the label's height, and the directions that are tried at each of them.
_DISTANCES = (0.55, 0.9, 1.4, 2.0, 2.8, 3.8, 5.0, 6.5, 8.5)
_DIRECTIONS = 16
_SWEEPS = 6
# Heights of a label that it had rather be away than cover something, or cross a leader line.
_COVERED, _CROSSED = 100.0, 8.0


@dataclass(frozen=True)
class Box:
    """An upright rectangle.

    Args:
        left: smallest x.
        bottom: smallest y.
        right: largest x.
        top: largest y.
    """

    left: float
    bottom: float
    right: float
    top: float

    def overlap(self, other: Box) -> float:
        """Area that both cover.

        Example:
            >>> Box(0, 0, 2, 2).overlap(Box(1, 1, 3, 4))
            1
        """
        width = min(self.right, other.right) - max(self.left, other.left)
        height = min(self.top, other.top) - max(self.bottom, other.bottom)
        return max(width, 0) * max(height, 0)

    def within(self, other: Box) -> bool:
        """Whether no part of it lies outside of the other."""
        return (
            other.left <= self.left
            and other.bottom <= self.bottom
            and self.right <= other.right
            and self.top <= other.top
        )

    def nearest(self, x: float, y: float) -> tuple[float, float]:
        """The point of the box that is nearest to a point."""
        return min(max(x, self.left), self.right), min(max(y, self.bottom), self.top)


def place_labels(
    anchors: Sequence[tuple[float, float]],
    sizes: Sequence[tuple[float, float]],
    bounds: Box,
    obstacles: Sequence[Box] = (),
) -> list[Box]:
    """Place a label beside each point; the same input gives the same places.

    Each label in turn takes the candidate that covers least and lies nearest, given the places of the others, until
    no label moves, but at most six times.

    Args:
        anchors: the points.
        sizes: width and height of each point's label, in the unit of the points.
        bounds: area that no label leaves.
        obstacles: areas that labels should not cover, such as the markers of the points.

    Returns:
        The box of each label.
    """
    candidates = [_candidates(anchor, size, bounds) for anchor, size in zip(anchors, sizes, strict=True)]
    placed: list[Box | None] = [None] * len(anchors)
    # The most crowded points choose first: they have the fewest good places.
    order = sorted(range(len(anchors)), key=lambda index: (-_neighbours(anchors, sizes, index), anchors[index]))
    for _ in range(_SWEEPS):
        before = list(placed)
        for index in order:
            others = [
                (anchor, box)
                for other, (anchor, box) in enumerate(zip(anchors, placed, strict=True))
                if other != index and box is not None
            ]
            placed[index] = _cheapest(anchors[index], candidates[index], others, obstacles)
        if placed == before:
            break
    return [box for box in placed if box is not None]


def _neighbours(anchors: Sequence[tuple[float, float]], sizes: Sequence[tuple[float, float]], index: int) -> int:
    (x, y), (width, height) = anchors[index], sizes[index]
    return sum(abs(other[0] - x) < width and abs(other[1] - y) < 2 * height for other in anchors) - 1


def _candidates(anchor: tuple[float, float], size: tuple[float, float], bounds: Box) -> list[Box]:
    (x, y), (width, height) = anchor, size
    boxes = []
    for distance in _DISTANCES:
        for step in range(_DIRECTIONS):
            angle = 2 * math.pi * step / _DIRECTIONS
            across, up = math.cos(angle), math.sin(angle)
            # The label's centre: the gap, and as much of the label as lies between its centre and that side.
            center_x = x + across * distance * height + width / 2 * max(-1.0, min(1.0, 1.5 * across))
            center_y = y + up * (distance * height + height / 2)
            box = Box(center_x - width / 2, center_y - height / 2, center_x + width / 2, center_y + height / 2)
            if box.within(bounds):
                boxes.append(box)
    # Too little room anywhere near: along the border, then.
    return boxes or [_moved_into(Box(x, y - height / 2, x + width, y + height / 2), bounds)]


def _moved_into(box: Box, bounds: Box) -> Box:
    right = min(box.right, bounds.right) - box.right
    across = max(box.left + right, bounds.left) - box.left
    down = min(box.top, bounds.top) - box.top
    up = max(box.bottom + down, bounds.bottom) - box.bottom
    return Box(box.left + across, box.bottom + up, box.right + across, box.top + up)


def _cheapest(
    anchor: tuple[float, float],
    candidates: Sequence[Box],
    others: Sequence[tuple[tuple[float, float], Box]],
    obstacles: Sequence[Box],
) -> Box:
    best, least = candidates[0], math.inf
    for box in candidates:
        # Covered areas and crossed lines can only add to the cost of the distance.
        if _distance(anchor, box) < least:
            cost = _cost(anchor, box, others, obstacles)
            if cost < least:
                best, least = box, cost
    return best


def _distance(anchor: tuple[float, float], box: Box) -> float:
    """Between a point and its label, in heights of the label."""
    return math.dist(anchor, box.nearest(*anchor)) / (box.top - box.bottom)


def _cost(
    anchor: tuple[float, float],
    box: Box,
    others: Sequence[tuple[tuple[float, float], Box]],
    obstacles: Sequence[Box],
) -> float:
    area = (box.top - box.bottom) * (box.right - box.left)
    end = box.nearest(*anchor)
    cost = _distance(anchor, box)
    cost += sum(_COVERED * bool(box.overlap(obstacle)) * (1 + box.overlap(obstacle) / area) for obstacle in obstacles)
    for other_anchor, other in others:
        covered = box.overlap(other)
        cost += _COVERED * bool(covered) * (1 + covered / area)
        cost += _CROSSED * (_crosses(anchor, end, other) + _crosses(other_anchor, other.nearest(*other_anchor), box))
    return cost


def _crosses(start: tuple[float, float], end: tuple[float, float], box: Box) -> bool:
    """Whether a segment runs through a box, tested at points along it."""
    for step in range(1, 12):
        x = start[0] + (end[0] - start[0]) * step / 12
        y = start[1] + (end[1] - start[1]) * step / 12
        if box.left < x < box.right and box.bottom < y < box.top:
            return True
    return False
