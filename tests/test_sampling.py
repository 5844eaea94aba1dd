"""Exact features are told from noisy ones by their values."""

import pytest
import torch
from planes import HEIGHT, WIDTH, plane

from mcdenoise.frame import Frame
from mcdenoise.sampling import has_centred_features, has_scattered_features

CENTRED = plane()


def test_a_plane_seen_through_the_centres() -> None:
    assert has_centred_features(CENTRED)
    # Files in half precision have such a depth.
    assert has_centred_features(CENTRED.replace(depth=CENTRED.depth.half().float()))
    # A wall that faces the camera shows nothing else.
    assert has_centred_features(CENTRED.replace(depth=torch.full_like(CENTRED.depth, 3.0)))


def test_a_plane_seen_through_random_points_of_the_pixels() -> None:
    assert not has_centred_features(plane(torch.rand(2, HEIGHT, WIDTH) - 0.5))


def test_normals_of_more_than_one_point() -> None:
    """Blender's depth is that of the first sample, but its normals are means."""
    mixed = CENTRED.normal.clone()
    mixed[..., ::10] = (mixed[..., ::10] + torch.tensor([0, 1.0, 0]).reshape(1, 3, 1, 1)) / 2
    assert not has_centred_features(CENTRED.replace(normal=mixed))
    background = CENTRED.normal * (torch.arange(WIDTH) > 9)
    assert has_centred_features(CENTRED.replace(normal=background))


@pytest.mark.parametrize("missing", ["depth", "normal"])
def test_without_depth_or_normal_the_answer_is_no(missing: str) -> None:
    assert not has_centred_features(CENTRED.replace(**{missing: None}))


def test_normals_of_scattered_rays() -> None:
    assert not has_scattered_features(CENTRED)
    assert not has_scattered_features(CENTRED.replace(normal=None))
    specks = CENTRED.normal.clone()
    specks[..., 5::10, 5::10] *= -1
    assert has_scattered_features(CENTRED.replace(normal=specks))
    # The edges of an object in front have equal neighbours.
    edges = CENTRED.normal.clone()
    edges[..., 10:30, 20:50] *= -1
    assert not has_scattered_features(CENTRED.replace(normal=edges))
    assert not has_scattered_features(Frame(CENTRED.color[..., :2, :2], normal=CENTRED.normal[..., :2, :2]))
