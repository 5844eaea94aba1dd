"""Properties of the bilateral grid, beside its equations."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from mcdenoise.ops import grid_slice, grid_splat

GRIDS = ((4, 64), (8, 32), (16, 16))  # the paper's three, s_s pixels and 256 / s_r bins


def smoothed(image: Tensor, guide: Tensor, cell: int, bins: int) -> Tensor:
    return grid_slice(*grid_splat(image, guide, cell=cell, bins=bins), guide, cell=cell)


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize(("cell", "bins"), GRIDS)
@pytest.mark.parametrize("size", [(32, 48), (31, 45), (3, 2)])
def test_a_constant_image_is_unchanged(cell: int, bins: int, size: tuple[int, int]) -> None:
    """Whatever the guide is, also where the last cells hang over the image."""
    image = torch.full((2, 3, *size), 0.7, dtype=torch.float64)
    torch.testing.assert_close(smoothed(image, drawn(2, 1, *size), cell, bins), image, rtol=1e-13, atol=0)


def test_a_constant_guide_smooths_by_tents() -> None:
    """Each cell is the mean of its pixels under a tent, and between cells it is interpolated."""
    cell, image = 4, drawn(1, 1, 1, 16)
    found = smoothed(image, torch.full((1, 1, 1, 16), 0.3, dtype=torch.float64), cell, 8)
    pixels, centres = torch.arange(16) + 0.5, 4 * torch.arange(4) + 2.0
    tents = (1 - (pixels[None] - centres[:, None]).abs() / cell).clamp_min(0).double()
    means = (tents * image[0, 0]).sum(1) / tents.sum(1)
    expected = (tents * means[:, None]).sum(0) / tents.sum(0)
    # The tent is rounded at its top and nowhere else, by 1e-4 at most.
    torch.testing.assert_close(found[0, 0, 0], expected, rtol=1e-3, atol=0)
    assert found.var() < image.var() / 2


@pytest.mark.parametrize(("cell", "bins"), GRIDS)
def test_an_edge_of_the_guide_stays_sharp(cell: int, bins: int) -> None:
    """Two values of it do not mix, however noisy each side is."""
    image = drawn(1, 3, 20, 24)
    image[..., 10:] += 100
    guide = torch.zeros(1, 1, 20, 24, dtype=torch.float64)
    guide[..., 10:] = 0.5
    found = smoothed(image, guide, cell, bins)
    for side in (slice(0, 10), slice(10, 24)):
        other = image.clone()
        other[..., [x for x in range(24) if not side.start <= x < side.stop]] = -1e6
        assert torch.equal(smoothed(other, guide, cell, bins)[..., side], found[..., side])
    assert found[..., :10].max() < 1
    assert found[..., 10:].min() > 100


def test_cells_of_one_pixel_keep_an_image() -> None:
    image = drawn(1, 2, 5, 6)
    torch.testing.assert_close(smoothed(image, drawn(1, 1, 5, 6, seed=1), 1, 1), image, rtol=0, atol=1e-15)


def test_a_pixel_is_in_the_cells_around_it_only() -> None:
    """The first pixel of nine by nine in cells of four, at the lower end of the guide: in the first cell alone."""
    image = torch.ones(1, 1, 9, 9, dtype=torch.float64)
    guide = torch.ones(1, 1, 9, 9, dtype=torch.float64)
    guide[..., 0, 0] = 0
    _, filled = grid_splat(image, guide, cell=4, bins=8)
    assert filled.shape == (1, 1, 3, 3, 8)
    assert filled[..., :2].nonzero().tolist() == [[0, 0, 0, 0, 0]]
    assert filled[..., -1].all()
    assert not filled[..., 1:7].any()


def test_the_weight_of_a_bin_falls_linearly() -> None:
    """A guide of z = 255 g lies (z + 0.5) / s_r along the bins, whose centres are at the halves."""
    image = torch.tensor([[[[0.0, 1.0]]]], dtype=torch.float64)
    # Bins of 64 steps: z + 0.5 = 32 is the centre of the first, and 32 + 48 is a quarter of it and three of the second.
    guide = (torch.tensor([[[[32.0, 80.0]]]], dtype=torch.float64) - 0.5) / 255
    grid, filled = grid_splat(image, guide, cell=2, bins=4)
    assert filled.flatten().tolist() == [1, 1, 0, 0]
    torch.testing.assert_close(grid.flatten()[:2], torch.tensor([0.2, 1.0], dtype=torch.float64), rtol=1e-4, atol=0)


def test_means_of_empty_cells_are_not_read() -> None:
    """Where all cells around a pixel are empty it is 0; where some are, the others count in full."""
    grid, filled = torch.full((1, 1, 2, 2, 1), 3.0), torch.ones(1, 1, 2, 2, 1)
    guide = torch.full((1, 1, 4, 4), 0.5)
    grid[:, :, 0, 0], filled[:, :, 0, 0] = 1e30, 0
    found = grid_slice(grid, filled, guide, cell=2)
    assert found[0, 0, 0, 0] == 0
    torch.testing.assert_close(found.flatten()[1:], torch.full((15,), 3.0))


def test_the_same_bits_each_time() -> None:
    image, guide = drawn(1, 3, 64, 64).float(), drawn(1, 1, 64, 64, seed=1).float()
    first, second = (smoothed(image, guide, 8, 32) for _ in range(2))
    assert torch.equal(first, second)


def test_a_guide_learns_to_keep_an_edge() -> None:
    """A few steps along its gradient bring the image nearer to one with an edge, from a guide that hardly sees it."""
    clean = (torch.arange(16) >= 8).double().expand(1, 1, 8, 16)
    noisy = clean + 0.1 * (drawn(1, 1, 8, 16) - 0.5)
    guide = (0.4 + 0.05 * clean).requires_grad_()
    errors = []
    for _ in range(20):
        error = (smoothed(noisy, guide, 4, 4) - clean).square().mean()
        (gradient,) = torch.autograd.grad(error, guide)
        guide = (guide - 2 * gradient).detach().clamp(0, 1).requires_grad_()
        errors.append(float(error.detach()))
    assert errors[-1] < errors[0] / 4
