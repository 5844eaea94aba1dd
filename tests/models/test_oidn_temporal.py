"""Open Image Denoise with a network behind it: what it gives untrained, what it can learn to give, and its training."""

from __future__ import annotations

import copy
import importlib.util
import itertools
import math
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor
from toys import frame_of, refused, small, whole_frame

from mcdenoise import Denoiser, Frame
from mcdenoise.data import open_sequence
from mcdenoise.metrics import smape_linear
from mcdenoise.models import create_model, pretrained_models
from mcdenoise.models.noisy import Noisy
from mcdenoise.models.oidn import Oidn
from mcdenoise.models.oidn_temporal import CLEAN, EXACT, NOISY, AfterOidn, TemporalNetwork, has_exact_features
from mcdenoise.models.recurrent import PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT
from mcdenoise.nn.oidn import oidn_exposure
from mcdenoise.train.cache import open_cached
from mcdenoise.train.clips import Clip
from mcdenoise.train.front import split
from mcdenoise.train.unroll import unroll

if importlib.util.find_spec("pyoidn") is None:
    pytest.skip("Open Image Denoise is in the extra mcdenoise[oidn]", allow_module_level=True)

NAME = "oidn_temporal"


def given(height: int = 21, width: int = 34, weight: float = 1.0) -> Frame:
    """What the network sees: five images, all different."""
    extra = {name: torch.rand(1, 3, height, width) + 0.1 for name in (CLEAN, NOISY, PREVIOUS, PREVIOUS_LIGHT)}
    extra[PREVIOUS_WEIGHT] = torch.full((1, 1, height, width), weight)
    return frame_of(height, width, extra=extra)


def forced(*logits: float) -> TemporalNetwork:
    """A network that predicts the same everywhere: logarithms of three parts, of the history's weight, of two doubts."""
    network = TemporalNetwork((8, 8))
    with torch.no_grad():
        network.head.bias.copy_(torch.tensor(logits).repeat_interleave(4))
    return network


def test_a_still_untrained_is_the_mean_of_both_ways() -> None:
    model = create_model(NAME, threads=1)
    frame = frame_of(24, 40)
    noisy, clean = (Oidn("high", auxiliary, threads=1)(frame)[0].image for auxiliary in ("noisy", "clean"))
    output, _ = model(frame)
    samples = math.exp(-8 * math.tanh(5 / 8))
    # Normals at random are no exact ones.
    expected = (noisy + clean + samples * frame.color) / (2 + samples)
    torch.testing.assert_close(output.image, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(output.stages["oidn"], noisy)
    torch.testing.assert_close(output.stages["oidn_clean"], clean)


@pytest.mark.parametrize("exact", [0.0, 1.0])
def test_weights_written_out_in_float64(exact: float) -> None:
    logits = (0.3, -0.7, 1.1, 2.2, -1.5, -2.5)
    height, width = 9, 18
    frame = given(height, width).to(torch.float64)
    same = torch.rand(1, 1, height, width, dtype=torch.float64)
    extra = {**frame.extra, PREVIOUS_WEIGHT: same, EXACT: torch.full_like(same, exact)}
    frame = frame.replace(extra=extra)
    image = forced(*logits).double()(frame)[0].image
    p = 8 * torch.tanh(torch.tensor(logits, dtype=torch.float64) / 8)
    parts = torch.softmax(torch.stack([p[0], p[1] + math.log(3) * exact, p[2]]), 0)
    exposure = oidn_exposure(frame.color).item()
    now, clean, noisy = (each[0] * exposure for each in (frame.color, extra[CLEAN], extra[NOISY]))
    before = extra[PREVIOUS_LIGHT if exact else PREVIOUS][0] * exposure
    mean = (now + clean) / 2

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
        logarithm = p[3]
        for doubt, window, least in ((p[4], 3, 4), (p[5], 15, 12)):
            a, b, count = (
                over(part * same[0], row, column, window) for part in (before, mean, torch.ones_like(same[0]))
            )
            change = (a - b).abs().mean() / ((a + b).mean() / 2 + 0.01 * count + 1e-6)
            logarithm = logarithm - least * torch.exp(doubt) * change / noise
        n = same[0, 0, row, column] * torch.exp(logarithm)
        here = (parts[:, None] * torch.stack([each[:, row, column] for each in (now, clean, noisy)])).sum(0)
        expected = (here + n * before[:, row, column]) / (1 + n) / exposure
        torch.testing.assert_close(image[0, :, row, column], expected)


@pytest.mark.parametrize("index", range(4))
def test_it_can_give_each_of_what_it_weighs(index: int) -> None:
    frame = given()
    logits = [-50.0] * 6
    logits[index] = 50
    if index == 3:
        frame = frame.replace(extra={**frame.extra, PREVIOUS: (frame.color + frame.extra[CLEAN]) / 2})
    image = forced(*logits)(frame)[0].image
    wanted = frame.color if index == 0 else frame.extra[(CLEAN, NOISY, PREVIOUS)[index - 1]]
    # Logarithms are at least -8, and images differ by less than 2.
    torch.testing.assert_close(image, wanted, rtol=0, atol=2 * math.exp(-8))


def test_an_image_of_another_surface_weighs_nothing_whatever_is_predicted() -> None:
    frame = given(weight=0.0)
    network = forced(0, 0, 0, 50, -50, -50)
    other = frame.replace(extra={**frame.extra, PREVIOUS: torch.full_like(frame.color, 1e4)})
    assert torch.equal(network(frame)[0].image, network(other)[0].image)


def test_light_that_has_moved_on_counts_little() -> None:
    """A highlight of the frame before, which is elsewhere now: the surface is the same, and its light is not."""
    frame = given(32, 48)
    now = torch.full_like(frame.color, 0.2)
    before = now.clone()
    before[..., 10:16, 10:16] = 5
    extra = {**frame.extra, CLEAN: now, NOISY: now, PREVIOUS: before, PREVIOUS_LIGHT: before}
    image = TemporalNetwork((8, 8))(frame.replace(color=now, extra=extra))[0].image
    # Of what would be ten parts of 5 in eleven.
    assert image.max() < 0.2001


def test_a_gradient_reaches_every_weight_and_none_is_asked_of_oidn() -> None:
    model = small(NAME, threads=1).train()
    torch.nn.init.normal_(model.inner.inner.inner.head.weight, std=0.1)  # type: ignore[attr-defined]
    state = None
    for seed in range(2):
        output, state = model(whole_frame(model, 24, 40, seed=seed), state)
    output.image.sum().backward()
    for name, weight in model.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.isfinite().all(), name
        assert weight.grad.abs().max() > 0, name
    frame = whole_frame(model, 24, 40)
    color = frame.color.requires_grad_()
    assert "the library has no derivatives" in refused(lambda: model(frame.replace(color=color)))


def test_gradients_of_the_network_in_float64() -> None:
    torch.manual_seed(2)
    network = TemporalNetwork((6, 8)).double()
    torch.nn.init.normal_(network.head.weight, std=0.02)
    frame = given(9, 10).to(torch.float64)

    def image(previous: Tensor, bias: Tensor) -> Tensor:
        handed = frame.replace(extra={**frame.extra, PREVIOUS: previous})
        return torch.func.functional_call(network, {"head.bias": bias}, (handed,))[0].image

    inputs = (frame.extra[PREVIOUS].clone().requires_grad_(), network.head.bias.detach().clone().requires_grad_())
    assert torch.autograd.gradcheck(image, inputs, atol=1e-6, fast_mode=True)


def test_tiles_are_the_whole_image_which_oidn_sees() -> None:
    whole = Denoiser(small(NAME, threads=1))
    tiles = Denoiser(small(NAME, threads=1), tile=64)
    for seed in range(2):
        frame = whole_frame(whole.model, 200, 330, seed=seed)
        torch.testing.assert_close(tiles(frame), whole(frame), rtol=1e-4, atol=1e-4)
    assert "tiles" in tiles.report.tiles


@pytest.mark.parametrize("names", [(), ("albedo",), ("albedo", "normal"), ("normal", "depth"), ("motion",)])
def test_without_features(names: tuple[str, ...]) -> None:
    denoiser = Denoiser(small(NAME, threads=1))
    for seed in range(2):
        frame = whole_frame(denoiser.model, 24, 40, seed=seed)
        image = denoiser(Frame(frame.color, **{name: frame.buffer(name) for name in names}))
        assert image.isfinite().all()
        assert image.min() >= 0


def test_a_copy_has_a_library_of_its_own() -> None:
    model = small(NAME, threads=1, quality="fast")
    other = copy.deepcopy(model)
    frame = whole_frame(model, 24, 40)
    assert other._oidn is not model._oidn
    assert (other._oidn.quality, other._oidn.threads) == ("fast", 1)
    assert torch.equal(other(frame)[0].image, model(frame)[0].image)


def test_without_the_package_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    assert "pip install 'mcdenoise[oidn]'" in refused(lambda: create_model(NAME))


def plane(offsets: Tensor) -> Frame:
    """A plane seen through a point of each pixel: the inverse of its depth is linear in the image."""
    rows, columns = torch.meshgrid(torch.arange(40.0), torch.arange(60.0), indexing="ij")
    inverse = 0.2 + 0.004 * (columns + offsets[0]) + 0.003 * (rows + offsets[1])
    normal = torch.tensor([0.6, 0.0, -0.8]).reshape(1, 3, 1, 1).expand(1, 3, 40, 60)
    return Frame(torch.rand(1, 3, 40, 60), normal=normal, depth=(1 / inverse)[None, None])


def test_features_are_exact_of_rays_through_the_centers_alone() -> None:
    exact = plane(torch.zeros(2, 40, 60))
    assert has_exact_features(exact)
    # As files in half precision have it.
    assert has_exact_features(exact.replace(depth=exact.depth.half().float()))
    assert not has_exact_features(plane(torch.rand(2, 40, 60)))
    mixed = exact.normal.clone()
    mixed[..., ::10] *= 0.8
    assert not has_exact_features(exact.replace(normal=mixed))
    specks = exact.normal.clone()
    specks[..., 5::10, 5::10] *= -1
    assert not has_exact_features(exact.replace(normal=specks))
    # The edges of what is in front are none.
    edges = exact.normal.clone()
    edges[..., 10:30, 20:50] *= -1
    assert has_exact_features(exact.replace(normal=edges))
    assert not has_exact_features(exact.replace(depth=None))
    assert not has_exact_features(exact.replace(normal=None))


@pytest.mark.parametrize("exact", [False, True])
def test_the_network_is_told_whether_features_are_exact(exact: bool) -> None:
    frame = plane(torch.zeros(2, 40, 60) if exact else torch.rand(2, 40, 60)).replace(albedo=torch.rand(1, 3, 40, 60))
    told = AfterOidn(Noisy(), threads=1).before(frame).extra[EXACT]
    assert torch.equal(told, torch.full_like(told, float(exact)))


def test_training_sees_what_the_whole_model_sees(small_sequence: Path, tmp_path: Path) -> None:
    model = small(NAME, threads=1)
    assert isinstance(model, AfterOidn)
    front, rest = split(model)
    sequence = open_sequence(small_sequence)
    features = {"albedo", "normal", "depth", "motion", "position", "view_projection"}
    (shot,) = open_cached(sequence, tmp_path, front=front, features=features, firsts=[0]).shots
    output = unroll(rest, Clip.of(shot.read()))
    state = None
    for t, number in enumerate(sequence.numbers):
        expected, state = model(sequence.frame(number).validate()[0], state)
        # Motion is kept in half precision where nothing is lost by that, and computed of positions otherwise.
        torch.testing.assert_close(output.image[:, t], expected.image, rtol=2e-3, atol=2e-3)


@pytest.mark.skipif(NAME not in pretrained_models(), reason="there are no weights yet")
def test_with_its_weights_it_is_ahead_of_oidn(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    denoiser, oidn = Denoiser(NAME, threads=1), [Denoiser("oidn", auxiliary=each) for each in ("noisy", "clean")]
    errors = torch.zeros(3)
    for number in sequence.numbers:
        frame = sequence.frame(number)
        assert frame.reference is not None
        for index, each in enumerate([denoiser, *oidn]):
            errors[index] += smape_linear(each(frame.replace(reference=None)), frame.reference).mean()
    assert errors[0] < errors[1:].min()


def test_refuses_what_is_no_setting() -> None:
    assert "quality: expected one of fast, balanced, high" in refused(lambda: create_model(NAME, quality="best"))
