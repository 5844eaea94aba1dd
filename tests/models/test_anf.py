"""Affinity of neural features against its equations, and what it keeps from frame to frame."""

from typing import Any

import torch
from toys import drawn, frame_of, small

from mcdenoise import Frame
from mcdenoise.models.anf import Anf

SIZE = (6, 7)


def shot(frames: int = 3, size: tuple[int, int] = SIZE, **buffers: Any) -> list[Frame]:
    """Everything moves by a pixel to the left, on one plane; noise and albedo are drawn anew."""
    motion = torch.zeros(1, 2, *size)
    motion[:, 0] = 1
    flat = {"normal": torch.tensor([0.0, 0.6, 0.8]).reshape(1, 3, 1, 1).expand(1, 3, *size)}
    flat["depth"] = torch.full((1, 1, *size), 3.0)
    found = [frame_of(*size, seed=seed, motion=motion, **flat, **buffers) for seed in range(frames)]
    return [frame.to(torch.float64) for frame in found]


@torch.no_grad()
def test_samples_that_are_all_the_color_are_as_none_and_their_order_says_nothing() -> None:
    model = small("anf")
    frame = frame_of(9, 11)
    plain, _ = model(frame)
    same, _ = model(frame.replace(samples=frame.color[:, None].repeat(1, 3, 1, 1, 1)))
    torch.testing.assert_close(same.image, plain.image)
    samples = torch.rand(1, 4, 5, 9, 11) * frame.color[:, None].mean(2, keepdim=True)
    one, _ = model(frame.replace(samples=samples))
    other, _ = model(frame.replace(samples=samples[:, [2, 0, 3, 1]]))
    torch.testing.assert_close(one.image, other.image)
    embedded = [model.inner.embedded(each) for each in (frame, frame.replace(samples=samples))]
    assert not torch.allclose(*embedded, rtol=1e-3)


@torch.no_grad()
def test_pixels_of_another_surface_have_no_weight() -> None:
    """In a frame of another depth nothing of the one before is left, however bright it was."""
    model = drawn(Anf(6), 0.25)
    first, second, _ = shot()
    moved = second.replace(depth=2 * second.depth)
    for before in (first, first.replace(color=1e6 * first.color)):
        _, state = model(before)
        torch.testing.assert_close(model(moved, state)[0].image, model(moved)[0].image)
        assert not torch.allclose(model(second, state)[0].image, model(second)[0].image, rtol=1e-3)
