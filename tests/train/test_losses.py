"""The training loss is the paper's, for whichever stages are asked for."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from mcdenoise.errors import InputError
from mcdenoise.models import Output
from mcdenoise.train.losses import stage_loss, stage_weights

BOTH = {"image": 1.0, "initial": 1.0}


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
    assert stage_loss(output, reference, BOTH).item() == pytest.approx(expected, rel=1e-12)
    without = stage_loss(output, reference, BOTH, temporal_weight=0)
    assert without.item() == pytest.approx(spatial(r1) + spatial(r2), rel=1e-12)
    weighted = stage_loss(output, reference, {"image": 2, "initial": 0.25}, temporal_weight=0.5)
    expected = 2 * (spatial(r2) + 0.5 * temporal(r2)) + 0.25 * (spatial(r1) + 0.5 * temporal(r1))
    assert weighted.item() == pytest.approx(expected, rel=1e-12)


def test_the_gradient_of_the_loss() -> None:
    # Away from the kinks: no error, and no frame difference, is near zero.
    frames = torch.arange(3, dtype=torch.float64).reshape(1, 3, 1, 1, 1)
    reference = 1 + frames + torch.rand(1, 3, 3, 2, 3, dtype=torch.float64) * 0.1
    initial = (3 * reference + torch.rand_like(reference) * 0.1).requires_grad_()
    final = (0.4 * reference + torch.rand_like(reference) * 0.01).requires_grad_()

    def loss(a: Tensor, b: Tensor) -> Tensor:
        return stage_loss(Output(b, {"initial": a}), reference, BOTH)

    assert gradcheck(loss, (initial, final))


def test_the_spatial_loss_on_the_curve_of_a_display() -> None:
    """In place of SMAPE, and the temporal loss as it was."""
    image, reference = (3 * torch.rand(2, 3, 3, 4, 5, dtype=torch.float64) - 0.5 for _ in range(2))
    shown, wanted = ((each.clamp_min(0) + 1e-3) ** (1 / 2.2) for each in (image, reference))
    expected = (shown - wanted).abs().mean()
    found = stage_loss(Output(image), reference, {"image": 2.0}, temporal_weight=0, spatial_loss="l1_display")
    torch.testing.assert_close(found, 2 * expected)
    smape, l1 = (
        [
            stage_loss(Output(image), reference, {"image": 1.0}, temporal_weight=weight, spatial_loss=loss)
            for weight in (0.0, 1.0)
        ]
        for loss in ("smape", "l1_display")
    )
    torch.testing.assert_close(smape[1] - smape[0], l1[1] - l1[0])
    assert not torch.isclose(smape[0], l1[0])


def test_the_gradient_on_the_curve_of_a_display_is_finite_in_black() -> None:
    image = torch.zeros(1, 1, 3, 2, 2, requires_grad=True)
    stage_loss(
        Output(image), image.detach() + 0.1, {"image": 1.0}, temporal_weight=0, spatial_loss="l1_display"
    ).backward()
    assert image.grad is not None
    assert torch.isfinite(image.grad).all()
    assert (image.grad < 0).all()


def test_the_loss_of_one_frame() -> None:
    one = torch.rand(1, 1, 3, 2, 2)
    assert stage_loss(Output(one), one, {"image": 1.0}, temporal_weight=0).item() == 0
    with pytest.raises(ValueError, match="at least 2 frames"):
        stage_loss(Output(one), one, {"image": 1.0})


def test_weights_that_nobody_asked_for_are_the_papers() -> None:
    image = torch.rand(1, 1, 3, 2, 2)
    assert stage_weights({}, Output(image)) == {"image": 1}
    assert stage_weights({}, Output(image, {"accumulated": image, "initial": image})) == BOTH
    assert stage_weights({"accumulated": 2}, Output(image, {"accumulated": image})) == {"accumulated": 2}
    with pytest.raises(InputError, match=r"losses: expected stages of the model \(image\), found 'initial'"):
        stage_weights({"initial": 1}, Output(image))
