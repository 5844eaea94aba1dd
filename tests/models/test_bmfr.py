"""BMFR: its two accumulations, its fit between them, and its anti-aliasing."""

import itertools

import torch
import torch.nn.functional as F
from planes import exponential
from torch import Tensor

from mcdenoise.denoiser import Denoiser
from mcdenoise.frame import Frame
from mcdenoise.models import create_model
from mcdenoise.models.antialiased import Antialiased
from mcdenoise.models.bmfr import STARTS, Bmfr
from mcdenoise.models.noisy import Noisy
from mcdenoise.ops import block_regression

HEIGHT, WIDTH = 40, 50


def frame(light: Tensor | None = None, seed: int = 0, **changes: Tensor) -> Frame:
    """A curved wall that stands still, lit by noise of mean 1."""
    rows, columns = torch.meshgrid(torch.arange(HEIGHT) / 20, torch.arange(WIDTH) / 20, indexing="ij")
    light = exponential(1, 3, HEIGHT, WIDTH, seed=seed) if light is None else light
    normal = F.normalize(torch.stack([(3 * rows).sin(), (2 * columns).cos(), torch.ones_like(rows)]), dim=0)
    position = torch.stack([columns, rows, 3 + columns.sin()])
    return Frame(
        light,
        **{"normal": normal[None], "position": position[None], "motion": torch.zeros(1, 2, HEIGHT, WIDTH), **changes},
    )


def test_a_frame_is_accumulated_fitted_and_accumulated_again() -> None:
    """A scene at rest, frame by frame: the published weights, at the published places."""
    denoiser = Denoiser(create_model("bmfr", taa=False))
    first = second = torch.zeros(())
    for number in range(12):
        given = frame(seed=number)
        alpha = max(1 / (number + 1), 0.2)
        first = alpha * given.color + (1 - alpha) * first
        features = torch.cat([given.normal, given.position], 1)
        fitted = block_regression(first, features, squares=3, offset=STARTS[number]).clamp_min(0)
        alpha = max(1 / (number + 1), 0.1)
        second = alpha * fitted + (1 - alpha) * second
        output = denoiser.output(given)
        torch.testing.assert_close(output.stages["accumulated"], first, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(output.stages["fitted"], fitted, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(output.image, second, rtol=1e-4, atol=1e-5)


def test_blocks_begin_in_sixteen_places() -> None:
    """Half a block before the image, and an offset of the table; all even, and each another one."""
    assert STARTS[:3] == [(30, 30), (22, 12), (2, 24)]
    assert len(set(STARTS)) == 16
    assert all(0 <= start < 32 and start % 2 == 0 for place in STARTS for start in place)


def test_images_of_a_batch_may_be_at_different_frames() -> None:
    model, given = Bmfr(), frame().replace(length=torch.full((1, 1, HEIGHT, WIDTH), 2.0))
    both = given.map(lambda image: torch.cat([image, image.flip(3)]))
    _, one = model(given)
    _, state = model(both)
    state = state._replace(number=torch.tensor([1.0, 5.0]).reshape(2, 1, 1, 1))
    torch.testing.assert_close(model(both, state)[0].image[:1], model(given, one)[0].image)


def naive(new: list[list[list[float]]], before: list[list[list[float]]], alpha: float) -> Tensor:
    """``taa`` of the public code, for a scene at rest, of gamma-mapped values ``[row][column][channel]``."""

    def forth(rgb: list[float]) -> list[float]:
        r, g, b = rgb
        return [r + 2 * g + b, 2 * r - 2 * b, -r + 2 * g - b]

    def back(ycc: list[float]) -> list[float]:
        y, o, g = ycc
        return [0.25 * (y + o - g), 0.25 * (y + g), 0.25 * (y - o - g)]

    height, width = len(new), len(new[0])
    out = torch.zeros(1, 3, height, width, dtype=torch.float64)
    for y, x in itertools.product(range(height), range(width)):
        around = [
            (forth(new[y + dy][x + dx]), not (dy and dx))
            for dy, dx in itertools.product((-1, 0, 1), repeat=2)
            if 0 <= y + dy < height and 0 <= x + dx < width
        ]
        clamped = []
        for c, value in enumerate(forth(before[y][x])):
            box, cross = [color[c] for color, _ in around], [color[c] for color, central in around if central]
            low, high = (min(box) + min(cross)) / 2, (max(box) + max(cross)) / 2
            clamped.append(min(max(value, low), high))
        for c, value in enumerate(back(clamped)):
            out[0, c, y, x] = max(alpha * new[y][x][c] + (1 - alpha) * value, 0.0) ** 2.2
    return out


def test_anti_aliasing_is_that_of_the_public_code() -> None:
    generator = torch.Generator().manual_seed(0)
    colors = (
        torch.rand(2, 3, 4, 5, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 0.8, 0.6])[:, None, None]
    )
    model, still = Antialiased(Noisy()), torch.zeros(1, 2, 4, 5, dtype=torch.float64)
    first, state = model(Frame(colors[:1], motion=still))
    torch.testing.assert_close(first.image, colors[:1])
    second, _ = model(Frame(colors[1:], motion=still), state)
    shown = (colors ** (1 / 2.2)).permute(0, 2, 3, 1).tolist()
    torch.testing.assert_close(second.image, naive(shown[1], shown[0], 0.2))
    torch.testing.assert_close(second.stages["denoised"], colors[1:])
    # Without a motion, and from beyond the border, there is nothing to blend with.
    for motion in (None, still + 9):
        alone, _ = model(Frame(colors[1:], motion=motion), state)
        torch.testing.assert_close(alone.image, colors[1:])
    _, state = model(Frame(1e6 * colors[:1], motion=still))
    torch.testing.assert_close(model(Frame(1e6 * colors[1:], motion=still), state)[0].image, 1e6 * second.image)
