"""The method ``oidn_open``: Open Image Denoise's network in torch. It has derivatives, any device, and can be trained.

The weights come from the user's installation: from the library of the optional package pyoidn, or from an archive
(``.tza``) as exported by the library's training scripts. The result equals the library's up to rounding.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._contract import check_needs
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._journal import timed
from mcdenoise.models._registry import register_model
from mcdenoise.models._tza import Archive, archives_in, read_tza
from mcdenoise.models.oidn import Auxiliary, Oidn, Quality, library_of_oidn
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.oidn import OidnUNet, Size, compress, expand, oidn_exposure

_CHANNELS = 9  # color, albedo, normal
_PROBE = 48  # side of the test image that identifies the library's weights
_CLOSE = 1e-2  # largest difference for the right weights; measured: 2e-5, and 1.4 for others


class OidnOpen(nn.Module):
    """The network, from radiance to radiance.

    Args:
        size: see :class:`mcdenoise.nn.oidn.OidnUNet`.
    """

    def __init__(self, size: Size = "base") -> None:
        super().__init__()
        self.unet = OidnUNet(_CHANNELS, size)

    @property
    def needs(self) -> Needs:
        """Needs color, albedo and normal. It comes with weights, which can be trained further."""
        buffers = frozenset({"color", "albedo", "normal"})
        return Needs(buffers, trainable=False, reach=self.unet.reach, stride=self.unet.multiple)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The exposure of the whole image."""
        return {"oidn_exposure": oidn_exposure(frame.color)}

    def bytes_per_pixel(self, *, bfloat16: bool) -> float:
        """Peak memory per pixel of a tile, see :class:`mcdenoise.models.Tiled`."""
        return self.unet.bytes_per_pixel(bfloat16=bfloat16)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        check_needs(self.needs, frame.buffers)
        assert frame.albedo is not None
        assert frame.normal is not None
        exposure = (frame.statistics or self.statistics(frame))["oidn_exposure"]
        with timed("network", frame.color.device):
            seen = seen_by_oidn(frame.color * exposure, frame.albedo, frame.normal)
            image = expand(self.unet(seen).to(exposure.dtype)) / exposure
        return Output(image.to(frame.color.dtype)), None


def seen_by_oidn(color: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
    """The network's input.

    Args:
        color: ``(B, 3, H, W)`` exposed radiance.
        albedo: ``(B, 3, H, W)`` in [0, 1].
        normal: ``(B, 3, H, W)`` in [-1, 1], in world or camera space.

    Returns:
        ``(B, 9, H, W)``, in [0, 1].
    """
    return torch.cat([compress(color), albedo.clamp(0, 1), normal.clamp(-1, 1) * 0.5 + 0.5], 1)


def load_archive(unet: OidnUNet, archive: Archive, where: str) -> None:
    """Load the weights of an archive into a network, layer by layer.

    Raises:
        InputError: the archive is for another network.
    """
    names = [name.removesuffix(".weight") for name in archive if name.endswith(".weight")]
    layers = unet.convolutions
    if len(names) != len(layers):
        raise InputError(f"{where}: expected {len(layers)} convolutions, found {len(names)}")
    with torch.no_grad():
        for name, layer in zip(names, layers, strict=True):
            weight, own = archive[f"{name}.weight"], tuple(layer.weight.shape)
            if weight.shape != own:
                raise InputError(f"{where}: '{name}': expected weights of shape {own}, found {tuple(weight.shape)}")
            layer.weight.copy_(weight)
            layer.bias.copy_(archive[f"{name}.bias"])  # type: ignore[union-attr]


def _size(quality: Quality, *, clean: bool) -> Size:
    """The network that the library uses for these settings."""
    return "small" if quality == "fast" else "large" if quality == "high" and clean else "base"


@functools.cache
def archive_of_library(quality: Quality = "high", auxiliary: Auxiliary = "noisy") -> Archive:
    """The weights that the installed library uses for HDR color with albedo and normal.

    The library contains them without names; they are identified by comparing a denoised image with the library's own.

    Args:
        quality: see :class:`mcdenoise.models.oidn.Oidn`.
        auxiliary: likewise; "prefiltered" uses the weights of "clean".

    Raises:
        InputError: the package ``pyoidn`` is not installed, or its library has no such weights.
    """
    clean = auxiliary != "noisy"
    generator = torch.Generator().manual_seed(0)
    color, albedo, normal = (torch.rand(1, 3, _PROBE, _PROBE, generator=generator) for _ in range(3))
    frame = Frame(color=color, albedo=albedo, normal=normal)
    wanted = Oidn(quality, "clean" if clean else "noisy", threads=1)(frame)[0].image
    path, model = library_of_oidn(), OidnOpen(_size(quality, clean=clean)).eval()
    for archive in archives_in(path):
        try:
            load_archive(model.unet, archive, str(path))
        except InputError:
            continue
        with torch.no_grad():
            if float((model(frame)[0].image - wanted).abs().max()) < _CLOSE:
                return archive
    raise InputError(f"{path}: expected the weights that the library denoises with, found none")


@register_model("oidn_open", kind="peer", requires="pyoidn")
def oidn_open(*, quality: Quality = "high", auxiliary: Auxiliary = "noisy", archive: Path | str | None = None) -> Model:
    """Open Image Denoise's network in torch: differentiable (weights of the optional package pyoidn, or a .tza file).

    Args:
        quality: see :class:`mcdenoise.models.oidn.Oidn`.
        auxiliary: likewise, except that "prefiltered" is rejected.
        archive: a file of weights (``.tza``) to use instead of the library's, for the network of this quality.

    Raises:
        InputError: the package is not installed, or the file is no such archive.
    """
    if auxiliary == "prefiltered":
        raise InputError("auxiliary: expected noisy or clean, found 'prefiltered'")
    model = OidnOpen(_size(quality, clean=auxiliary == "clean"))
    weights = archive_of_library(quality, auxiliary) if archive is None else read_tza(Path(archive))
    load_archive(model.unet, weights, str(archive or "pyoidn"))
    return Tiled(model)
