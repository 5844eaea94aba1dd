"""Images of the shipped models for two shots must not change: whole, tiled, and with skipping.

``make.py`` creates the images in float64. The bounds come from the responses of the images to rounding, see
``golden_shots.ALLOWED``. Another test shows that small errors exceed them.
"""

from __future__ import annotations

from typing import Any, Literal

import pytest
import torch
from golden_shots import ALLOWED, MODELS, PRECISIONS, SHOTS, change, golden, kept_pixels
from torch import Tensor

from mcdenoise import Denoiser, create_model

IMAGES, RESPONSES = golden()
Precision = Literal["float32", "bfloat16"]


def denoised(shot: str, denoiser: Denoiser) -> dict[int, Tensor]:
    """The pixels of the frames that the file contains."""
    found = {}
    for number in range(SHOTS[shot].frames):
        image = denoiser(SHOTS[shot].frame(number))
        assert image.dtype == torch.float32
        if number in SHOTS[shot].kept:
            found[number] = kept_pixels(image)
    return found


def beyond(shot: str, model: str, precision: str, images: dict[int, Tensor]) -> list[str]:
    """The frames whose images differ from those in the file by more than rounding."""
    wrong = []
    for index, (number, image) in enumerate(images.items()):
        error = change(image, IMAGES[f"{shot}.{model}.{number}"])
        response = RESPONSES[f"{shot}.{model}.{precision}"][index]
        for what, factor in ALLOWED.items():
            # Everything except convolutions is in float32.
            allowed = factor * max(response[what], torch.finfo(torch.float32).eps)
            if not error[what] <= allowed:
                wrong.append(f"frame {number}: {what} difference {error[what]:.3g}, expected at most {allowed:.3g}")
    return wrong


WAYS: dict[str, tuple[str, dict[str, Any]]] = {
    "whole": ("moving", {}),
    "tiled": ("moving", {"tile": 64}),
    "skipped": ("still", {}),
    "skipped and tiled": ("still", {"tile": 64}),
}


def is_long(way: str, model: str) -> bool:
    """Whether a shot takes long, where a shorter one shows as much."""
    return way in ("tiled", "skipped") or (way == "skipped and tiled" and model == "full")


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(
    ("shot", "settings", "model"),
    [
        pytest.param(*WAYS[way], model, id=f"{way}-{model}", marks=[pytest.mark.slow] if is_long(way, model) else [])
        for way in WAYS
        for model in MODELS
    ],
)
def test_images_agree_with_the_file(shot: str, settings: dict[str, Any], model: str, precision: Precision) -> None:
    denoiser = Denoiser(MODELS[model], precision=precision, **settings)
    assert not beyond(shot, model, precision, denoised(shot, denoiser))


def test_tiles_of_the_still_shot_are_skipped() -> None:
    model = "micro"
    computed = denoised("still", Denoiser(MODELS[model], keep_all=True))
    assert {message.partition(":")[0] for message in beyond("still", model, "float32", computed)} == {
        "frame 9",
        "frame 19",
    }


@pytest.mark.parametrize("precision", PRECISIONS)
def test_small_errors_of_weights_and_histories_are_found(precision: Precision) -> None:
    model = "micro"
    other = create_model(MODELS[model], pretrained=True)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.mul_(1 + (1e-2 if precision == "bfloat16" else 1e-5))
    assert beyond("moving", model, precision, denoised("moving", Denoiser(other, precision=precision)))
    longer = Denoiser(MODELS[model], precision=precision, alpha_min=0.6)
    assert beyond("moving", model, precision, denoised("moving", longer))


def test_the_file_has_every_image_and_is_small() -> None:
    assert set(IMAGES) == {f"{shot}.{model}.{n}" for shot, what in SHOTS.items() for n in what.kept for model in MODELS}
    assert all(image.isfinite().all() and image.dtype == torch.float32 for image in IMAGES.values())
