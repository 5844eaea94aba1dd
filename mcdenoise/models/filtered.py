"""A wrapper that denoises noisy albedo and normal before a method: textures and edges as they would be without noise.

The filters are those of Open Image Denoise 2.5 at balanced quality (Intel Corporation, Apache License 2.0). They come
with the package.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeAlias

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor, nn

from mcdenoise.errors import check_choice
from mcdenoise.frame import Frame
from mcdenoise.models._defaults import outlined
from mcdenoise.models._interface import Model, Needs, Note, Output, State, at_hand
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.oidn import FeatureFilter
from mcdenoise.ops import NO_ALBEDO
from mcdenoise.ops._window import accumulator_dtype
from mcdenoise.sampling import has_centred_features, has_scattered_features

Features: TypeAlias = Literal["auto", "clean", "noisy"]
FILTERED = ("albedo", "normal")
_TALL = 512  # height of an image of which some rows tell enough
_WEIGHTS = Path(__file__).parent / "weights" / "filters"


class Filtered(Wrapper):
    """Denoises albedo and normal for a method, each by itself, if they have noise.

    They have none if they come from one ray through the centre of each pixel that nothing scattered
    (:func:`mcdenoise.sampling.has_centred_features`, :func:`mcdenoise.sampling.has_scattered_features`). They stay as
    they are where nothing was hit, and where there is no albedo in 3x3 pixels, such as on emitters.

    Args:
        inner: any method.
        features: whether they are ``"noisy"`` or ``"clean"``, or ``"auto"``, to look at each image. That takes values
            on the host: on a GPU, and in a graph that is compiled or exported, it counts as clean.

    Raises:
        InputError: ``features`` is none of these.
    """

    stage = "filter features"
    takes = frozenset({*FILTERED, "depth"})

    def __init__(self, inner: Model, features: Features = "auto") -> None:
        super().__init__(inner)
        check_choice("features", features, Features)
        self.features = features
        filters = {name: Tiled(FilterOf(name)) for name in FILTERED}
        self.filters, self._reach = nn.ModuleDict(filters), filters["albedo"].needs.reach or 0
        self.filters.eval()

    @property
    def needs(self) -> Needs:
        """The needs of the inner model, which sees as much farther as the filters do."""
        needs = super().needs
        return replace(needs, reach=None if needs.reach is None else needs.reach + self._reach)

    def train(self, mode: bool = True) -> Filtered:
        """The filters are not trained: they see a mirror image around the image, as they always do."""
        super().train(mode)
        self.filters.eval()
        return self

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        kept, reason = self._kept(frame)
        if kept is None:
            return self.inner(frame, state)
        output, state = self.inner(self._filtered(frame, kept), state)
        return output.noted(Note(self.stage, reason)), state

    def _filtered(self, frame: Frame, kept: Tensor) -> Frame:
        changes = {}
        for name, image in ((name, frame.buffer(name)) for name in FILTERED):
            if image is not None:
                clean = self.filters[name](Frame(image.to(accumulator_dtype(image.dtype))))[0].image
                changes[name] = torch.where(kept, image, clean.to(image.dtype))
        return frame.replace(**changes)

    def _kept(self, frame: Frame) -> tuple[Tensor | None, str]:
        """The pixels whose features stay as they are, ``None`` for all; and why others do not."""
        color = frame.color
        if self.features == "clean" or (frame.albedo is None and frame.normal is None):
            return None, ""
        if self.features == "noisy":
            return _nothing(frame), "said to be noisy"
        if not at_hand(color.device) or all(exact := _are_exact(frame)):
            return None, ""
        kept = _nothing(frame) | torch.tensor(exact, device=color.device).reshape(-1, 1, 1, 1)
        return None if kept.all() else kept, "noise"


class FilterOf(nn.Module):
    """The filter of a single feature as a method: the feature takes the place of the color.

    Its weights are constants of the package: neither trained nor saved.

    Args:
        name: "albedo" or "normal".
    """

    stage = "filter features"

    def __init__(self, name: str) -> None:
        super().__init__()
        with outlined():
            self.network = FeatureFilter(name)
        weights = load_file(_WEIGHTS / f"{name}.safetensors")
        for key, layer in self.network.unet.named_modules(remove_duplicate=False):
            for kind in ("weight", "bias") if isinstance(layer, nn.Conv2d) else ():
                delattr(layer, kind)
                layer.register_buffer(kind, weights[f"{key}.{kind}"].float(), persistent=False)
        unet = self.network.unet
        self.needs = Needs(trainable=False, reach=unet.reach, stride=unet.multiple, live=unet.live)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        return Output(self.network(frame.color)), None


def _are_exact(frame: Frame) -> list[bool]:
    """For each image of a batch, as it would be alone, whether its features have no noise."""
    normal, depth = frame.normal, frame.depth
    if normal is None or depth is None:
        return [False] * len(frame.color)
    seen = [Frame(n, normal=n, depth=d) for n, d in zip(_bands(normal), _bands(depth), strict=True)]
    return [has_centred_features(image) and not has_scattered_features(image) for image in seen]


def _bands(image: Tensor) -> list[Tensor]:
    """For each image of a batch eight of 32 rows, as images of their own: they tell as much in a fourth of the time."""
    if (height := image.shape[-2]) < _TALL:
        return list(image.split(1))
    bands = image[..., : height // 32 * 32, :].unflatten(-2, (-1, 32))[..., :8, :]
    return list(bands.transpose(1, 2).unbind())


def _nothing(frame: Frame) -> Tensor:
    """``(B, 1, H, W)`` bool: pixels whose features have no noise, whatever is around them."""
    nothing = torch.zeros_like(frame.color[:, :1], dtype=torch.bool)
    if frame.depth is not None:
        nothing = nothing | (frame.depth == torch.inf)
    if frame.albedo is not None:
        brightest = frame.albedo.detach().amax(1, keepdim=True)
        nothing = nothing | (F.max_pool2d(brightest, 3, 1, 1) < NO_ALBEDO)
    return nothing
