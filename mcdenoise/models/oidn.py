"""Intel Open Image Denoise through the package ``pyoidn``, with all of its settings, for comparisons.

https://www.openimagedenoise.org, Apache License 2.0; optional, ``pip install 'mcdenoise[oidn]'``.
"""

from __future__ import annotations

import math
import weakref
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from mcdenoise.errors import InputError, check_choice, import_optional
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._registry import register_model
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.chain import Chain
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.noisy import Noisy, accumulated
from mcdenoise.models.tiled import MIRRORED
from mcdenoise.ops._numbers import unit_of
from mcdenoise.ops._window import mirrored

Quality = Literal["fast", "balanced", "high"]
Auxiliary = Literal["noisy", "clean", "prefiltered"]
Source = Literal["raw", "accumulated", "demodulated", "accumulated after"]


# Mean radiance below which an image is brightened for the library.
_DIM = 1e-4


class Filters(nn.Module):
    """Open Image Denoise's filters on frames, whatever runs them.

    Args:
        quality: see :class:`Oidn`.
    """

    def __init__(self, quality: Quality) -> None:
        super().__init__()
        self.quality = quality
        # The result depends on the whole image through its exposure.
        self.needs = Needs(uses=frozenset({"albedo", "normal"}), trainable=False)

    def denoised(self, frame: Frame, auxiliary: Auxiliary) -> Tensor:
        """The denoised color ``(B, 3, H, W)``.

        Args:
            frame: uses color, albedo and normal.
            auxiliary: see :class:`Oidn`.
        """
        if auxiliary == "prefiltered":
            frame = self.with_clean_features(frame, "high")
        images = {"color": frame.color, **guides_of(frame)}
        return self.filtered(images, self.quality, clean=auxiliary != "noisy").to(frame.color.dtype)

    def with_clean_features(self, frame: Frame, quality: Quality) -> Frame:
        """The frame with denoised albedo and normal, each denoised by itself.

        Args:
            frame: any.
            quality: of these filters; fast and balanced use the same network.
        """
        guides = guides_of(frame).items()
        clean = {name: self.filtered({name: image}, quality, clean=False).to(image.dtype) for name, image in guides}
        return frame.replace(**clean)

    def filtered(self, images: dict[str, Tensor], quality: Quality, *, clean: bool) -> Tensor:
        """Run one filter.

        Args:
            images: ``(B, 3, H, W)`` each: color with or without features, or a single feature.
            quality: see :class:`Oidn`.
            clean: whether the features of a color count as clean.

        Returns:
            ``(B, 3, H, W)``: the filtered color or feature.
        """
        raise NotImplementedError


class Oidn(Filters):
    """Open Image Denoise on the CPU, applied to the frame's color; device, filters and buffers are kept between frames.

    Filters are created when they are first needed, and again when the image size changes. There are no derivatives.

    Args:
        quality: selects the network. With noisy features, high uses the same network as balanced; otherwise a larger
            one.
        auxiliary: what OIDN assumes of albedo and normal: "noisy"; "clean"; or "prefiltered", which denoises each of
            them first at high quality, as the library recommends, and then treats them as clean.
        threads: maximum number of threads; by default the library uses every core.

    Raises:
        InputError: the package ``pyoidn`` is not installed, or a setting is unknown.
    """

    def __init__(
        self, quality: Quality = "high", auxiliary: Auxiliary = "noisy", *, threads: int | None = None
    ) -> None:
        super().__init__(quality)
        check_choice("quality", quality, Quality)
        check_choice("auxiliary", auxiliary, Auxiliary)
        if threads is not None and threads < 1:
            raise InputError(f"threads: expected at least 1, found {threads}")
        self._oidn = _import_oidn()
        self.auxiliary, self.threads = auxiliary, threads
        self._device = self._oidn.Device()
        if threads is not None:
            self._device.set_int("numThreads", threads)
        self._device.commit()
        self._check_device()
        self._filters: dict[tuple[tuple[str, ...], Quality, bool], Any] = {}
        self._images: dict[str, Tensor] = {}
        # Filters must be released before their device, and both before the library.
        weakref.finalize(self, _release, self._filters, self._device)

    def __deepcopy__(self, memo: dict[int, Any]) -> Oidn:
        """A new object with the same settings, because a device of the library cannot be copied."""
        return Oidn(self.quality, self.auxiliary, threads=self.threads)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`.

        Raises:
            InputError, RuntimeError: see :meth:`filtered`.
        """
        return Output(self.denoised(frame, self.auxiliary)), None

    def filtered(self, images: dict[str, Tensor], quality: Quality, *, clean: bool) -> Tensor:
        """Run the library's filter, one image of the batch at a time, in float32; see :meth:`Filters.filtered`.

        A dim color is divided by a power of two before it, and its result multiplied. A thin image, with a side below
        16 pixels, gets its mirror image around it.

        Raises:
            InputError: a derivative in the color is requested; it would silently be zero.
            RuntimeError: the library reports an error; the message is the library's.
        """
        if torch.is_grad_enabled() and "color" in images and images["color"].requires_grad:
            raise InputError("oidn: expected a color without gradients, found one with; the library has no derivatives")
        first, unit = next(iter(images.values())), None
        if "color" in images:
            mean = images["color"].detach().mean((1, 2, 3), keepdim=True)
            # The library takes light below 1e-8 for black, whatever its unit.
            if (mean < _DIM).any():
                unit = torch.where(mean < _DIM, unit_of(mean), 1)
                images = {**images, "color": images["color"] / unit}
        # The library takes what is beyond an image for black: a single pixel would lose four fifths of its light.
        margin = MIRRORED * (min(first.shape[-2:]) < MIRRORED)
        images = {name: mirrored(image, (margin, margin), (margin, margin)) for name, image in images.items()}
        batch, _, *size = first.shape
        height, width = (side + 2 * margin for side in size)
        self._resize(height, width)
        denoiser = self._filter(tuple(images), quality, clean)
        results = []
        for index in range(batch):
            for name, image in images.items():
                self._images[name].copy_(image[index].detach().permute(1, 2, 0))
            denoiser.execute()
            self._check_device()
            results.append(self._images["output"].permute(2, 0, 1).to(first.device, copy=True).contiguous())
        result = torch.stack(results)[..., margin : height - margin, margin : width - margin]
        return result if unit is None else result * unit

    def _resize(self, height: int, width: int) -> None:
        if self._images and self._images["output"].shape == (height, width, 3):
            return
        _release_filters(self._filters)
        self._images = {
            name: torch.zeros(height, width, 3, dtype=torch.float32, device="cpu")
            for name in ("color", "albedo", "normal", "output")
        }

    def _filter(self, names: tuple[str, ...], quality: Quality, clean: bool) -> Any:
        key = names, quality, clean
        if key not in self._filters:
            made = self._oidn.Filter(self._device, self._oidn.OIDN_FILTER_TYPE_RT)
            for name in (*names, "output"):
                made.set_image(name, self._images[name], self._oidn.OIDN_FORMAT_FLOAT3)
            made.set_bool("hdr", "color" in names)
            made.set_bool("cleanAux", clean)
            made.set_quality(getattr(self._oidn, f"OIDN_QUALITY_{quality.upper()}"))
            made.commit()
            self._check_device()
            self._filters[key] = made
        return self._filters[key]

    def _check_device(self) -> None:
        message = self._device.get_error()
        if message:
            raise RuntimeError(f"Open Image Denoise: {message}")


@register_model("oidn", kind="peer")
def oidn(
    *,
    quality: Quality = "high",
    auxiliary: Auxiliary = "noisy",
    source: Source = "raw",
    threads: int | None = None,
) -> Model:
    """Intel Open Image Denoise (optional package pyoidn).

    Args:
        quality: see :class:`Oidn`.
        auxiliary: see :class:`Oidn`.
        source: the image to denoise: the frame's color (``"raw"``), the accumulated radiance (``"accumulated"``), or
            the accumulated and demodulated radiance (``"demodulated"``), whose result is remodulated.
            ``"accumulated after"`` denoises the frame's color and accumulates the results, by the same rule but without
            the test for lag, because denoised frames flicker by more than their estimated noise explains.
        threads: see :class:`Oidn`.

    Raises:
        InputError: see :class:`Oidn`.
    """
    check_choice("source", source, Source)
    denoiser = Oidn(quality, auxiliary, threads=threads)
    if source == "accumulated":
        return Chain(accumulated=accumulated(), denoised=denoiser)
    if source == "demodulated":
        return Demodulated(Accumulated(denoiser))
    if source == "accumulated after":
        return Chain(denoised=denoiser, accumulated=Demodulated(Accumulated(Noisy(), lag_threshold=math.inf)))
    return denoiser


def guides_of(frame: Frame) -> dict[str, Tensor]:
    """The features that the library accepts; a normal only together with an albedo."""
    given = {"albedo": frame.albedo, "normal": frame.normal if frame.albedo is not None else None}
    return {name: image for name, image in given.items() if image is not None}


def _import_oidn() -> Any:
    return import_optional("pyoidn", "Open Image Denoise", "oidn")


def library_of_oidn() -> Path:
    """The file of the installed library that contains its weights.

    Raises:
        InputError: the package ``pyoidn`` is not installed, or the file is missing.
    """
    folder = Path(_import_oidn().__file__).parent
    found = sorted(path for path in folder.rglob("*OpenImageDenoise_core*") if path.is_file())
    if not found:
        raise InputError(f"{folder}: expected the library OpenImageDenoise_core, found none")
    return found[0]


def _release_filters(filters: dict[Any, Any]) -> None:
    for made in filters.values():
        made.release()
    filters.clear()


def _release(filters: dict[Any, Any], device: Any) -> None:
    _release_filters(filters)
    device.release()
