"""Features are denoised where they have noise, by the published filters, and are otherwise as they were."""

from __future__ import annotations

import pytest
import torch
from refusals import refused
from toys import Same, Watching, has_oidn

from mcdenoise import Denoiser, Frame
from mcdenoise.export import Step, traced
from mcdenoise.models import Demodulated, Wrapper, create_model
from mcdenoise.models.filtered import Filtered, FilterOf, _are_exact
from mcdenoise.models.oidn import Oidn
from mcdenoise.train.front import Front, split

SIZE = (48, 64)


def plane(noise: float, size: tuple[int, int] = SIZE) -> Frame:
    """A leaning plane with a texture, the sky above it, and a lamp on it; with noise in its features."""
    draws = torch.Generator().manual_seed(0)
    rows = torch.arange(size[0], dtype=torch.float32).reshape(-1, 1).expand(size)
    depth = 8 / (1 + 0.05 * rows)[None, None]
    albedo = torch.full((1, 3, *size), 0.5)
    albedo[..., ::8] = 0.2
    normal = torch.tensor([0.0, 0.6, 0.8]).reshape(1, 3, 1, 1).expand(1, 3, *size)
    albedo = (albedo + noise * torch.randn(albedo.shape, generator=draws)).clamp(0.05, 1)
    normal = torch.nn.functional.normalize(normal + noise * torch.randn(normal.shape, generator=draws), dim=1)
    depth[..., :12, :], albedo[..., :12, :] = torch.inf, 0
    albedo[..., 30:40, 20:30] = 0
    color = torch.rand(1, 3, *size, generator=draws)
    return Frame(color, albedo=albedo, normal=normal * (depth < torch.inf), depth=depth)


def handed(frame: Frame, **settings: object) -> Frame:
    watching = Watching()
    Filtered(watching, **settings).eval()(frame)  # type: ignore[arg-type]
    return watching.frames[0]


@has_oidn
@pytest.mark.parametrize("name", ["albedo", "normal"])
@torch.no_grad()
def test_the_filters_are_those_of_the_library(name: str) -> None:
    image = torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(0))
    expected = Oidn(threads=1).filtered({name: image}, "balanced", clean=False)
    torch.testing.assert_close(FilterOf(name).eval()(Frame(image))[0].image, expected, rtol=1e-3, atol=1e-3)


@torch.no_grad()
def test_noise_of_features_is_removed_and_what_has_none_stays() -> None:
    frame, exact = plane(0.2), plane(0.0)
    found = handed(frame)
    for name in ("albedo", "normal"):
        before, after, true = (each.buffer(name) for each in (frame, found, exact))
        assert (after - true).abs().mean() < 0.5 * (before - true).abs().mean()
        # The sky, and the lamp but for its rim.
        assert torch.equal(after[..., :12, :], before[..., :12, :])
        assert torch.equal(after[..., 31:39, 21:29], before[..., 31:39, 21:29])
    assert found.color is frame.color


@torch.no_grad()
def test_features_without_noise_are_taken_as_they_are() -> None:
    frame = plane(0.0)
    assert handed(frame).albedo is frame.albedo
    assert handed(plane(0.2), features="clean").normal is not None
    assert torch.equal(handed(plane(0.2), features="clean").normal, plane(0.2).normal)  # type: ignore[arg-type]
    assert not torch.equal(handed(frame, features="noisy").albedo, frame.albedo)  # type: ignore[arg-type]
    assert "features: expected" in refused(lambda: Filtered(Same(), features="loud"))  # type: ignore[arg-type]


@torch.no_grad()
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_each_image_of_a_batch_is_looked_at(dtype: torch.dtype) -> None:
    frames = [plane(noise).to(dtype) for noise in (0.2, 0.0)]
    images = (torch.cat(pair) for pair in zip(*(dict(frame.items()).values() for frame in frames), strict=True))
    both = handed(Frame(**dict(zip(dict(frames[0].items()), images, strict=True))))  # type: ignore[arg-type]
    for found, frame in zip(both.albedo.split(1), frames, strict=True):  # type: ignore[union-attr]
        torch.testing.assert_close(found, handed(frame).albedo)
    assert torch.equal(both.albedo[1:], frames[1].albedo)  # type: ignore[index, arg-type]


@torch.no_grad()
def test_a_frame_of_the_sky_alone_is_not_filtered() -> None:
    frame = plane(0.0).crop(slice(0, 12), slice(0, 64))
    assert handed(frame).albedo is frame.albedo


def test_a_graph_takes_features_as_clean() -> None:
    model = Filtered(lambda color, albedo: color * albedo)  # type: ignore[arg-type]
    shown = {"color": torch.ones(1, 3, *SIZE), "albedo": torch.rand(1, 3, *SIZE)}
    for each in (model, Wrapper(model)):
        program = traced(Step(each.eval(), {"color", "albedo"}))
        assert torch.equal(program.module(check_guards=False)(shown, {})[0], shown["albedo"])
        assert not program.state_dict
        assert model.features == "auto"


def test_the_filters_are_constants() -> None:
    model = create_model("wild_large")
    assert isinstance(model, Filtered)
    kept = {*dict(model.named_parameters()), *model.state_dict()}
    assert kept
    assert not any("filter" in name for name in kept)
    model.train()
    assert not any(each.training for each in model.filters.modules())


def test_the_gradient_passes_through_the_filters() -> None:
    frame = plane(0.2)
    albedo = frame.albedo.clone().requires_grad_()  # type: ignore[union-attr]
    (slope,) = torch.autograd.grad(handed(frame.replace(albedo=albedo)).albedo.sum(), albedo)  # type: ignore[union-attr]
    assert slope.isfinite().all()
    assert slope.abs().sum() > 0


def test_a_network_is_trained_on_filtered_features() -> None:
    front, rest = split(create_model("wild_large"))
    assert not any(isinstance(part, Filtered) for part in rest.modules())  # type: ignore[attr-defined]
    of = front.of({"albedo", "depth"})
    assert of.parts["albedo"] == 3
    assert "normal" not in of.parts
    assert "albedo" not in Front().of({"albedo"}).parts
    with torch.no_grad():
        shown = of.begin()(plane(0.2))
        assert torch.equal(shown.albedo, handed(plane(0.2)).albedo)  # type: ignore[arg-type]


def test_the_report_says_what_was_filtered() -> None:
    denoiser = Denoiser("wild_large")
    denoiser(plane(0.2))
    assert denoiser.report.stages["filter features"].reason == "noise"
    denoiser(plane(0.0))
    assert "filter features" not in denoiser.report.stages


class Staged(Same):
    """A network with a layer of this name."""

    def __init__(self) -> None:
        super().__init__()
        self.stage = torch.nn.Conv2d(3, 3, 1)


def test_a_layer_names_no_stage_of_the_report() -> None:
    denoiser = Denoiser(Demodulated(Staged()))
    denoiser(plane(0.0))
    assert "network" in denoiser.report.milliseconds
    assert all(isinstance(name, str) for name in denoiser.report.milliseconds)


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_some_rows_of_a_tall_image_tell_its_noise(noise: float) -> None:
    size = (520, 64)
    tall, clean = plane(noise, size), plane(0.0, size)
    assert _are_exact(tall) == _are_exact(plane(noise)) == [noise == 0]
    both = tall.map(lambda image: image.repeat(2, 1, 1, 1)).replace(normal=torch.cat([tall.normal, clean.normal]))
    assert _are_exact(both) == [noise == 0, True]
