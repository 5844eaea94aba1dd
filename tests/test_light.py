"""NaN, infinite and negative radiance: known answers, means that stay, and what is refused."""

import pytest
import torch
from refusals import refused
from torch import Tensor

from mcdenoise import Denoiser
from mcdenoise.frame import Frame
from mcdenoise.light import Repairs, repair, repairs_from, replace_invalid

NAN, INF = torch.nan, torch.inf


def ramp() -> Tensor:
    return torch.arange(25, dtype=torch.float32).reshape(1, 1, 5, 5).repeat(1, 3, 1, 1)


def flat(*size: int, value: float = 0.5) -> Tensor:
    return torch.full((1, 3, *size), value)


def signed(mean: float, deviation: float, size: int = 96) -> Tensor:
    return mean + deviation * torch.randn(1, 3, size, size, generator=torch.Generator().manual_seed(2))


def repairs_of(color: Tensor) -> Repairs:
    return repairs_from(repair(color, {}, reads=True)[2].tolist(), ())


@pytest.mark.parametrize("bad", [NAN, -INF])
@pytest.mark.parametrize("channel", [0, 2])
def test_a_pixel_without_a_value_becomes_the_mean_of_its_neighbours(bad: float, channel: int) -> None:
    color, noisy = ramp(), ramp()
    noisy[0, channel, 2, 2:4] = bad
    clean, replaced = Frame(color=noisy).validate()
    assert replaced == 2
    # All three channels: half a colour would be a wrong colour. 12 has the neighbours 6 7 8 11 16 17 18 left.
    torch.testing.assert_close(clean.color[0, :, 2, 2], torch.full((3,), 83 / 7))
    untouched = torch.ones(5, 5, dtype=torch.bool)
    untouched[2, 2:4] = False
    assert torch.equal(clean.color[..., untouched], color[..., untouched])
    assert not torch.isfinite(noisy[0, channel, 2, 2])  # the input is not written to


@pytest.mark.parametrize("bad", [INF, 1.1e16, 3e38])
def test_one_infinite_channel_is_as_bright_as_the_brightest_value_around(bad: float) -> None:
    color, noisy = ramp(), ramp()
    noisy[0, 1, 2, 2] = bad
    color[0, 1, 2, 2] = 18
    clean, replaced = replace_invalid(noisy)
    assert replaced == 1
    assert torch.equal(clean, color)
    # A firefly stays one, of a colour that is not the complement of its own.
    noisy[0, :, 2, 2] = torch.tensor([bad, 3000, 1000])
    assert replace_invalid(noisy)[0][0, :, 2, 2].tolist() == [3000, 3000, 1000]


@pytest.mark.parametrize("value", [-1e-6, -0.02, -1.0])
def test_a_negative_channel_is_black_and_the_others_stay(value: float) -> None:
    color, noisy = 100 + ramp(), 100 + ramp()
    noisy[0, 1, 2, 2] = value
    color[0, 1, 2, 2] = 0
    clean, replaced = replace_invalid(noisy)
    assert replaced == 1
    assert torch.equal(clean, color)


def test_a_region_of_light_outside_the_gamut_keeps_its_other_channels() -> None:
    color = flat(64, 64)
    color[0, :, 20:44, 20:44] = torch.tensor([-0.02, 0.2, 2.0])[:, None, None]
    clean, replaced = replace_invalid(color)
    assert replaced == 24 * 24
    assert torch.equal(clean, color.clamp_min(0))
    assert not repairs_of(color).doubt


def test_a_channel_without_positive_light_is_told_in_per_cent() -> None:
    color = flat(4, 4, value=1.0)
    color[:, 0] = -0.5
    assert "found 100.0% of the light negative" in repairs_of(color).doubt
    assert "found 100% of the light negative" in refused(replace_invalid, flat(4, 4, value=-1.0))


@pytest.mark.parametrize("deviation", [0.1, 0.3, 0.5])
def test_noise_around_its_mean_keeps_its_mean_and_is_told(deviation: float) -> None:
    color = signed(0.3, deviation)
    repairs, clean = repairs_of(color), replace_invalid(color)[0]
    assert clean.min() == 0
    for ours, own in zip(clean.mean((0, 2, 3)).tolist(), color.mean((0, 2, 3)).tolist(), strict=True):
        assert ours == pytest.approx(own, rel=0.005)
    assert repairs.clamped == int((color < 0).any(1).sum())
    row, column = repairs.place
    assert color[0, :, row, column].min() == color.min()
    assert bool(repairs.doubt) == (repairs.negative > 0.01)
    # Elsewhere nothing is taken: the light stays where it is.
    beside = torch.cat([color, flat(96, 32, value=0.3)], 3)
    assert torch.equal(replace_invalid(beside)[0][..., 108:], beside[..., 108:])


@pytest.mark.parametrize(
    "color", [signed(0, 1), signed(0.05, 1), -signed(5, 1), torch.linspace(-1, 0.2, 75).reshape(1, 3, 5, 5)]
)
def test_what_is_no_radiance_is_refused(color: Tensor) -> None:
    assert "buffer 'color'" in refused(replace_invalid, color)
    assert "layer 'part'" in refused(Frame(color=color.abs(), layers={"part": color}).validate)
    # One image of a batch is enough.
    assert "negative" in refused(replace_invalid, torch.cat([color.abs(), color]))


def test_the_rounding_of_black_is_no_negative_light() -> None:
    assert not replace_invalid(flat(5, 7, value=-1e-8))[0].any()


def test_a_large_gap_lies_between_the_values_at_its_border() -> None:
    color = torch.linspace(1, 2, 90).expand(1, 3, 70, 90).clone()
    color[..., 10:60, 20:70] = NAN
    clean = replace_invalid(color)[0]
    gap = clean[..., 10:60, 20:70]
    assert 1 <= gap.min() < gap.max() <= 2
    # Left like what is left of it, and right like what is right.
    assert (gap[..., :5] < 1.4).all()
    assert (gap[..., -5:] > 1.6).all()


def test_a_frame_of_nan_is_refused() -> None:
    color = torch.cat([flat(4, 4), flat(4, 4, value=NAN)])
    assert "NaN in every pixel" in refused(replace_invalid, color)


@pytest.mark.parametrize("radius", [1, 3, 6, 40])
def test_an_infinite_sun_stays_the_brightest(radius: int) -> None:
    rows, columns = torch.meshgrid(torch.arange(48), torch.arange(64), indexing="ij")
    disc = (rows - 24) ** 2 + (columns - 30) ** 2 <= radius**2
    color = flat(48, 64)
    color[..., disc] = INF
    clean, replaced = replace_invalid(color)
    assert replaced == int(disc.sum())
    assert (clean[..., disc] >= 65504 if radius > 2 else clean[..., disc] >= 0.5).all()
    assert torch.equal(clean[..., ~disc], color[..., ~disc])
    # Brighter than everything else, in any unit, and so in every layer.
    frame = Frame(
        color=color * 1e6, layers={"sun": torch.where(disc, color, 0) * 1e6, "sky": flat(48, 64) * 4e5}
    ).validate()[0]
    assert (frame.color[..., disc] >= 0.5e6).all()
    torch.testing.assert_close(sum(frame.layers.values())[..., disc], frame.color[..., disc])


def test_layers_add_up_to_the_replaced_color() -> None:
    first, second = signed(0.2, 0.3, 64), signed(0.2, 0.2, 64)
    first[0, :, 5:15, 5:15], second[0, 1, 30, 30:34] = NAN, INF
    frame = Frame(color=first + second, layers={"first": first, "second": second})
    for clean in (frame.validate()[0], frame.repaired()[0]):
        torch.testing.assert_close(sum(clean.layers.values()), clean.color, rtol=1e-5, atol=1e-6)
        assert all((layer >= 0).all() for layer in clean.layers.values())


def test_without_reads_the_result_is_the_same() -> None:
    color = signed(0.3, 0.4)
    color[0, :, 3:30, 4:40], color[0, 1, 50:60, 50:60], color[0, 0, 70, 70] = NAN, INF, 1e20
    here, there = (repair(color, {"half": color / 2}, reads=reads) for reads in (True, False))
    assert torch.equal(here[0], there[0])
    assert torch.equal(here[1]["half"], there[1]["half"])
    assert torch.equal(here[2], there[2])


def test_gradients_skip_replaced_pixels() -> None:
    color = torch.ones(1, 3, 9, 9, dtype=torch.float64)
    color[0, 0, 1, 1] = color[0, 0, 4:8, 4:8] = NAN
    color.requires_grad_()
    (gradient,) = torch.autograd.grad(replace_invalid(color)[0].sum(), color)
    assert torch.isfinite(gradient).all()
    assert not gradient[0, :, 1, 1].any()
    torch.testing.assert_close(gradient.sum(), torch.tensor(243.0, dtype=torch.float64))


def test_the_denoiser_warns_once_a_shot_of_changed_light() -> None:
    def same(color: Tensor) -> Tensor:
        return color

    denoiser = Denoiser(same)
    with pytest.warns(UserWarning, match="light negative"):
        denoiser(Frame(color=signed(0.3, 0.5)))
    image = denoiser(Frame(color=signed(0.3, 0.5)))
    assert image.mean() == pytest.approx(0.3, rel=0.05)
    # Of a normal distribution: (p - 0.3) / (2 p - 0.3), with the mean p of its positive values.
    assert denoiser.report.repairs.negative == pytest.approx(0.18, rel=0.05)
    assert "negative light" in str(denoiser.report)
