"""A wrapper that provides a method with Open Image Denoise's images of each frame.

The library has to be told whether albedo and normal have noise. It has one network for noisy features and one for clean
ones; where features have noise, its documentation recommends to denoise them first and to use the second network.

It does not remove noise that neighbouring pixels share, which a film's filter causes if it adds each sample to several
pixels. Every second pixel of every second row shares hardly any. So such a frame is denoised as four images of half the
size, as in Zhou et al. 2020, "When AWGN-based Denoiser Meets Real Noises", AAAI (pixel-shuffle down-sampling). Put
together they differ by a pattern of two by two pixels, which a small bilateral filter removes.

A single bright pixel is light that few paths have found. Clamping it would take up to a fifth of the light of a frame
with one sample a pixel, and more error than it saves.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.errors import check_choice
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Output, State
from mcdenoise.models._precision import fastest_precision
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.oidn import Filters, Oidn, Quality
from mcdenoise.models.oidn_open import OpenFilters
from mcdenoise.models.tiled import with_border, without_border
from mcdenoise.noise import noise_is_spread
from mcdenoise.ops import cross_bilateral_filter
from mcdenoise.sampling import has_centred_features, has_scattered_features

Engine = Literal["auto", "library", "torch"]
# Keys in ``frame.extra``: OIDN's images for the features as they are and for clean ones, the clean albedo, and the
# frame's radiance.
OIDN, OIDN_CLEAN, OIDN_ALBEDO, NOISY = "oidn", "oidn_clean", "oidn_albedo", "noisy"
CENTRED = "centred"  # 1 in every pixel if the features come from rays through the pixels' centres, else 0
# The binomial kernel is zero at the frequencies of every pattern of two by two pixels. Falloff of its weights for the
# squared difference of logarithms, and darkest color that matters, relative to the mean (on 15 stills of the training
# data falloffs of 10 to 300 differ by 0.0008 in SMAPE).
_BINOMIAL, _FALLOFF, _DARKEST = (0.25, 0.5, 0.25), 30.0, 0.01


class WithOidn(Wrapper):
    """Provides a method with Open Image Denoise's images of each frame.

    The method finds them in ``frame.extra``, ``(B, 3, H, W)`` each: ``oidn`` for features treated as noisy;
    ``oidn_clean`` for features treated as clean, which OIDN denoises first if they have noise; ``oidn_albedo``, the
    albedo of these features; ``noisy``, the frame's radiance, for later methods of a chain; and ``centred``
    ``(B, 1, H, W)``, 1 or 0, see :func:`mcdenoise.sampling.has_centred_features`. Both images are also stages of the
    output. OIDN always takes the whole image with a mirrored border, or, if its noise is correlated
    (:func:`mcdenoise.noise.noise_is_spread`), four images of half the size.

    Features without noise, which come from the pixels' centres without a scattered ray
    (:func:`mcdenoise.sampling.has_scattered_features`), are taken as they are, which takes half the time and keeps
    textures of single pixels: ``oidn_clean`` is for them, and ``oidn_albedo`` is the frame's.

    Args:
        inner: any method.
        quality: see :class:`mcdenoise.models.oidn.Oidn`.
        threads: likewise.
        engine: "library", or "torch" for the same networks in torch
            (:class:`mcdenoise.models.oidn_open.OpenFilters`): they take half the time where the processor has bfloat16,
            and have derivatives; ``threads`` does not apply to them. "auto" is torch for frames that are denoised in
            bfloat16 on a machine where that is fastest, else the library.
        prefilter: quality of the filters that denoise the features. Those of high quality take two and a half times as
            long as the others; on frames of Cycles they improve ``oidn_clean`` by one to two percent.
        clean: whether to provide ``oidn_clean``, which takes most of the time. Without it, ``oidn_albedo`` is provided
            only if the features have no noise.

    Raises:
        InputError: ``engine`` or ``prefilter`` is none of these; otherwise as of
            :class:`mcdenoise.models.oidn.Oidn`.
    """

    whole = True
    takes = frozenset({"albedo", "normal"})
    gives = frozenset({OIDN, OIDN_CLEAN, OIDN_ALBEDO, NOISY, CENTRED})

    def __init__(
        self,
        inner: Model,
        *,
        quality: Quality = "high",
        threads: int | None = None,
        engine: Engine = "auto",
        prefilter: Quality = "high",
        clean: bool = True,
    ) -> None:
        super().__init__(inner)
        check_choice("engine", engine, Engine)
        check_choice("prefilter", prefilter, Quality)
        self.quality, self.threads, self.engine = quality, threads, engine
        self.prefilter, self.clean = prefilter, clean
        self._library = Oidn(quality, threads=threads)
        self._filters = self._made_in_torch() if engine == "torch" else None

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """None, because the statistics of the inner method may depend on OIDN's images."""
        return {}

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`.

        Raises:
            InputError: a derivative in the color is requested from the library.
        """
        handed = self.before(frame)
        output, state = self.inner(handed, state)
        stages = {name: handed.extra[name] for name in (OIDN, OIDN_CLEAN) if name in handed.extra}
        return output._replace(stages={**stages, **output.stages}), state

    def before(self, frame: Frame) -> Frame:
        """The frame with OIDN's images added."""
        oidn = self._faster()
        centred, spread = has_centred_features(frame), noise_is_spread(frame.color, frame.albedo, frame.normal)
        given = Frame(frame.color, albedo=frame.albedo, normal=frame.normal)
        given = given.map(_phases) if spread else given
        # The networks take what is beyond an image as black.
        given = given.map(with_border)
        exact = centred and not has_scattered_features(frame)
        images = {OIDN: (noisy := oidn.denoised(given, "noisy"))}
        clean = given if exact or not self.clean else oidn.with_clean_features(given, self.prefilter)
        if self.clean:
            # OIDN takes no normal without an albedo; then both images are the same.
            images[OIDN_CLEAN] = noisy if given.albedo is None else oidn.denoised(clean, "clean")
        if clean.albedo is not None and (exact or self.clean):
            images[OIDN_ALBEDO] = clean.albedo
        images = {name: without_border(image) for name, image in images.items()}
        if spread:
            images = {name: _without_pattern(_merged(image, frame.size)) for name, image in images.items()}
        images |= {NOISY: frame.color, CENTRED: torch.full_like(frame.color[:, :1], float(centred))}
        return frame.replace(extra={**frame.extra, **images}, skip=None)

    @property
    def has_network(self) -> bool:
        """Whether frames that are denoised in bfloat16 are denoised by networks in torch."""
        automatic = self.engine == "auto" and fastest_precision(torch.device("cpu")).precision == "bfloat16"
        return self.engine == "torch" or automatic

    def _faster(self) -> Filters:
        """The library, or its networks in torch, which are loaded for the first frame that is denoised by them."""
        if self._filters is None and torch.is_autocast_enabled("cpu") and self.has_network:
            self._filters = self._made_in_torch()
        rounded = self.engine == "torch" or torch.is_autocast_enabled("cpu")
        return self._filters if self._filters is not None and rounded else self._library

    def _made_in_torch(self) -> OpenFilters:
        made = OpenFilters(self.quality, prefilter=self.prefilter if self.clean else None)
        # As a denoiser prepares the networks that are there when it is made.
        return made.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def _phases(image: Tensor) -> Tensor:
    """The four images ``(4 B, C, ceil(H / 2), ceil(W / 2))`` of every second pixel of every second row."""
    height, width = image.shape[-2:]
    phases: Tensor = F.pixel_unshuffle(F.pad(image, (0, width % 2, 0, height % 2), mode="replicate"), 2)
    images: Tensor = phases.unflatten(1, (-1, 4)).transpose(1, 2).flatten(0, 1)
    return images


def _merged(phases: Tensor, size: tuple[int, int]) -> Tensor:
    """The opposite of :func:`_phases`."""
    image: Tensor = F.pixel_shuffle(phases.unflatten(0, (-1, 4)).transpose(1, 2).flatten(1, 2), 2)
    return image[..., : size[0], : size[1]]


def _without_pattern(image: Tensor) -> Tensor:
    """The image ``(B, 3, H, W)`` without any pattern of two by two pixels, and with its edges."""
    # This imports all of kornia, which takes as long as denoising a frame.
    from kornia.filters import filter2d_separable

    kernel = torch.tensor([_BINOMIAL], dtype=image.dtype, device=image.device)
    blurred = filter2d_separable(image, kernel, kernel, "replicate")
    # The guide is the logarithm of the blurred image, so that the weights have no pattern.
    guide = (blurred + _DARKEST * blurred.mean(dim=(1, 2, 3), keepdim=True) + 1e-9).log()
    logits = (kernel.mT * kernel).log().reshape(1, 9, 1, 1).expand(len(image), -1, *image.shape[-2:])
    return cross_bilateral_filter(image, logits, [guide], [torch.full_like(image[:, :1], _FALLOFF)])
