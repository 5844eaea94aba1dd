"""Void pixels neither give nor take light, and color and alpha are one pair."""

import numpy as np
import pytest
import torch
from refusals import refused
from torch import Tensor
from toys import Same

import mcdenoise
from mcdenoise import Denoiser, Frame
from mcdenoise.frame import Hints
from mcdenoise.models import Needs, Output
from mcdenoise.models._void import _islands, with_void, without_void


def charts(void: float = 0.0) -> tuple[Tensor, Tensor]:
    """Two charts of noise, bright and dark, and where they are."""
    noise = 1 + 0.2 * torch.rand(1, 3, 24, 40, generator=torch.Generator().manual_seed(0))
    valid, color = torch.zeros(1, 1, 24, 40), torch.full((1, 3, 24, 40), void)
    for columns, value in ((slice(3, 17), 1.0), (slice(23, 37), 0.05)):
        valid[..., 3:21, columns] = 1
        color[..., 3:21, columns] = value * noise[..., 3:21, columns]
    return color, valid


def blur(color: Tensor) -> Tensor:
    return torch.nn.functional.avg_pool2d(color, 5, 1, 2, count_include_pad=False)


@pytest.mark.parametrize("how", ["mask", "alpha", "depth", "features"])
@pytest.mark.parametrize("model", ["joint_bilateral", "guided", blur])
def test_charts_keep_their_light_up_to_their_borders_and_give_each_other_none(model: object, how: str) -> None:
    """A window is wider than the gutter, and no feature tells one chart from the other."""
    color, valid = charts()
    buffers = {how: torch.where(valid > 0, 1, torch.inf) if how == "depth" else valid}
    if how == "features":
        buffers = {"mask": valid, "depth": valid, "normal": valid.expand(-1, 3, -1, -1)}
    image = Denoiser(model)(Frame(color, **buffers))
    assert torch.equal(image * (1 - valid), torch.zeros_like(image))
    for columns, value in ((slice(3, 17), 1.0), (slice(23, 37), 0.05)):
        chart = image[..., 3:21, columns] / value
        assert 1 <= chart.min() <= chart.max() <= 1.2


def test_what_is_masked_does_not_count_and_stays() -> None:
    clean, valid = charts()
    image = Denoiser(blur)(Frame(clean, mask=valid))
    color, _ = charts(void=9.0)
    color[..., 0, :] = torch.nan
    depth = torch.where(valid > 0, 2, torch.nan)
    other = Denoiser(blur)(Frame(color, mask=valid, depth=depth))
    assert torch.equal(other * valid, image * valid)
    assert (other[..., 1:3, :] == 9).all()
    assert not other[..., 0, :].any()


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (30, 50)])
def test_every_void_pixel_is_filled_from_one_that_is_not(size: tuple[int, int]) -> None:
    color = torch.zeros(2, 3, *size)
    color[..., size[0] // 2, size[1] // 3] = 2
    mask = (color[:, :1] > 0).float()
    frame, _ = without_void(Frame(color, mask=mask, layers={"part": color / 2}, extra={"own": color[:, :2]}))
    assert frame.mask is None
    assert (frame.color == 2).all()
    assert (frame.layers["part"] == 1).all()
    assert (frame.extra["own"] == 2).all()
    # If all is void, nothing is to be taken.
    assert torch.equal(without_void(Frame(color, mask=0 * mask))[0].color, color)


def test_the_fill_is_the_mirror_image() -> None:
    row = torch.tensor([0.0, 0, 0, 4, 5, 6, 7, 0, 0, 0, 0, 9]).expand(1, 3, 1, -1)
    frame, _ = without_void(Frame(row, mask=(row[:, :1] > 0).float()))
    assert frame.color[0, 0, 0].tolist() == [6, 5, 4, 4, 5, 6, 7, 7, 6, 9, 9, 9]


def test_a_chart_of_any_shape_is_one() -> None:
    spiral = torch.zeros(2, 1, 9, 9, dtype=torch.bool)
    spiral[..., 1:, :][..., ::2, :] = True
    spiral[..., 2::4, 8] = spiral[..., 4::4, 0] = True
    spiral[1, 0, 5] = False
    number = _islands(spiral)
    assert not number[~spiral].any()
    assert len(number[0].unique()) == 2
    assert len(number[1].unique()) == 3


def test_light_where_nothing_is_means_that_nothing_is_void() -> None:
    """A glow has light where alpha is 0, and fog where the depth is infinite; its noise has black pixels."""
    color, valid = charts()
    color[..., 8, 18:22] = 0.5
    for frame in (Frame(color, alpha=valid), Frame(color, depth=torch.where(valid > 0, 1, torch.inf))):
        assert without_void(frame)[1].mask is None
        assert torch.equal(Denoiser(blur)(frame), blur(color))
        frame = frame.replace(hints=Hints(alpha=True))
        assert torch.equal(without_void(frame)[0].color, color)


def test_a_stage_of_another_size_stays() -> None:
    color, alpha = torch.rand(1, 3, 16, 24), torch.rand(1, 1, 16, 24)

    def model(frame: Frame, state: object = None) -> tuple[Output, None]:
        return Output(blur(frame.color), {"half": torch.ones(1, 3, 8, 12)}), None

    model.needs = Needs(trainable=False)  # type: ignore[attr-defined]
    assert torch.equal(
        Denoiser(model, alpha=True).output(Frame(color, alpha=alpha)).stages["half"], torch.ones(1, 3, 8, 12)
    )


def covers(kind: str) -> Tensor:
    """A true alpha: a disc, the same out of focus or in motion, strands, and panes of glass."""
    rows, columns = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    disc = (18.3 - ((rows - 24) ** 2 + (columns - 32) ** 2).sqrt()).clamp(0, 1)[None, None]
    if kind == "motion":
        return torch.stack([disc.roll(step, 3) for step in range(-6, 7)]).mean(0)
    if kind == "focus":
        ramp = torch.nn.functional.avg_pool2d(disc, 9, 1, 4)
        return torch.nn.functional.avg_pool2d(ramp, 9, 1, 4)
    if kind == "strands":
        return torch.stack([(0.8 - (columns - 3 - 7 * i - rows / (2 + i)).abs()).clamp(0, 1) for i in range(8)]).amax(
            0
        )[None, None]
    return torch.where(columns < 40, 0.3, 0.5) * disc if kind == "glass" else disc


MODELS = ["joint_bilateral", "wild_small", blur]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: getattr(model, "__name__", model))
@pytest.mark.parametrize("kind", ["disc", "motion", "focus", "strands", "glass"])
def test_alpha_without_noise_stays(kind: str, model: object) -> None:
    """Whatever the noise of the color."""
    true = covers(kind)
    noise = -torch.rand(1, 3, 48, 64, generator=torch.Generator().manual_seed(0)).log()
    depth = torch.ones_like(true)
    output = Denoiser(model, alpha=True).output(Frame(true * noise, alpha=true, depth=depth))
    assert torch.equal(output.alpha, true)


@pytest.mark.parametrize(("kind", "left"), [("motion", 0.7), ("focus", 0.6), ("glass", 0.7), ("strands", 1.05)])
@pytest.mark.parametrize("samples", [4, 16])
@pytest.mark.parametrize("model", MODELS, ids=lambda model: getattr(model, "__name__", model))
def test_noise_of_alpha_falls_and_light_stays_its_pair(model: object, samples: int, kind: str, left: float) -> None:
    true = covers(kind)
    drawn = torch.rand(samples, *true.shape, generator=torch.Generator().manual_seed(samples))
    alpha = (drawn < true).float().mean(0)
    red = torch.tensor([0.8, 0.1, 0.05]).reshape(1, 3, 1, 1)
    frame = Frame(alpha * red, alpha=alpha, depth=torch.ones_like(true), layers={"half": alpha * red / 2})
    output = Denoiser(model, alpha=True).output(frame)
    error, before = ((each - true).square().mean().sqrt() for each in (output.alpha, alpha))
    assert error < left * before
    assert 0 <= output.alpha.min() <= output.alpha.max() <= 1
    # Where all around is empty or full, that is sure.
    for sure in (alpha <= 0, alpha >= 1):
        sure = torch.nn.functional.avg_pool2d(sure.float(), 3, 1, 1, count_include_pad=False) == 1
        assert torch.equal(output.alpha[sure], alpha[sure])
    # A network does not keep a constant to the last digit.
    near = 0.05 if model == "wild_small" else 1e-4
    torch.testing.assert_close(output.image, output.alpha * red, rtol=near, atol=1e-3)
    torch.testing.assert_close(output.layers["half"], output.image / 2, rtol=1e-3, atol=1e-5)


def test_sparse_alpha_and_its_light_stay() -> None:
    """What covers a fiftieth of each pixel leaves most patches of pixels empty: half of it was lost to those."""
    alpha = (torch.rand(4, 1, 1, 48, 64, generator=torch.Generator().manual_seed(0)) < 0.02).float().mean(0)
    output = Denoiser("noisy", alpha=True).output(Frame(alpha.expand(-1, 3, -1, -1), alpha=alpha))
    assert not torch.equal(output.alpha, alpha)
    assert float(output.alpha.mean()) == pytest.approx(float(alpha.mean()), rel=0.1)
    assert float(output.image.mean()) == pytest.approx(float(alpha.mean()), rel=0.1)


def test_a_glow_keeps_its_light_and_a_masked_pixel_its_alpha() -> None:
    true = covers("focus")
    drawn = torch.rand(4, *true.shape, generator=torch.Generator().manual_seed(0))
    alpha = (drawn < true).float().mean(0)
    color = alpha.expand(-1, 3, -1, -1).clone()
    glow = (alpha == 0) & (true > 0.1)
    color[glow.expand_as(color)] = 1e-5
    mask = torch.ones_like(alpha)
    mask[..., 20:28, 30:40] = 0
    output = Denoiser("noisy", alpha=True).output(Frame(color, alpha=alpha, mask=mask))
    assert glow.any()
    torch.testing.assert_close(output.image[glow.expand_as(color)], color[glow.expand_as(color)])
    assert torch.equal(output.alpha[mask == 0], alpha[mask == 0])
    assert torch.equal(output.image[(mask == 0).expand_as(color)], color[(mask == 0).expand_as(color)])


def test_an_albedo_is_divided_by_alpha_as_the_light_is() -> None:
    alpha = covers("glass")
    image = (0.6 * alpha).expand(-1, 3, -1, -1)
    frame, _ = without_void(Frame(image, albedo=image, alpha=alpha, hints=Hints(alpha=True)))
    torch.testing.assert_close(frame.albedo, frame.color)
    torch.testing.assert_close(frame.albedo[..., 24, 32], torch.full((1, 3), 0.6))


def test_the_mask_of_an_array_is_the_buffer() -> None:
    color, valid = (each[0].numpy().transpose(1, 2, 0) for each in charts(void=float("nan")))
    masked = np.ma.masked_invalid(color)
    image = mcdenoise.denoise(masked, model=blur)
    np.testing.assert_array_equal(image, mcdenoise.denoise(np.nan_to_num(color), mask=valid, model=blur))
    assert np.ma.masked_invalid(color[..., 0]).mask.any()
    np.testing.assert_allclose(mcdenoise.denoise(np.ma.masked_invalid(color[..., 0]), model=blur), image[..., 0])
    assert "masked" in refused(lambda: Frame.from_numpy(color, depth=np.ma.masked_invalid(color[..., 0])))
    assert Frame.from_numpy(np.ma.masked_array(np.ones((4, 5, 3)))).mask.all()
    rows = np.repeat(np.float32([[1], [0], [1]]), 2, 1)
    both = Frame.from_numpy(np.ma.masked_equal(np.float32([[3, 1]] * 3), 3), mask=rows).mask
    assert both.tolist() == [[[[0, 1], [0, 0], [0, 1]]]]
    assert "(2, 3)" in refused(lambda: Frame.from_numpy(np.ma.masked_equal(np.ones((3, 2)), 3), mask=rows.T))


@pytest.mark.parametrize("layout", ["HWC", "CHW"])
def test_one_channel_is_grey(layout: mcdenoise.frame.Layout) -> None:
    grey = np.random.default_rng(0).random((24, 32))

    def denoised(color: object) -> np.ndarray:
        return mcdenoise.denoise(color, model="joint_bilateral", layout=layout)

    image = denoised(grey)
    color = np.repeat(grey[..., None], 3, -1)
    expected = mcdenoise.denoise(
        color if layout == "HWC" else color.transpose(2, 0, 1), model="joint_bilateral", layout=layout
    )
    assert image.shape == (24, 32)
    np.testing.assert_allclose(image, expected.mean(-1 if layout == "HWC" else 0), rtol=1e-6)
    single = grey[..., None] if layout == "HWC" else grey[None]
    np.testing.assert_array_equal(denoised(single), image.reshape(single.shape))


class Own(Tensor):
    """A class of a user's own."""


def jagged() -> Tensor:
    return torch.nested.nested_tensor([torch.ones(3, 4, 5), torch.ones(3, 4, 6)])


@pytest.mark.parametrize(
    "color",
    [
        torch.ones(1, 3, 4, 5).to_sparse(),
        torch.ones(1, 3, 4, 5).to_mkldnn(),
        torch.ones(1, 3, 4, 5).to(torch.float8_e4m3fn),
        torch.ones(1, 3, 4, 5, dtype=torch.complex64),
        torch.ones(1, 3, 4, 5, dtype=torch.complex64).conj().imag,
        torch.ones(1, 3, 4, 5).as_subclass(Own),
        jagged,
    ],
    ids=["sparse", "mkldnn", "float8", "complex", "negative", "subclass", "nested"],
)
@pytest.mark.filterwarnings("ignore:The PyTorch API of nested tensors")
def test_unusual_tensors_are_refused_in_one_line(color: object) -> None:
    value = color() if callable(color) else color
    for make in (lambda: Frame(value), lambda: Frame(torch.ones(1, 3, 4, 5), albedo=value)):
        message = refused(make)
        assert message.startswith(("buffer 'color': expected", "buffer 'albedo': expected"))
        assert "\n" not in message
    assert "layer 'part'" in refused(lambda: Frame(torch.ones(1, 3, 4, 5), layers={"part": value}))


def test_tensors_without_values_are_refused() -> None:
    assert "meta" in refused(lambda: Denoiser(Same())(Frame(torch.ones(1, 3, 4, 5, device="meta"))))
    # What torch makes itself is an ordinary tensor.
    assert Frame(torch.nn.Parameter(torch.ones(1, 3, 4, 5))).size == (4, 5)


def test_the_output_keeps_the_layers_of_void_pixels() -> None:
    """As far as they hold light: what is NaN there is black, as in the image."""
    color, valid = charts()
    broken = color.index_fill(2, torch.tensor([0]), torch.nan)
    frame = Frame(broken, mask=valid, layers={"all": broken})
    assert not valid[..., 0, :].any()
    filled, void = without_void(frame)
    output = with_void(mcdenoise.models.Output(filled.color, layers=dict(filled.layers)), frame, void)
    assert torch.equal(output.image, color)
    assert torch.equal(output.layers["all"], color)


def test_a_pixel_that_its_path_left_empty_is_no_void() -> None:
    """A third of the paths miss the hair on the left; on the right is nothing."""
    alpha = (torch.rand(1, 1, 48, 64, generator=torch.Generator().manual_seed(0)) < 0.7).float()
    alpha[..., 32:] = 0
    _, void = without_void(Frame(alpha.expand(-1, 3, -1, -1), alpha=alpha, motion=torch.zeros(1, 2, 48, 64)))
    assert void.mask is not None
    assert not void.mask[..., :30].any()
    assert void.mask[..., 32:].all()
