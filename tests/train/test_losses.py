"""The training loss is the paper's, for whichever stages are asked for."""

import math
from typing import get_args

import pytest
import torch
from torch.autograd import gradcheck

from mcdenoise.models import Output
from mcdenoise.train.losses import LOSSES, Loss, rae_loss, stage_loss


def values(nested: object) -> list[float]:
    return torch.tensor(nested, dtype=torch.float64).flatten().tolist()


def test_the_loss_is_equation_11() -> None:
    r1, r2, y = (torch.rand(2, 3, 3, 4, 5, dtype=torch.float64).tolist() for _ in range(3))

    def spatial(r: list[list[list[float]]]) -> float:
        terms = [abs(a - b) / (abs(a) + abs(b) + 1e-2) for a, b in zip(values(r), values(y), strict=True)]
        return sum(terms) / len(terms)

    def temporal(r: list[list[list[float]]]) -> float:
        terms = []
        for shot, true in zip(r, y, strict=True):
            for i in range(1, 3):
                moved = [abs(a - b) for a, b in zip(values(shot[i]), values(shot[i - 1]), strict=True)]
                truth = [abs(a - b) for a, b in zip(values(true[i]), values(true[i - 1]), strict=True)]
                terms += [abs(a - b) / (a + b + 1e-2) for a, b in zip(moved, truth, strict=True)]
        return sum(terms) / len(terms)

    initial, final, reference = (torch.tensor(x, dtype=torch.float64) for x in (r1, r2, y))
    output = Output(final, {"initial": initial, "nothing": torch.full_like(final, torch.nan)})
    expected = spatial(r1) + spatial(r2) + 0.1 * temporal(r1) + 0.1 * temporal(r2)
    assert stage_loss(output, reference).item() == pytest.approx(expected, rel=1e-12)
    without = stage_loss(output, reference, temporal_weight=0)
    assert without.item() == pytest.approx(spatial(r1) + spatial(r2), rel=1e-12)


def test_the_loss_on_the_curve_of_a_display() -> None:
    """The loss replaces SMAPE, and the temporal loss stays as it was."""
    image, reference = (3 * torch.rand(2, 3, 3, 4, 5, dtype=torch.float64) - 0.5 for _ in range(2))
    shown, wanted = ((each.clamp_min(0) + 1e-3) ** (1 / 2.2) + each.clamp_max(0) for each in (image, reference))
    expected = (shown - wanted).abs().mean()
    found = stage_loss(Output(image), reference, temporal_weight=0, loss="l1_display")
    torch.testing.assert_close(found, expected)
    smape, l1 = (
        [stage_loss(Output(image), reference, temporal_weight=weight, loss=name) for weight in (0.0, 1.0)]
        for name in ("smape", "l1_display")
    )
    torch.testing.assert_close(smape[1] - smape[0], l1[1] - l1[0])
    assert not torch.isclose(smape[0], l1[0])


def test_the_gradient_on_the_curve_of_a_display_is_finite_in_black() -> None:
    image = torch.zeros(1, 1, 3, 2, 2, requires_grad=True)
    stage_loss(Output(image), image.detach() + 0.1, temporal_weight=0, loss="l1_display").backward()
    assert torch.isfinite(image.grad).all()
    assert (image.grad < 0).all()


@pytest.mark.parametrize("loss", ["smape", "l1_display", "rae"])
def test_every_loss_leads_out_of_negative_light(loss: Loss) -> None:
    image = torch.full((1, 1, 3, 2, 2), -0.1).requires_grad_()
    stage_loss(Output(image), torch.full_like(image, 0.5), temporal_weight=0, loss=loss).backward()
    assert (image.grad < 0).all()


def test_the_recurrent_autoencoders_loss_is_its_equation() -> None:
    image, reference = (torch.rand(2, 7, 3, 3, 4, dtype=torch.float64) for _ in range(2))
    # The paper prints these values.
    printed = [0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1.0]
    counts = [math.exp(-((6 - t) ** 2) / 8) for t in range(7)]
    assert counts == pytest.approx(printed, abs=6e-4)

    def mean(numbers: list[float]) -> float:
        return sum(numbers) / len(numbers)

    terms = []
    for clip, true in zip(image.tolist(), reference.tolist(), strict=True):
        pairs = [zip(values(r), values(y), strict=True) for r, y in zip(clip, true, strict=True)]
        errors = [[math.log1p(a) - math.log1p(b) for a, b in pair] for pair in pairs]
        for t, error in enumerate(errors):
            # Channel c, row y, column x is number 12 c + 4 y + x.
            across = [abs(error[i + 1] - error[i]) for i in range(36) if i % 4 < 3]
            down = [abs(error[i + 4] - error[i]) for i in range(36) if i % 12 < 8]
            moved = [abs(a - b) for a, b in zip(error, errors[t - 1], strict=True)] if t else [0.0]
            spatial = mean([abs(each) for each in error])
            gradient = (mean(across) + mean(down)) / 2
            terms.append(counts[t] * (0.8 * spatial + 0.1 * gradient + 0.1 * mean(moved)))
    expected = sum(terms) / 2 / sum(counts)
    assert rae_loss(image, reference).item() == pytest.approx(expected, rel=1e-12)
    found = stage_loss(Output(image), reference, loss="rae")
    assert found.item() == pytest.approx(expected, rel=1e-12)


def test_the_gradient_of_the_recurrent_autoencoders_loss() -> None:
    # Errors and their differences stay away from zero: steps of two, and noise of a tenth.
    place = torch.arange(12, dtype=torch.float64).reshape(1, 1, 1, 3, 4)
    error = 1 + 2 * place + 50 * torch.arange(3, dtype=torch.float64).reshape(1, 3, 1, 1, 1)
    reference = torch.rand(1, 3, 3, 3, 4, dtype=torch.float64)
    image = (torch.expm1(0.01 * error + 1) + reference).requires_grad_()
    assert gradcheck(rae_loss, (image, reference))


def test_the_recurrent_autoencoders_loss_leads_out_of_negative_light() -> None:
    image = torch.full((1, 1, 3, 2, 2), -2.0).requires_grad_()
    loss = rae_loss(image, torch.full_like(image, 0.5))
    loss.backward()
    assert loss.item() == pytest.approx(0.8 * (2 + math.log(1.5)))
    assert image.grad is not None
    torch.testing.assert_close(image.grad, torch.full_like(image, -0.8 / 12))


def test_every_loss_has_its_name() -> None:
    assert set(LOSSES) == set(get_args(Loss))
