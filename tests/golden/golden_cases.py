"""What is kept of every method for the golden shots: digests of images and gradients, in several ways.

A way takes a denoiser and the frames of a shot, and returns digests by name. It uses the public interface only, so that
the digests prove that a change of the code changes no image.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from golden_shots import MOVING, STILL, Shot
from safetensors import safe_open
from torch import Tensor

from mcdenoise import Denoiser, Frame, create_model
from mcdenoise.frame import RADIANCE
from mcdenoise.models import Model, list_models
from mcdenoise.models._registry import find_model

FILE = Path(__file__).with_name("golden.safetensors")
# Without those that call Open Image Denoise's library.
METHODS = [name for name in list_models() if name not in ("oidn", "oidn_temporal", "oidn_open")]
PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
# The changes in the file are those of two or three roundings. They are random, so the root mean square of those of
# another machine is hardly three times as large. The maximum of a few underestimates the true maximum, but hardly by
# more than a factor of four (as in mcdenoise.check.stability).
ALLOWED = {"largest": 3 * 4, "rms": 3}
# In float64, where rounding, which some derivatives amplify a million times, is far below.
ALLOWED_EXACT = 1e-6
_CELL = 8

Digests = dict[str, Tensor]


def digest(image: Tensor) -> Tensor:
    """Means of cells of 8x8 pixels, and their means with fixed random signs, in float64: every pixel counts."""
    image = image.detach().double()
    height, width = image.shape[-2:]
    signs = torch.randint(0, 2, (height, width), generator=torch.Generator().manual_seed(7)) * 2 - 1
    pair = torch.stack([image, image * signs]).reshape(-1, 1, height, width)
    return torch.nn.functional.avg_pool2d(pair, _CELL, ceil_mode=True).flatten()


def change(found: Tensor, expected: Tensor) -> dict[str, float]:
    """Change of a digest relative to the expected magnitude plus half of the mean magnitude."""
    magnitude = expected.double().abs()
    unit = (magnitude + magnitude.mean() / 2).clamp_min(1e-30)
    relative = (found.double() - expected.double()).abs() / unit
    return {"largest": float(relative.max()), "rms": float(relative.square().mean().sqrt())}


def images(denoiser: Denoiser, frames: list[Frame], kept: dict[int, str]) -> Digests:
    """The images of the kept frames."""
    found = {}
    for number, frame in enumerate(frames[: max(kept) + 1]):
        image = denoiser(frame)
        if number in kept:
            found[kept[number]] = digest(image)
    return found


def batch(denoiser: Denoiser, frames: list[Frame]) -> Digests:
    """A batch of the first two frames, and of the next two in another unit of light."""
    for frame, other in zip(frames[:2], frames[2:4], strict=True):
        image = denoiser(_together(frame, _brighter(other)))
    return {"moving": digest(image[:1]), "batched": digest(image[1:])}


def _together(frame: Frame, other: Frame) -> Frame:
    added = iter([image for _, image in other.items()])
    return frame.replace(layers={}).map(lambda image: torch.cat([image, next(added)]))


def _brighter(frame: Frame) -> Frame:
    light = {name: image * 64 for name, image in frame.items() if name in (*RADIANCE, "samples")}
    return frame.replace(**light, extra={name: image * 64 for name, image in frame.extra.items()})


def layers(denoiser: Denoiser, frames: list[Frame]) -> Digests:
    """Layers and alpha of the second frame; the denoiser was created with ``alpha``."""
    for frame in frames[:2]:
        output = denoiser.output(frame)
    assert output.alpha is not None
    parts = {f"layer {name}": digest(layer) for name, layer in output.layers.items()}
    return {**parts, "alpha": digest(output.alpha)}


def gradients(denoiser: Denoiser, frames: list[Frame]) -> Digests:
    """Derivatives of a projection of the second image in buffers of both frames, and in the weights.

    Derivatives have spikes, which are limited. Of those in the weights, only numbers are kept that do not depend on the
    order of the weights.
    """
    first, second = (frame.replace(layers={}) for frame in frames[:2])
    inputs = {f"first {name}": image for name, image in first.items() if name in (*RADIANCE, "samples")}
    inputs |= {name: image for name, image in second.items() if name not in ("view_projection", "position", "alpha")}
    with torch.enable_grad():
        for image in inputs.values():
            image.requires_grad_()
        denoiser(first)
        image = denoiser(second)
        weight = torch.rand(image.shape, generator=torch.Generator().manual_seed(8))
        (image * weight).sum().backward()  # type: ignore[no-untyped-call]
    found = {
        f"gradient {name}": digest(_limited(image.grad)) for name, image in inputs.items() if image.grad is not None
    }
    found = {name: each for name, each in found.items() if bool(each.any())}
    parameters = list(denoiser.model.parameters()) if isinstance(denoiser.model, torch.nn.Module) else []
    pairs = [(p.detach().double().flatten(), p.grad.double().flatten()) for p in parameters if p.grad is not None]
    if pairs:
        weights, slope = (torch.cat(list(each)) for each in zip(*pairs, strict=True))
        moments = [slope.norm(), slope @ weights, slope @ weights.abs(), slope @ weights.square()]
        found["gradient weights"] = torch.stack(moments)
    return found


def _limited(gradient: Tensor) -> Tensor:
    size = gradient.abs()
    middle = size[size > 0].median() if bool(size.any()) else 1.0
    return gradient / (size + middle)


@dataclass(frozen=True)
class Way:
    """A way to denoise a shot.

    Args:
        run: the digests.
        shot: the shot.
        settings: arguments of the denoiser.
        precision: precision of the convolutions; in ``"float64"``, of everything.
        made: whether its digests are in the file under its name; those of other ways must equal some of these.
    """

    run: Callable[[Denoiser, list[Frame]], Digests]
    shot: Shot = MOVING
    settings: tuple[tuple[str, Any], ...] = ()
    precision: str = "float32"
    made: bool = True


def _shot(kept: dict[int, str]) -> Callable[[Denoiser, list[Frame]], Digests]:
    return lambda denoiser, frames: images(denoiser, frames, kept)


_SHORT = {0: "first", 1: "moving"}
WAYS = {
    "whole": Way(_shot(MOVING.kept)),
    "batch": Way(batch),
    "layers": Way(layers, settings=(("alpha", True),)),
    "gradients": Way(gradients, precision="float64"),
    "tiled": Way(_shot(_SHORT), settings=(("tile", 64),), made=False),
    "bfloat16": Way(_shot(_SHORT), precision="bfloat16", made=False),
    "skipped": Way(_shot(STILL.kept), STILL),
    "skipped, tiled": Way(_shot(STILL.kept), STILL, (("tile", 64),), made=False),
    "skipped, bfloat16": Way(_shot(STILL.kept), STILL, precision="bfloat16", made=False),
}
# Rounding in float32 decides much of their images: small singular values, and limits of a history's length.
EXACT = ("asvgf", "bmfr", "svgf")
# Their images depend on all pixels.
WHOLE = ("accumulated", "anf", "asvgf", "bmfr", "noisy", "nppd", "rae", "svgf")
# The members of a family differ by their sizes: the tests that are not slow are of the smallest one, and one method of
# each kind is tested in all ways.
LARGER, SMALLEST = ("wild", "wild_large"), "wild_small"
KINDS = (SMALLEST, "accumulated", "joint_bilateral", "kpcn", "rae", "sbmc", "svgf")


def ways_of(method: str) -> list[str]:
    """The ways in which a method is tested."""
    # For the others, tiles of a still shot are not skipped.
    skips, learns = method == SMALLEST, find_model(method).kind != "filter"
    return [
        way
        for way, what in WAYS.items()
        if (what.shot is MOVING or skips)
        and (what.precision != "bfloat16" or learns)
        and ("tile" not in dict(what.settings) or method not in WHOLE)
    ]


def is_slow(method: str, way: str) -> bool:
    """Whether the test is not needed each time, because others show as much of most errors."""
    if WAYS[way].shot is STILL:
        return way != "skipped"
    return method in LARGER or (way not in ("whole", "gradients") and method not in KINDS)


def precision_of(method: str, way: str) -> str:
    """The precision in which a method is tested."""
    return "float64" if method in EXACT else WAYS[way].precision


def digests(
    method: str,
    way: str,
    precision: str,
    model: Model | None = None,
    change: Callable[[Tensor], Tensor] = lambda image: image,
    **settings: Any,
) -> Digests:
    """The digests of a method, or of another model.

    Args:
        method: name of the method.
        way: name of the way.
        precision: precision of the convolutions; with ``"float64"`` everything is computed in it, by the reference
            implementations.
        model: the model to use; by default that of the method with its weights.
        change: changes every buffer.
        settings: further arguments of the denoiser and the model.
    """
    what, floats = WAYS[way], precision
    dtype = torch.float64 if precision == "float64" else torch.float32
    frames = [frame.to(dtype).map(change) for frame in what.shot.frames()]
    if precision == "float64":
        model = model or create_model(method, pretrained=True, **settings)
        floats, settings = "float32", {"differentiable": True}
        if isinstance(model, torch.nn.Module):
            model = model.double()
    with torch.no_grad():
        denoiser = Denoiser(model or method, precision=floats, **dict(what.settings), **settings)
        return what.run(denoiser, frames)


def golden() -> tuple[Digests, dict[str, dict[str, dict[str, float]]]]:
    """The digests by ``method: shot: part``, and for each its changes by rounding in each precision."""
    with safe_open(FILE, framework="pt") as file:
        digests = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - a safetensors handle is no dict
        return digests, json.loads(file.metadata()["changes"])
