"""Open Image Denoise made steady: what of it and of the frame before is shown, and where it is ahead."""

import copy
import importlib.util
import itertools
from pathlib import Path

import pytest
import torch
from planes import plane
from refusals import refused
from torch import Tensor
from toys import frame_of, whole_frame

from mcdenoise import Denoiser, Frame
from mcdenoise.data import open_sequence
from mcdenoise.metrics import smape_linear
from mcdenoise.models import create_model
from mcdenoise.models._precision import Chosen, Precision, has_network
from mcdenoise.models._wrapper import FromBuffers
from mcdenoise.models.noisy import Noisy
from mcdenoise.models.oidn import Oidn
from mcdenoise.models.oidn_temporal import mixed
from mcdenoise.models.recurrent import PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT
from mcdenoise.models.steadied import Steadied
from mcdenoise.models.tiled import with_border, without_border
from mcdenoise.models.with_oidn import CENTRED, NOISY, OIDN, OIDN_ALBEDO, OIDN_CLEAN, WithOidn, _without_pattern
from mcdenoise.nn.oidn import oidn_exposure
from mcdenoise.ops._steps.transfer import compress
from mcdenoise.train.clips import LIGHT
from mcdenoise.train.front import split

if importlib.util.find_spec("pyoidn") is None:
    pytest.skip("Open Image Denoise is in the extra mcdenoise[oidn]", allow_module_level=True)

NAME = "oidn_temporal"


def given(height: int, width: int) -> Frame:
    """Return the frame that the last step sees: it has four images, all different."""
    extra = {name: torch.rand(1, 3, height, width) + 0.1 for name in (NOISY, PREVIOUS, PREVIOUS_LIGHT)}
    extra[PREVIOUS_WEIGHT] = torch.ones(1, 1, height, width)
    return frame_of(height, width, extra=extra)


def test_a_still_is_a_mean_of_two_images() -> None:
    model, oidn = create_model(NAME, threads=1), Oidn("high", threads=1)
    frame = frame_of(24, 40)
    noisy = without_border(oidn.denoised(frame.map(with_border), "noisy"))
    clean = without_border(oidn.denoised(oidn.with_clean_features(frame.map(with_border), "high"), "clean"))
    output, _ = model(frame)
    torch.testing.assert_close(output.image, (noisy + 3 * clean) / 4)
    torch.testing.assert_close(output.stages["oidn"], noisy)
    torch.testing.assert_close(output.stages["oidn_clean"], clean)


def test_detail_of_a_clean_frame_is_given_back() -> None:
    # Stripes of 17 pixels across a wall whose features do not show them, without noise.
    rows, columns = torch.meshgrid(torch.arange(64.0), torch.arange(96.0), indexing="ij")
    color = (1 + 0.3 * torch.sin(0.3 * rows + 0.2 * columns)).expand(1, 3, 64, 96).contiguous()
    normal = torch.eye(3)[2].reshape(1, 3, 1, 1).expand_as(color).contiguous()
    frame = Frame(color, albedo=torch.full_like(color, 0.5), normal=normal)
    without, restored = (create_model(NAME, threads=1, restore=on)(frame)[0].image for on in (False, True))
    assert smape_linear(restored, color) < smape_linear(without, color) / 3


def test_noise_that_neighbours_share_is_removed() -> None:
    rows, columns = torch.meshgrid(torch.arange(151), torch.arange(201), indexing="ij")
    albedo = (0.2 + 0.6 * ((rows // 20 + columns // 20) % 2)).expand(1, 3, -1, -1)
    light = 1 + 0.3 * torch.sin(rows / 30) * torch.cos(columns / 40)
    noise = torch.empty(1, 1, 151, 201).exponential_(generator=torch.Generator().manual_seed(0))
    # Mitsuba's default: a Gaussian of half a pixel; samples lie anywhere in their pixel, which widens it.
    film = torch.exp(-(torch.arange(-2.0, 3) ** 2) / (2 * (0.5**2 + 1 / 12)))
    film = (film[:, None] * film / film.sum() ** 2).expand(3, 1, 5, 5)
    color = torch.nn.functional.conv2d(albedo * light * noise, film, groups=3, padding=2)
    truth = torch.nn.functional.conv2d(albedo * light, film, groups=3, padding=2)
    frame = Frame(color, albedo=albedo, normal=torch.tensor([0.0, 0, 1]).reshape(1, 3, 1, 1).expand(1, 3, 151, 201))
    stages, oidn = create_model(NAME, threads=1)(frame)[0].stages, Oidn("high", threads=1)
    assert stages["oidn"].shape == color.shape
    whole = without_border(oidn.denoised(frame.map(with_border), "noisy"))
    assert smape_linear(stages["oidn"], truth) < smape_linear(whole, truth) / 2


@pytest.mark.parametrize("quality", ["fast", "high"])
def test_the_image_for_noisy_features_alone(quality: str) -> None:
    model = create_model(NAME, threads=1, quality=quality, auxiliary="noisy", restore=False)
    oidn = Oidn(quality, threads=1)
    frame = frame_of(24, 40)
    output, state = model(frame)
    assert torch.equal(output.image, without_border(oidn.denoised(frame.map(with_border), "noisy")))
    assert "oidn" in output.stages
    assert "oidn_clean" not in output.stages
    assert state is not None
    # Features without noise need no denoising.
    exact = plane().replace(albedo=torch.rand(1, 3, 40, 60))
    extra = model.before(exact).extra
    assert OIDN_CLEAN not in extra
    assert torch.equal(extra[OIDN_ALBEDO], exact.albedo)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e4])
def test_a_pattern_of_two_by_two_pixels_is_removed_and_an_edge_kept(unit: float) -> None:
    image = torch.ones(1, 3, 12, 12)
    image[..., 6:] = 3
    pattern = torch.tensor([[0.94, 1.02], [0.98, 1.06]]).repeat(6, 6)
    found = _without_pattern(unit * image * pattern) / unit
    # The guide of columns 4 to 7 varies, because the binomial kernel covers the edge. Rows at the border are repeated.
    torch.testing.assert_close(found[..., 2:-2, 2:4], image[..., 2:-2, 2:4])
    torch.testing.assert_close(found[..., 2:-2, 8:10], image[..., 2:-2, 8:10])
    # Beside the edge a weight of exp(-30 log(1.5)^2) / 2 is left for one neighbour, and of exp(-30 log(5/3)^2) / 2 for
    # the other, so that only the mean over two rows is taken.
    torch.testing.assert_close(found[0, 0, 4, 5:7], torch.tensor([1.04, 3 * 0.96]), rtol=0.01, atol=0)


@pytest.mark.parametrize("centred", [0.0, 1.0])
def test_weights_written_out_in_float64(centred: float) -> None:
    height, width, history = 9, 18, 7.0
    frame = given(height, width).to(torch.float64)
    same = torch.rand(1, 1, height, width, dtype=torch.float64)
    extra = {**frame.extra, PREVIOUS_WEIGHT: same, CENTRED: torch.full_like(same, centred)}
    frame = frame.replace(extra=extra)
    image = Steadied(history)(frame)[0].image
    exposure = oidn_exposure(frame.color).item()
    mean, noisy = (each[0] * exposure for each in (frame.color, extra[NOISY]))
    before, light = (extra[name][0] * exposure for name in (PREVIOUS, PREVIOUS_LIGHT))
    before = light if centred else (before + light) / 2

    def over(image: Tensor, row: int, column: int, window: int) -> Tensor:
        """The sum over the pixels of the window that are in the image, in parts of all of the window's."""
        reach = window // 2
        rows = slice(max(row - reach, 0), row + reach + 1)
        columns = slice(max(column - reach, 0), column + reach + 1)
        return image[:, rows, columns].sum((1, 2)) / window**2

    for row, column in itertools.product(range(height), range(width)):
        inside = over(torch.ones_like(same[0]), row, column, 15)
        deviation = over((noisy - mean).abs(), row, column, 15).mean()
        noise = deviation / (over(mean, row, column, 15).mean() + 0.01 * inside + 1e-6) + 0.02
        n = history * same[0, 0, row, column]
        for window, doubt in ((3, 2), (15, 6)):
            a, b, count = (
                over(part * same[0], row, column, window) for part in (before, mean, torch.ones_like(same[0]))
            )
            change = (a - b).abs().mean() / ((a + b).mean() / 2 + 0.01 * count + 1e-6)
            n = n * torch.exp(-doubt * change / noise)
        expected = (mean[:, row, column] + n * before[:, row, column]) / (1 + n) / exposure
        torch.testing.assert_close(image[0, :, row, column], expected)


def test_none_is_asked_of_oidn_for_a_gradient() -> None:
    model = create_model(NAME, threads=1)
    frame = whole_frame(model, 24, 40)
    color = frame.color.requires_grad_()
    assert "the library has no derivatives" in refused(lambda: model(frame.replace(color=color)))


def test_gradients_of_the_last_step_in_float64() -> None:
    frame = given(9, 10).to(torch.float64)

    def image(previous: Tensor, color: Tensor) -> Tensor:
        handed = frame.replace(color=color, extra={**frame.extra, PREVIOUS: previous})
        return Steadied()(handed)[0].image

    inputs = tuple(each.clone().requires_grad_() for each in (frame.extra[PREVIOUS], frame.color))
    assert torch.autograd.gradcheck(image, inputs, atol=1e-6, fast_mode=True)
    assert torch.autograd.gradgradcheck(image, inputs, atol=1e-5, fast_mode=True)


def test_tiles_are_the_whole_image_which_oidn_sees() -> None:
    whole = Denoiser(create_model(NAME, threads=1))
    tiles = Denoiser(create_model(NAME, threads=1), tile=64)
    for seed in range(2):
        frame = whole_frame(whole.model, 200, 330, seed=seed)
        torch.testing.assert_close(tiles(frame), whole(frame), rtol=1e-4, atol=1e-4)
    assert tiles.report.tiles.startswith("6 x 4 tiles")


def test_a_copy_has_a_library_of_its_own() -> None:
    model = create_model(NAME, threads=1, quality="fast", restore=False)
    other = copy.deepcopy(model)
    frame = whole_frame(model, 24, 40)
    assert other._library is not model._library
    assert (other._library.quality, other._library.threads) == ("fast", 1)
    assert torch.equal(other(frame)[0].image, model(frame)[0].image)


@pytest.mark.parametrize(("offset", "specks"), [(0, 0), (1, 0), (0, 1)])
def test_features_are_denoised_unless_they_are_exact(offset: int, specks: int) -> None:
    frame = plane(offset * torch.rand(2, 40, 60)).replace(albedo=torch.rand(1, 3, 40, 60))
    normal = frame.normal.clone()
    normal[..., 5::10, 5::10] *= 1 - 2 * specks
    extra = WithOidn(Noisy(), threads=1).before(frame.replace(normal=normal)).extra
    assert torch.equal(extra[CENTRED], torch.full((1, 1, 40, 60), 1.0 - offset))
    assert torch.equal(extra[OIDN_ALBEDO], frame.albedo) == (not offset and not specks)


def test_the_texture_of_a_moving_wall_stays_sharp() -> None:
    """The camera passes a wall by half a pixel a frame, and a bilinear history would blur its checks."""
    denoiser = Denoiser(create_model(NAME, threads=1, restore=False))
    errors = []
    for number in range(6):
        frame = plane()
        columns = (torch.arange(60) + 0.5 * number).floor().long()
        albedo = (0.1 + 0.8 * ((torch.arange(40)[:, None] + columns) % 2)).expand(1, 3, 40, 60).contiguous()
        motion = torch.tensor([0.5, 0.0]).reshape(1, 2, 1, 1).expand(1, 2, 40, 60)
        image = denoiser(frame.replace(color=albedo, albedo=albedo, motion=motion))
        errors.append(smape_linear(image, albedo).item())
    assert denoiser.report.history > 0.5
    assert max(errors) < 1.5 * errors[0]


def test_it_is_ahead_of_oidn(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    denoiser, oidn = Denoiser(NAME, threads=1), [Denoiser("oidn", auxiliary=each) for each in ("noisy", "clean")]
    errors = torch.zeros(3)
    for number in sequence.numbers:
        frame = sequence.frame(number)
        for index, each in enumerate([denoiser, *oidn]):
            errors[index] += smape_linear(each(frame.replace(reference=None)), frame.reference).mean()
    assert errors[0] < errors[1:].min()


@pytest.mark.parametrize("auxiliary", ["both", "noisy"])
def test_both_engines_give_the_same_sequence(auxiliary: str) -> None:
    methods = [Denoiser("oidn_temporal", auxiliary=auxiliary, engine=engine) for engine in ("library", "torch")]
    assert has_network(methods[1].model)
    assert not has_network(methods[0].model)
    methods[1] = Denoiser("oidn_temporal", auxiliary=auxiliary, engine="torch", precision="float32")
    for seed in range(2):
        frame = whole_frame(methods[0].model, 40, 56, seed=seed)
        images = [compress(method(frame)) for method in methods]
        # Rounding of two images, and of the features that the second one is denoised with.
        torch.testing.assert_close(*images, rtol=0, atol=4 * 20 * 2.0**-22)


def test_training_begins_behind_oidn() -> None:
    """Its images are computed into the cache. They are light, and clips scale them as such."""
    model = WithOidn(FromBuffers(mixed), threads=1)
    front, rest = split(model)
    assert [kind for kind, _ in front.wrappers] == [WithOidn]
    assert (front.accumulates, front.demodulates) == (False, False)
    assert front.parts == {"color": 3, OIDN: 3, OIDN_CLEAN: 3, OIDN_ALBEDO: 3, NOISY: 3, CENTRED: 1}
    assert front.parts.keys() - {OIDN_ALBEDO, CENTRED} <= LIGHT
    frame = frame_of(24, 40)
    seen, output = front.begin()(frame), model(frame)[0]
    for name in (OIDN, OIDN_CLEAN):
        assert torch.equal(seen.extra[name], output.stages[name])
    assert torch.equal(rest(seen)[0].image, output.image)


@pytest.mark.parametrize("fastest", ["float32", "bfloat16"])
def test_the_engine_is_torch_where_bfloat16_is_chosen(fastest: Precision, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mcdenoise.models.with_oidn.fastest_precision", lambda _: Chosen(fastest, ""))
    auto, library, torches = (create_model("oidn_temporal", engine=each) for each in ("auto", "library", "torch"))
    assert [has_network(model) for model in (auto, library, torches)] == [fastest == "bfloat16", False, True]
    # It is loaded with the first frame that needs it.
    assert not list(auto.parameters())
    frame = frame_of(24, 40)
    for rounded in (False, True):
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=rounded):
            images = [model(frame)[0].image for model in (auto, library, torches)]
        assert not torch.equal(images[1], images[2])
        assert torch.equal(images[0], images[2 if rounded and fastest == "bfloat16" else 1])


@pytest.mark.parametrize("engine", ["library", "torch"])
def test_the_quality_of_the_filters_of_features(engine: str) -> None:
    frame = frame_of(24, 40)
    for quality in ("fast", "high"):
        image = create_model("oidn_temporal", prefilter=quality, engine=engine)(frame)[0].stages[OIDN_CLEAN]
        oidn = Oidn("high", threads=1)
        expected = without_border(oidn.denoised(oidn.with_clean_features(frame.map(with_border), quality), "clean"))
        torch.testing.assert_close(image, expected, rtol=2e-3, atol=2e-4)
