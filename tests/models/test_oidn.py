"""Open Image Denoise as its own package calls it, in each of its settings."""

import itertools
import math
from typing import Any

import pytest
import torch
from refusals import refused
from torch import Tensor
from toys import frame_of

from mcdenoise.denoiser import Denoiser
from mcdenoise.frame import Frame
from mcdenoise.models import Accumulated, Demodulated
from mcdenoise.models.noisy import Noisy
from mcdenoise.models.oidn import Oidn
from mcdenoise.ops import demodulate, remodulate


def frame(height: int = 36, width: int = 52, batch: int = 1, seed: int = 0) -> Frame:
    return frame_of(height, width, batch, seed, depth=None, motion=torch.zeros(batch, 2, height, width))


def channels_last(image: Tensor) -> Tensor:
    return image[0].permute(1, 2, 0).contiguous()


def denoised(given: Frame, color: Tensor | None = None, *, quality: str = "high", auxiliary: str = "noisy") -> Tensor:
    model = Oidn(quality, auxiliary, threads=1)  # type: ignore[arg-type]
    return model(given if color is None else given.replace(color=color))[0].image


@pytest.fixture(scope="module")
def pyoidn() -> Any:
    return pytest.importorskip("pyoidn", reason="Open Image Denoise is in the extra mcdenoise[oidn]")


@pytest.mark.parametrize("auxiliary", ["noisy", "clean"])
@pytest.mark.parametrize("quality", ["fast", "balanced", "high"])
def test_equals_the_result_of_the_package(pyoidn: Any, quality: Any, auxiliary: Any) -> None:
    given = frame()
    guides = channels_last(given.albedo), channels_last(given.normal)
    clean = auxiliary == "clean"
    expected = pyoidn.denoise(channels_last(given.color), *guides, hdr=True, clean_aux=clean, quality=quality)
    model = Oidn(quality, auxiliary, threads=1)
    # Twice, with another frame between: filters and buffers are used again.
    for _ in range(2):
        result = model(given)[0].image
        torch.testing.assert_close(channels_last(result), expected, rtol=1e-4, atol=1e-5)
        other = model(given.replace(color=given.color * 2))[0].image
        assert not torch.allclose(other, result)


def test_prefiltered_features_are_the_package_s_own(pyoidn: Any) -> None:
    given = frame()
    filtered = {}
    for name in ("albedo", "normal"):
        image, output = channels_last(given.buffer(name)), torch.zeros(36, 52, 3)
        with pyoidn.Device() as device:
            device.commit()
            with pyoidn.Filter(device, "RT") as one:
                one.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
                one.set_image("output", output, pyoidn.OIDN_FORMAT_FLOAT3)
                one.commit()
                one.execute()
            assert device.get_error() is None
        filtered[name] = output.permute(2, 0, 1)[None]
    expected = denoised(given.replace(**filtered), auxiliary="clean")
    torch.testing.assert_close(denoised(given, auxiliary="prefiltered"), expected, rtol=1e-3, atol=1e-4)
    assert not torch.allclose(denoised(given, auxiliary="clean"), expected, rtol=1e-2, atol=1e-2)


def test_a_normal_without_an_albedo_is_not_used(pyoidn: Any) -> None:
    model, given = Oidn(threads=1), frame(17, 21)
    alone, beside = (model(Frame(given.color, normal=normal))[0].image for normal in (None, given.normal))
    assert torch.equal(beside, alone)


def test_sources(pyoidn: Any) -> None:
    """Two still frames: each source is our accumulation before or after, with or without albedo."""
    frames = [frame(seed=seed) for seed in (0, 1)]
    frames[1] = frames[1].replace(albedo=frames[0].albedo, normal=frames[0].normal)
    results = {}
    for source in ("raw", "accumulated", "demodulated", "accumulated after"):
        denoiser = Denoiser("oidn", source=source, threads=1)
        results[source] = [denoiser(each) for each in frames][-1]
        assert not denoiser.model.needs.trainable
    accumulated = Denoiser("accumulated")
    mean = [accumulated(each) for each in frames][-1]
    last = frames[-1]
    light = denoised(last, demodulate(mean, last.albedo))
    after = Denoiser(Demodulated(Accumulated(Noisy(), lag_threshold=math.inf)))
    expected = {
        "raw": denoised(last),
        "accumulated": denoised(last, mean),
        "demodulated": remodulate(light, last.albedo),
        "accumulated after": [after(each.replace(color=denoised(each))) for each in frames][-1],
    }
    for source, image in expected.items():
        torch.testing.assert_close(results[source], image, rtol=1e-3, atol=1e-4)
    for one, other in itertools.combinations(results.values(), 2):
        assert not torch.allclose(one, other, rtol=1e-2, atol=1e-2)


def test_says_that_it_has_no_derivatives(pyoidn: Any) -> None:
    given = frame()
    given.color.requires_grad_()
    assert "derivatives" in refused(Oidn(threads=1), given)
    with torch.no_grad():
        assert not Oidn(threads=1)(given)[0].image.requires_grad


@pytest.mark.parametrize("size", [(1, 1), (1, 64), (16, 2)])
def test_thin_images_lose_no_light(pyoidn: Any, size: tuple[int, int]) -> None:
    given = Frame(torch.full((1, 3, *size), 0.5))
    # That of 64x64 pixels has 0.9998 of its light.
    assert denoised(given).mean().item() == pytest.approx(0.5, rel=0.01)
