"""The method ``oidn_open``: Open Image Denoise's networks in torch, with derivatives, on any device, trainable.

The weights come from the user's installation: from the library of the optional package pyoidn, or from an archive
(``.tza``) as exported by the library's training scripts. The result equals the library's up to rounding, except near
the image's edges: around the image the library sees black, and this network a mirror image.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from mcdenoise.errors import InputError, check_choice
from mcdenoise.frame import Frame
from mcdenoise.models._contract import check_needs
from mcdenoise.models._interface import Model, Needs, Output, State, prepared
from mcdenoise.models._registry import register_model
from mcdenoise.models._tza import Archive, archives_in, read_tza
from mcdenoise.models.oidn import Filters, Oidn, Quality, library_of_oidn
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.oidn import FeatureFilter, OidnUNet, Size, oidn_exposure
from mcdenoise.ops._steps.transfer import compress, expand, seen_by_oidn

_FEATURES = ("albedo", "normal")
_IMAGES = ("color", *_FEATURES)
_PROBE = 48  # side of the test image that identifies the library's weights
_CLOSE = 1e-2  # largest difference for the right weights; measured: 2e-5, and 1.4 for others


class OidnOpen(nn.Module):
    """The network, from radiance to radiance.

    Args:
        size: see :class:`mcdenoise.nn.oidn.OidnUNet`.
        features: the features that it takes: none, albedo, or albedo and normal.
    """

    def __init__(self, size: Size = "base", features: Sequence[str] = _FEATURES) -> None:
        super().__init__()
        self.features = tuple(features)
        self.unet = OidnUNet(3 + 3 * len(self.features), size)
        # It comes with weights, which can be trained further.
        buffers, unet = frozenset({"color", *features}), self.unet
        self.needs = Needs(buffers, trainable=False, reach=unet.reach, stride=unet.multiple, live=unet.live)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The exposure of the whole image."""
        return {"oidn_exposure": oidn_exposure(frame.color)}

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        check_needs(self.needs, frame.buffers)
        exposure = (frame.statistics or self.statistics(frame))["oidn_exposure"]
        features = {name: frame.buffer(name) for name in self.features}
        seen = seen_by_oidn(compress(frame.color * exposure), **features)
        image = expand(self.unet(seen).to(exposure.dtype)) / exposure
        return Output(image.to(frame.color.dtype)), None


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


class OpenFilters(Filters):
    """The library's filters in torch.

    They take half the time in bfloat16 where a processor has it. Their weights are the library's and are not part of a
    method's own. Networks for frames without features are made when they are first needed.

    Args:
        quality: see :class:`mcdenoise.models.oidn.Oidn`.
        prefilter: quality of the networks that will denoise features, which then count as clean; ``None`` for none.

    Raises:
        InputError: see :func:`archive_of_library`.
    """

    def __init__(self, quality: Quality = "high", *, prefilter: Quality | None = "high") -> None:
        super().__init__(quality)
        self.networks = nn.ModuleDict()
        self._network(_IMAGES, quality, clean=False)
        if prefilter:
            self._network(_IMAGES, quality, clean=True)
            for name in _FEATURES:
                self._network((name,), prefilter, clean=False)

    def state_dict(self, *args: Any, destination: Any = None, prefix: str = "", keep_vars: bool = False) -> Any:
        """Nothing: the library has the weights."""
        return {} if destination is None else destination

    def filtered(self, images: dict[str, Tensor], quality: Quality, *, clean: bool) -> Tensor:
        """See :meth:`mcdenoise.models.oidn.Filters.filtered`."""
        device = next(iter(images.values())).device
        return _run(self._network(tuple(images), quality, clean=clean).to(device), images)

    def _network(self, images: tuple[str, ...], quality: Quality, *, clean: bool) -> Any:
        key = "-".join([*images, quality, str(clean)])
        if key not in self.networks:
            made = _made(images, quality, clean)
            load_archive(made.unet, archive_of_library(quality, clean, images), "pyoidn")
            made.eval().requires_grad_(False)
            self.networks[key] = Tiled(made, border=0) if isinstance(made, OidnOpen) else made
        return self.networks[key]


def _made(images: Sequence[str], quality: Quality, clean: bool) -> OidnOpen | FeatureFilter:
    """The network that the library uses for these images, without its weights."""
    if images[0] != "color":
        return FeatureFilter(images[0], "large" if quality == "high" else "base")
    # Its large network is for a color with both features.
    large = quality == "high" and clean and len(images) == len(_IMAGES)
    return OidnOpen("small" if quality == "fast" else "large" if large else "base", images[1:])


def _run(network: Any, images: Mapping[str, Any]) -> Tensor:
    """The result of a network for these images."""
    if "color" not in images:
        return network(*images.values())  # type: ignore[no-any-return]
    return network(prepared(network, Frame(**images)))[0].image  # type: ignore[no-any-return]


@functools.cache
def archive_of_library(quality: Quality, clean: bool, images: tuple[str, ...]) -> Archive:
    """The weights that the installed library uses for HDR color with these features, or for a single feature.

    The library contains them without names; they are identified by comparing a denoised image with the library's own.

    Args:
        quality: see :class:`mcdenoise.models.oidn.Oidn`.
        clean: whether the features of the color count as clean.
        images: names of the images: color, and its features if there are any; or albedo or normal alone.

    Raises:
        InputError: the package ``pyoidn`` is not installed, or its library has no such weights.
    """
    generator = torch.Generator().manual_seed(0)
    probe: dict[str, Any] = {name: torch.rand(1, 3, _PROBE, _PROBE, generator=generator) for name in images}
    wanted = Oidn(quality, threads=1).filtered(probe, quality, clean=clean)
    path, model = library_of_oidn(), _made(images, quality, clean).eval()
    for archive in archives_in(path):
        try:
            load_archive(model.unet, archive, str(path))
        except InputError:
            continue
        with torch.no_grad(), torch.autocast("cpu", enabled=False):
            found = _run(model, probe)
        if float((found - wanted).abs().max()) < _CLOSE:
            return archive
    raise InputError(f"{path}: expected the weights that the library denoises with, found none")


@register_model("oidn_open", kind="peer")
def oidn_open(
    *, quality: Quality = "high", auxiliary: Literal["noisy", "clean"] = "noisy", archive: Path | str | None = None
) -> Model:
    """Open Image Denoise's network in torch: differentiable (weights of the optional package pyoidn, or a .tza file).

    Args:
        quality: see :class:`mcdenoise.models.oidn.Oidn`.
        auxiliary: whether albedo and normal count as noisy or as clean.
        archive: a file of weights (``.tza``) to use instead of the library's, for the network of this quality.

    Raises:
        InputError: a setting is none of these, the package is not installed, or the file is no such archive.
    """
    check_choice("quality", quality, Quality)
    check_choice("auxiliary", auxiliary, Literal["noisy", "clean"])
    clean = auxiliary == "clean"
    model = _made(_IMAGES, quality, clean)
    assert isinstance(model, OidnOpen)
    weights = archive_of_library(quality, clean, _IMAGES) if archive is None else read_tza(Path(archive))
    load_archive(model.unet, weights, str(archive or "pyoidn"))
    return Tiled(model)
