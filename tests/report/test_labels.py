from __future__ import annotations

import itertools

import numpy as np
import pytest

from mcdenoise.report.labels import Box, place_labels

BOUNDS = Box(0, 0, 720, 380)


def check(anchors: list[tuple[float, float]], sizes: list[tuple[float, float]]) -> list[Box]:
    """Place labels, none of which covers another one or a point, or leaves the bounds."""
    points = [Box(x - 4, y - 4, x + 4, y + 4) for x, y in anchors]
    boxes = place_labels(anchors, sizes, BOUNDS, points)
    assert len(boxes) == len(anchors)
    assert all(box.within(BOUNDS) for box in boxes)
    for box, (width, height) in zip(boxes, sizes, strict=True):
        assert (box.right - box.left, box.top - box.bottom) == pytest.approx((width, height))
    assert not [pair for pair in itertools.combinations(boxes, 2) if pair[0].overlap(pair[1]) > 0]
    assert not [box for box, point in itertools.product(boxes, points) if box.overlap(point) > 0]
    return boxes


def test_a_lone_point_has_its_label_close_by():
    (box,) = check([(300.0, 200.0)], [(80.0, 10.0)])
    x, y = box.nearest(300, 200)
    assert np.hypot(x - 300, y - 200) <= 6


@pytest.mark.parametrize("corner", [(0.0, 0.0), (720.0, 0.0), (0.0, 380.0), (720.0, 380.0)])
def test_a_label_stays_inside_at_a_corner(corner: tuple[float, float]):
    check([corner], [(150.0, 10.0)])


@pytest.mark.parametrize("seed", range(4))
def test_random_points(seed: int):
    random = np.random.default_rng(seed)
    anchors = [(float(x), float(y)) for x, y in random.uniform((20, 20), (700, 360), (14, 2))]
    check(anchors, [(float(width), 10.0) for width in random.uniform(40, 180, 14)])


def test_a_cluster():
    anchors = [(300.0 + 14 * column, 200.0 + 14 * row) for row in range(3) for column in range(4)]
    check(anchors, [(120.0, 10.0)] * 12)


def test_the_same_points_get_the_same_places():
    anchors = [(100.0, 100.0), (104.0, 101.0), (98.0, 103.0)]
    first, second = (place_labels(anchors, [(90.0, 10.0)] * 3, BOUNDS) for _ in range(2))
    assert first == second


def test_no_room_at_all_still_ends_inside():
    boxes = place_labels([(5.0, 5.0)], [(8.0, 8.0)], Box(0, 0, 10, 10))
    assert boxes[0].within(Box(0, 0, 10, 10))
