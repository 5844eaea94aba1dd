"""How the renderer sampled the features of a frame, from their values."""

from __future__ import annotations

import torch

from mcdenoise.frame import Frame

# Smallest squared length of a normal that is not a mean of several, and largest fraction of pixels with shorter ones.
_UNIT, _MOST_MEANS = 0.98, 0.002
# Smallest relative difference of inverse depths two pixels apart that is no rounding error of half floats, and largest
# relative change of the slope in smooth depth.
_LEAST_SLOPE, _EVEN = 4e-3, 0.1
# Smallest difference of dissimilar normals, and largest fraction of dissimilar pixels. Fractions of up to 0.0039 were
# measured in scenes without rough glass and metal, and 0.0069 in Cycles with them.
_UNLIKE, _MOST_SPECKS = 0.1, 0.0045


def has_centred_features(frame: Frame) -> bool:
    """Whether features come from one ray through the centre of each pixel.

    Averages of several normals are shorter than one, so hardly any pixel may have a short normal. Depth must be smooth:
    along a plane its inverse is linear in the image, and on a curved surface nearly so, but not if rays pass through
    random points of a pixel or a lens. Rays passed through the centres if at least a quarter of the triples of
    neighbours in a row or a column have ``|a - 2 b + c| < |a - c| / 10``, or if the depth has no slope anywhere.

    Args:
        frame: any; without a normal and a depth the answer is no.
    """
    if frame.normal is None or frame.depth is None:
        return False
    squares = frame.normal.square().sum(1)
    # A zero normal: nothing was hit.
    if float(((squares < _UNIT) & (squares > 0)).float().mean()) > _MOST_MEANS:
        return False
    even = compared = 0
    for inverse in ((near := frame.depth.detach().reciprocal()), near.mT):
        a, b, c = inverse[..., :-2], inverse[..., 1:-1], inverse[..., 2:]
        slope = (a - c).abs()
        known = (slope > _LEAST_SLOPE * b) & (torch.minimum(a, c) > 0)
        compared += int(known.sum())
        even += int((known & ((a - 2 * b + c).abs() < _EVEN * slope)).sum())
    return even >= compared / 4


def has_scattered_features(frame: Frame) -> bool:
    """Whether features have noise of rays that rough metal and glass scattered.

    Some renderers write the features of the surface that such a ray hits. So few normals may differ from all four
    neighbours where opposite neighbours agree.

    Args:
        frame: any; without a normal the answer is no.
    """
    if frame.normal is None:
        return False
    normal = frame.normal.detach()
    left, right = normal[..., 1:-1, :-2], normal[..., 1:-1, 2:]
    above, below = normal[..., :-2, 1:-1], normal[..., 2:, 1:-1]
    inside = normal[..., 1:-1, 1:-1]
    nearest = torch.stack([(inside - other).abs().amax(1) for other in (left, right, above, below)]).amin(0)
    around = torch.maximum((left - right).abs().amax(1), (above - below).abs().amax(1))
    count = int(((nearest > _UNLIKE) & (around < nearest / 2)).sum())
    return count > _MOST_SPECKS * nearest.numel()
