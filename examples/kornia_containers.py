"""Operators inside kornia's containers, and kornia's augmentation for frames with features.

    python examples/kornia_containers.py

Every operator with one image has a Module twin, which works in ``ImageSequential`` with kornia's own filters and
augmentations. To augment a frame, all of its buffers are concatenated along the channels, transformed by one call, and
split again. Flipping the image does not change world-space normals, but it reverses the motion.
"""

import torch
from kornia.augmentation import RandomCrop, RandomHorizontalFlip
from kornia.augmentation.container import ImageSequential
from kornia.filters import MedianBlur
from torch import Tensor

from mcdenoise import Frame
from mcdenoise.ops import Atrous, ClampFireflies

BUFFERS = {"color": 3, "albedo": 3, "normal": 3, "depth": 1, "motion": 2}


def preview(size: int = 64) -> ImageSequential:
    """A quick look at noisy radiance: one operator of this package, one filter and one augmentation of kornia's."""
    return ImageSequential(ClampFireflies(limit=4.0), MedianBlur((3, 3)), RandomCrop((size, size)))


def augment(frame: Frame, flip: RandomHorizontalFlip) -> Frame:
    """Flip all buffers of a frame in the same way.

    Args:
        frame: with all of ``BUFFERS``.
        flip: drawn once for each image of the batch.
    """
    stacked = torch.cat([getattr(frame, name) for name in BUFFERS], 1)
    moved = dict(zip(BUFFERS, ImageSequential(flip)(stacked).split(list(BUFFERS.values()), 1), strict=True))
    # The augmentation stores its random choice: true for the images that were flipped.
    flipped = flip._params["batch_prob"].bool().reshape(-1, 1, 1, 1)
    x, y = moved["motion"].split(1, 1)
    moved["motion"] = torch.cat([torch.where(flipped, -x, x), y], 1)
    return Frame(**moved)


def smooth(light: Tensor, steps: tuple[int, ...] = (1, 2, 4)) -> Tensor:
    """Chain filters with two inputs and outputs by hand: light and its variance."""
    variance = light.var((1, 2, 3), keepdim=True).expand_as(light[:, :1])
    for step in steps:
        light, variance = Atrous(step=step)(light, variance)
    return light


def main() -> None:
    torch.manual_seed(1)
    noisy = -torch.rand(2, 3, 90, 160).clamp_min(1e-6).log()
    frame = Frame(
        color=noisy,
        albedo=torch.rand(2, 3, 90, 160),
        normal=torch.zeros(2, 3, 90, 160),
        depth=torch.ones(2, 1, 90, 160),
        motion=torch.ones(2, 2, 90, 160),
    )
    print("preview", tuple(preview()(noisy).shape))
    moved = augment(frame, RandomHorizontalFlip(p=0.5))
    print("motion in x", moved.motion[:, 0].mean((1, 2)).tolist())
    print(f"deviation {noisy.std():.2f}, smoothed {smooth(noisy).std():.2f}")


if __name__ == "__main__":
    main()
