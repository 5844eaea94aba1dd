import itertools

import numpy as np
import pytest

from mcdenoise.report.labels import nearest, place_labels

BOUNDS = (0.0, 0.0, 720.0, 380.0)
CORNERS = [(0.0, 0.0), (720.0, 0.0), (0.0, 380.0), (720.0, 380.0)]
CLUSTER = [(300.0 + 14 * column, 200.0 + 14 * row) for row in range(3) for column in range(4)]
RANDOM = [[(float(x), float(y)) for x, y in np.random.default_rng(seed).uniform(20, 360, (12, 2))] for seed in (0, 1)]


@pytest.mark.parametrize("points", [CORNERS, CLUSTER, *RANDOM], ids=["corners", "cluster", "random", "more"])
def test_no_label_covers_another_or_a_point(points: list[tuple[float, float]]):
    markers = [(x - 4, y - 4, x + 4, y + 4) for x, y in points]
    boxes = place_labels(points, [(110.0, 10.0)] * len(points), BOUNDS, markers)
    for box in boxes:
        assert box[:2] >= (0, 0)
        assert box[2] <= 720
        assert box[3] <= 380
        assert (box[2] - box[0], box[3] - box[1]) == pytest.approx((110, 10))
    for one, other in itertools.combinations([*boxes, *markers], 2):
        apart = one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]
        assert apart or (one in markers and other in markers)


def test_a_lone_point_has_its_label_close_by():
    (box,) = place_labels([(300.0, 200.0)], [(80.0, 10.0)], BOUNDS, [(296, 196, 304, 204)])
    assert np.hypot(*np.subtract(nearest(box, (300, 200)), (300, 200))) <= 6
