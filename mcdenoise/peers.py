"""Other ways to denoise, to compare with: Intel Open Image Denoise in each of its settings, and a plain filter.

Every setting is a :class:`Peer`: called with a frame and what our denoiser knows of it, it returns its own image.
"""

from __future__ import annotations

import importlib
import itertools
import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import torch
from kornia.filters import joint_bilateral_blur
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.denoiser import Images
from mcdenoise.errors import InputError
from mcdenoise.history import History
from mcdenoise.models import normalize_depth
from mcdenoise.ops import HistoryLag, demodulate, remodulate

Quality = Literal["fast", "balanced", "high"]
Auxiliary = Literal["noisy", "clean", "prefiltered"]
Source = Literal["raw", "accumulated", "demodulated", "accumulated after"]

QUALITIES: tuple[Quality, ...] = ("fast", "balanced", "high")
AUXILIARIES: tuple[Auxiliary, ...] = ("noisy", "clean", "prefiltered")
SOURCES: tuple[Source, ...] = ("raw", "accumulated", "demodulated", "accumulated after")

# The sweep of the plain filter: on nine 1-spp sequences, a step further on every side lowers the best SMAPE of one by
# 0.8 %, and of no other.
_SIGMA_COLOR = (0.05, 0.1, 0.2, 0.3, 0.5)
_SIGMA_SPACE = (1.5, 2.5, 4.0, 6.0)
# Depths in [0, 1] differ by much less than albedos and normals do: without a scale of its own, depth hardly guides.
_DEPTH_SCALE = 10.0
# kornia unfolds large windows: 25x25 pixels of a 1280x720 image would take more than 20 GB at once. So they go in
# strips, and as few as memory allows, because neighbouring strips share the rows that their windows reach into.
_UNFOLDED_VALUES = 250_000_000


class Peer(Protocol):
    """One setting of another denoiser.

    Args:
        name: of the setting, unique.
        group: the settings that share a row of a short table.
        family: the denoiser whose setting it is.
        remembers: whether its image also depends on the frames before.
    """

    @property
    def name(self) -> str:
        """Of the setting."""
        ...

    @property
    def remembers(self) -> bool:
        """Whether its image also depends on the frames before, so that none may be left out."""
        ...

    @property
    def group(self) -> str:
        """The settings that share a row."""
        ...

    @property
    def family(self) -> str:
        """The denoiser whose setting it is."""
        ...

    def reset(self) -> None:
        """Forget the past: the next frame is the first of a shot."""
        ...

    def __call__(self, frame: Frame, images: Images) -> Tensor:
        """Denoise the next frame of a shot.

        Args:
            frame: its features guide; their values are valid (:meth:`mcdenoise.frame.Frame.validate`).
            images: the noisy and the accumulated image are what a peer may start from.

        Returns:
            ``(B, 3, H, W)`` float32 scene-linear radiance with albedo, on the device of the images.
        """
        ...


class Oidn:
    """Intel Open Image Denoise on the CPU; its device, filters and image buffers are kept and used again.

    Filters are made when they are first needed, and made anew when the size changes.

    Args:
        threads: how many it may use; by default it decides itself, and takes every core.

    Raises:
        InputError: the package ``pyoidn`` is not installed.
    """

    def __init__(self, *, threads: int | None = None) -> None:
        self._oidn = _import_oidn()
        self._device = self._oidn.Device()
        if threads is not None:
            self._device.set_int("numThreads", threads)
        self._device.commit()
        self._check()
        self._filters: dict[tuple[tuple[str, ...], Quality, bool], Any] = {}
        self._buffers: dict[str, Tensor] = {}
        # Filters go before their device, and both before the library does.
        weakref.finalize(self, _release, self._filters, self._device)

    def denoise(
        self,
        color: Tensor,
        albedo: Tensor | None = None,
        normal: Tensor | None = None,
        *,
        quality: Quality = "high",
        clean_aux: bool = False,
    ) -> Tensor:
        """Denoise HDR radiance.

        Args:
            color: ``(B, 3, H, W)`` scene-linear radiance.
            albedo: ``(B, 3, H, W)`` in [0, 1].
            normal: ``(B, 3, H, W)`` in [-1, 1]; without an albedo it is left out, as the library demands.
            quality: which network. Without ``clean_aux``, high is the same network as balanced; with it, high is a
                larger one.
            clean_aux: promise that albedo and normal have no noise.

        Returns:
            ``(B, 3, H, W)`` float32 on the device of ``color``.

        Raises:
            RuntimeError: the library refuses; the message is its own.
        """
        images = {"color": color}
        if albedo is not None:
            images["albedo"] = albedo
            if normal is not None:
                images["normal"] = normal
        return self._run(images, quality, clean_aux)

    def prefiltered(self, frame: Frame) -> Frame:
        """The frame with its albedo and normal denoised one by one, at high quality, as the library recommends."""
        changes = {
            name: self._run({name: image}, "high", False)
            for name, image in (("albedo", frame.albedo), ("normal", frame.normal))
            if image is not None
        }
        return frame.replace(**{name: image.to(frame.color.dtype) for name, image in changes.items()})

    def _run(self, images: dict[str, Tensor], quality: Quality, clean_aux: bool) -> Tensor:
        first = next(iter(images.values()))
        batch, _, height, width = first.shape
        self._resize(height, width)
        denoiser = self._filter(tuple(images), quality, clean_aux)
        results = []
        for index in range(batch):
            for name, image in images.items():
                self._buffers[name].copy_(image[index].permute(1, 2, 0))
            denoiser.execute()
            self._check()
            results.append(self._buffers["output"].permute(2, 0, 1).to(first.device, copy=True).contiguous())
        return torch.stack(results)

    def _resize(self, height: int, width: int) -> None:
        if self._buffers and self._buffers["output"].shape == (height, width, 3):
            return
        _release_filters(self._filters)
        self._buffers = {name: torch.zeros(height, width, 3) for name in ("color", "albedo", "normal", "output")}

    def _filter(self, names: tuple[str, ...], quality: Quality, clean_aux: bool) -> Any:
        key = names, quality, clean_aux
        if key not in self._filters:
            made = self._oidn.Filter(self._device, self._oidn.OIDN_FILTER_TYPE_RT)
            for name in (*names, "output"):
                made.set_image(name, self._buffers[name], self._oidn.OIDN_FORMAT_FLOAT3)
            made.set_bool("hdr", "color" in names)
            made.set_bool("cleanAux", clean_aux)
            made.set_quality(getattr(self._oidn, f"OIDN_QUALITY_{quality.upper()}"))
            made.commit()
            self._check()
            self._filters[key] = made
        return self._filters[key]

    def _check(self) -> None:
        message = self._device.get_error()
        if message:
            raise RuntimeError(f"Open Image Denoise: {message}")


def _history() -> History:
    # Denoised frames flicker, and have no noise that would excuse it: the test for lag would take that for light.
    return History(anti_lag=HistoryLag(math.inf))


@dataclass(frozen=True)
class OidnPeer:
    """Open Image Denoise in one setting.

    Args:
        oidn: runs it; may be shared.
        quality: of the color filter, see :meth:`Oidn.denoise`.
        aux: what is said of albedo and normal: that they may be noisy, that they are clean, or nothing, since they are
            denoised first (and then are clean).
        source: the image to start from: one sample a pixel (``"raw"``), the accumulated radiance, or the accumulated
            radiance divided by the albedo, which the result is multiplied with. ``"accumulated after"`` starts from one
            sample a pixel, and accumulates the results by the rule that makes the accumulated image.
        prefilter: denoises albedo and normal, by default with ``oidn`` and for every call.
        history: accumulates afterwards, where ``source`` says so; without a test for lag, which serves these worse.
    """

    oidn: Oidn
    quality: Quality
    aux: Auxiliary
    source: Source
    prefilter: Callable[[Frame], Frame] | None = None
    history: History = field(default_factory=_history, compare=False, repr=False)

    family = "OIDN"

    @property
    def name(self) -> str:
        """Such as ``OIDN high, clean aux, raw``."""
        return f"OIDN {self.quality}, {self.aux} aux, {self.source}"

    @property
    def group(self) -> str:
        """Quality, and whether and when the image is accumulated; with or without albedo is one of its settings."""
        return f"OIDN {self.quality}, {'accumulated' if self.source == 'demodulated' else self.source}"

    @property
    def remembers(self) -> bool:
        """Only where its own results are accumulated."""
        return self.source == "accumulated after"

    def reset(self) -> None:
        """See :class:`Peer`."""
        self.history.reset()

    def __call__(self, frame: Frame, images: Images) -> Tensor:
        """See :class:`Peer`."""
        color = images.accumulated if self.source in ("accumulated", "demodulated") else images.noisy
        guides = (self.prefilter or self.oidn.prefiltered)(frame) if self.aux == "prefiltered" else frame
        albedo = frame.albedo.to(color.device) if self.source == "demodulated" and frame.albedo is not None else None
        if albedo is not None:
            color = demodulate(color, albedo)
        clean = self.aux != "noisy"
        result = self.oidn.denoise(color, guides.albedo, guides.normal, quality=self.quality, clean_aux=clean)
        if self.source == "accumulated after":
            frame = frame.to(color.device)
            albedo, result = frame.albedo, self.history.update(frame.replace(color=result)).color
        return result if albedo is None else remodulate(result, albedo)


def oidn_peers(*, threads: int | None = None) -> list[Peer]:
    """Open Image Denoise in 36 settings: 3 qualities, 3 ways to treat albedo and normal, 4 of what to start from.

    The same albedo and normal that our networks see. Those that are prefiltered share the prefiltered features of a
    frame, so the first of them on each frame is the slow one: time a single :class:`OidnPeer` instead.

    Args:
        threads: see :class:`Oidn`.

    Raises:
        InputError: the package ``pyoidn`` is not installed.
    """
    oidn = Oidn(threads=threads)
    prefilter = _Once(oidn.prefiltered)
    return [
        OidnPeer(oidn, quality, aux, source, prefilter)
        for source, quality, aux in itertools.product(SOURCES, QUALITIES, AUXILIARIES)
    ]


@dataclass(frozen=True)
class JointBilateral:
    """``kornia.filters.joint_bilateral_blur`` of the accumulated and demodulated image.

    Guided by albedo, normal and depth, as far as the frame has them.

    Args:
        sigma_color: in the guides' space, L2 distance.
        sigma_space: in pixels; the window is twice as far to every side.
    """

    sigma_color: float
    sigma_space: float

    family = "joint bilateral"
    group = family
    remembers = False

    @property
    def name(self) -> str:
        """Such as ``joint bilateral 0.2 4.0``: color, then space."""
        return f"joint bilateral {self.sigma_color} {self.sigma_space}"

    def reset(self) -> None:
        """It has no past."""

    @torch.inference_mode()
    def __call__(self, frame: Frame, images: Images) -> Tensor:
        """See :class:`Peer`."""
        frame = frame.to(images.noisy.device)
        guides = [x for x in (frame.albedo, frame.normal) if x is not None]
        if frame.depth is not None:
            guides.append(normalize_depth(frame.depth) * _DEPTH_SCALE)
        albedo = torch.ones_like(images.noisy) if frame.albedo is None else frame.albedo
        image = demodulate(images.accumulated, albedo)
        # With nothing to guide it, the filter is a plain bilateral one.
        return remodulate(self._blur(image, torch.cat(guides or [image], 1)), albedo)

    def _blur(self, image: Tensor, guide: Tensor) -> Tensor:
        """Strip by strip, each with the rows that its windows reach into."""
        radius = math.ceil(2 * self.sigma_space)
        size = 2 * radius + 1
        height, width = image.shape[-2:]
        values_per_row = image.shape[0] * (image.shape[1] + guide.shape[1]) * width * size**2
        rows = max(1, _UNFOLDED_VALUES // values_per_row)
        strips = []
        for top in range(0, height, rows):
            bottom = min(top + rows, height)
            above, below = max(top - radius, 0), min(bottom + radius, height)
            blurred = joint_bilateral_blur(
                image[..., above:below, :],
                guide[..., above:below, :],
                size,
                self.sigma_color,
                (self.sigma_space, self.sigma_space),
                border_type="replicate",
                color_distance_type="l2",
            )
            strips.append(blurred[..., top - above : bottom - above, :])
        return torch.cat(strips, -2)


def joint_bilateral_peers() -> list[Peer]:
    """The plain filter in 20 settings, up to windows of 25x25 pixels."""
    return [JointBilateral(color, space) for color, space in itertools.product(_SIGMA_COLOR, _SIGMA_SPACE)]


class _Once:
    """A function of a frame whose last result is kept."""

    def __init__(self, function: Callable[[Frame], Frame]) -> None:
        self._function = function
        self._last: tuple[Frame, Frame] | None = None

    def __call__(self, frame: Frame) -> Frame:
        if self._last is None or self._last[0] is not frame:
            self._last = frame, self._function(frame)
        return self._last[1]


def _import_oidn() -> Any:
    try:
        return importlib.import_module("pyoidn")
    except ImportError as error:
        raise InputError(
            "comparing with Open Image Denoise needs pyoidn, which is not installed; pip install 'mcdenoise[peers]'"
        ) from error


def _release_filters(filters: dict[Any, Any]) -> None:
    for made in filters.values():
        made.release()
    filters.clear()


def _release(filters: dict[Any, Any], device: Any) -> None:
    _release_filters(filters)
    device.release()
