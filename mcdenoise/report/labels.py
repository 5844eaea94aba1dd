"""Places for the labels of points, so that none covers another label or a point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[Any]

# Distances between point and label in parts of the label's height, and the directions that are tried at each of them.
_DISTANCES = (0.55, 0.9, 1.4, 2.0, 2.8, 3.8, 5.0, 6.5, 8.5)
_DIRECTIONS = 16
_SWEEPS = 6
_BLOCK = 16  # candidates whose cost is computed at a time
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
    points = np.array(anchors, dtype=float).reshape(-1, 2)
    candidates, alone = [], []
    for anchor, size, point in zip(anchors, sizes, points, strict=True):
        boxes = _array(_candidates(anchor, size, bounds))
        # The part of the cost that does not depend on the other labels; they can only add to it.
        cost = _distances(point, boxes) + _covered(boxes, _array(obstacles))
        by_cost = cost.argsort(kind="stable")
        candidates.append(boxes[by_cost])
        alone.append(cost[by_cost])
    placed: dict[int, int] = {}
    # The most crowded points choose first: they have the fewest good places.
    order = sorted(range(len(anchors)), key=lambda index: (-_neighbours(anchors, sizes, index), anchors[index]))
    for _ in range(_SWEEPS):
        before = dict(placed)
        for index in order:
            others = [other for other in placed if other != index]
            boxes = np.array([candidates[other][placed[other]] for other in others]).reshape(-1, 4)
            placed[index] = _cheapest(points[index], candidates[index], alone[index], points[others], boxes)
        if placed == before:
            break
    return [Box(*map(float, candidates[index][placed[index]])) for index in range(len(anchors))]


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


def _array(boxes: Sequence[Box]) -> Array:
    """``(N, 4)``: left, bottom, right, top."""
    return np.array([(box.left, box.bottom, box.right, box.top) for box in boxes], dtype=float).reshape(-1, 4)


def _cheapest(anchor: Array, boxes: Array, alone: Array, other_anchors: Array, others: Array) -> int:
    """Index of the candidate with the smallest cost; the candidates are sorted by the cost that each has alone."""
    best, least = 0, math.inf
    for first in range(0, len(boxes), _BLOCK):
        if alone[first] >= least:
            break
        block = slice(first, first + _BLOCK)
        cost = alone[block] + _cost(anchor, boxes[block], other_anchors, others)
        if cost.min() < least:
            best, least = first + int(cost.argmin()), float(cost.min())
    return best


def _cost(anchor: Array, boxes: Array, other_anchors: Array, others: Array) -> Array:
    """Cost ``(K,)`` of candidates ``(K, 4)`` beside other labels ``(N, 4)``: what they cover, and crossed leaders."""
    own = _leaders(anchor, _nearest(anchor, boxes))
    theirs = _leaders(other_anchors, _nearest(other_anchors, others))
    crossed = _inside(own[:, None], others[None]).sum(1) + _inside(theirs[None], boxes[:, None]).sum(1)
    return np.asarray(_covered(boxes, others) + _CROSSED * crossed)


def _distances(anchor: Array, boxes: Array) -> Array:
    """Between a point and its label, in heights of the label."""
    across, up = (_nearest(anchor, boxes) - anchor).T
    return np.asarray(np.hypot(across, up) / (boxes[:, 3] - boxes[:, 1]))


def _covered(boxes: Array, others: Array) -> Array:
    """Cost of what boxes ``(K, 4)`` cover of others ``(N, 4)``, by its area relative to the box's."""
    width, height = (
        np.minimum(boxes[:, None, 2 + axis], others[:, 2 + axis]) - np.maximum(boxes[:, None, axis], others[:, axis])
        for axis in (0, 1)
    )
    overlap = width.clip(0) * height.clip(0)
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    return np.asarray(_COVERED * ((overlap > 0) * (1 + overlap / area[:, None])).sum(1))


def _nearest(points: Array, boxes: Array) -> Array:
    """The point of each box that is nearest to a point."""
    return points.clip(boxes[:, :2], boxes[:, 2:])


def _leaders(starts: Array, ends: Array) -> Array:
    """Points ``(N, 11, 2)`` along each segment."""
    starts, ends = starts[..., None, :], ends[..., None, :]
    return starts + (ends - starts) * np.arange(1, 12)[:, None] / 12


def _inside(points: Array, boxes: Array) -> Array:
    """Whether any of several points ``(..., P, 2)`` is inside of a box ``(..., 4)``."""
    low, high = boxes[..., None, :2], boxes[..., None, 2:]
    along_both = np.asarray((low < points) & (points < high)).all(-1)
    return np.asarray(np.asarray(along_both).any(-1))
