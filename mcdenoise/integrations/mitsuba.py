"""A replacement for ``mi.OptixDenoiser``: the same arguments, every method of the zoo, on CPUs and GPUs.

Dr.Jit and Mitsuba are optional (``pip install 'mcdenoise[render]'``) and imported when a denoiser is constructed.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mcdenoise.denoiser import AskedPrecision, Denoiser
from mcdenoise.errors import InputError, import_optional
from mcdenoise.frame import Frame
from mcdenoise.models import Model

_ROOT = "<root>"
# Color with or without alpha; monochromatic variants render luminance.
_FORMATS = ("Y", "YA", "RGB", "RGBA")
_CHANNELS = {"albedo": 3, "normals": 3, "flow": 2}


class MitsubaDenoiser:
    """A denoiser for Mitsuba 3 with the interface of ``mi.OptixDenoiser`` (Mitsuba 3.9).

    In a script only the line that constructs the denoiser changes. Unlike ``mi.OptixDenoiser``, it runs in every
    variant and on CPUs, and gradients propagate through it if it is called with a ``TensorXf``.

    **Bitmaps** are returned in the pixel format of the noisy layer, as linear float32; a noisy bitmap of another
    component format, or with a display curve, is converted first.

    **Tensors** are returned as tensors of the same shape. They share their memory with torch, except that the scalar
    variants copy the result. In a differentiable variant (``llvm_ad_rgb``, ``cuda_ad_rgb``), derivatives in ``noisy``,
    ``albedo``, ``normals`` and ``flow`` propagate through :func:`drjit.wrap`, in reverse and forward mode, if gradients
    of one of them are enabled; otherwise no graph is built. Decisions of the method are held fixed, see
    ``differentiable`` of :class:`mcdenoise.Denoiser`. The history is a constant: gradients do not reach earlier frames.
    Parameters of a model given by name get no gradients; those of a module that you pass do.

    **Temporal denoising**: this denoiser stores its own history (the accumulated radiance, its length, and the visible
    surfaces) and does not use the image in ``previous_denoised``. That argument only marks the beginning of a shot:
    ``None``, or the noisy image itself (which OptiX requires for the first frame), resets the history; any other image,
    such as the result of the previous call, continues the shot. Pass the frames of a shot in order, each once.

    **Flow** follows the convention of OptiX: it points from a point's position in the previous frame to its current
    position, in pixels, x right and y down, ``previous = current - flow``. (NVIDIA's Falcor negates its motion vectors,
    which point from the current to the previous frame, for OptiX.) Zeros mean that nothing moves.

    **Normals** may be in world space, as the ``aov`` integrator writes them, or in sensor space. ``to_sensor`` is
    accepted and ignored: methods compare normals with each other and with those of the previous frame, and world-space
    normals do not change when the camera turns.

    Invalid values that ``aov`` integrators are known to write are repaired: albedo is clamped to [0, 1] (a rough
    conductor reaches 93), normals to [-1, 1] (reconstruction filters overshoot). Color pixels that are NaN, infinite,
    negative or above 1e16 are replaced, see ``denoiser.report``.

    Args:
        input_size: width and height of every image.
        albedo: whether calls pass an albedo. As with OptiX, buffers that are not declared here are ignored.
        normals: whether calls pass shading normals; unlike with OptiX, these do not require an albedo.
        temporal: whether calls are the frames of a shot, with flow; otherwise each frame is a still.
        denoise_alpha: whether alpha, the second or fourth channel, is denoised; otherwise it is returned unchanged.
        model: as for :class:`mcdenoise.Denoiser`.
        device: device of torch; by default a GPU for the CUDA variants if torch has one, otherwise the CPU.
        precision: as for :class:`mcdenoise.Denoiser`.
        settings: its other arguments (``weights``, ``tile``, ``max_memory``), and settings of the model.

    Attributes:
        denoiser: the :class:`mcdenoise.Denoiser` after the last call; see its ``report``.

    Raises:
        InputError: Mitsuba is not installed, the size is invalid, or :class:`mcdenoise.Denoiser` rejects its arguments.

    Example:
        ::

            import mitsuba as mi
            from mcdenoise.integrations.mitsuba import MitsubaDenoiser

            mi.set_variant("scalar_rgb")
            aovs = {"type": "aov", "aovs": "albedo:albedo,normals:sh_normal", "image": {"type": "path"}}
            scene = mi.load_dict(mi.cornell_box() | {"integrator": aovs})
            mi.render(scene, spp=1)
            film = scene.sensors()[0].film()
            # denoiser = mi.OptixDenoiser(film.size(), albedo=True, normals=True)
            denoiser = MitsubaDenoiser(film.size(), albedo=True, normals=True)
            clean = denoiser(film.bitmap(), albedo_ch="albedo", normals_ch="normals")
    """

    def __init__(
        self,
        input_size: Any,
        albedo: bool = False,
        normals: bool = False,
        temporal: bool = False,
        denoise_alpha: bool = False,
        *,
        model: str | Model | nn.Module | None = None,
        device: torch.device | str | None = None,
        precision: AskedPrecision = "auto",
        **settings: Any,
    ) -> None:
        self._mi, self._dr = (import_optional(name, "MitsubaDenoiser", "render") for name in ("mitsuba", "drjit"))
        self._size = _size(input_size)
        self._declared = {"albedo": albedo, "normals": normals, "flow": temporal}
        self._temporal, self._denoise_alpha = temporal, denoise_alpha
        if device is None:
            cuda = str(self._mi.variant()).startswith("cuda") and torch.cuda.is_available()
            device = "cuda" if cuda else "cpu"
        self.denoiser = Denoiser(model, device=device, precision=precision, **settings)
        if not isinstance(model, nn.Module) and isinstance(self.denoiser.model, nn.Module):
            self.denoiser.model.requires_grad_(False)

    def __call__(self, noisy: Any, *arguments: Any, **named: Any) -> Any:
        """Denoise a tensor or a bitmap.

        For a ``mi.TensorXf`` the arguments are ``(noisy, albedo=None, normals=None, to_sensor=None, flow=None,
        previous_denoised=None)``, all tensors ``(height, width, channels)``; for a ``mi.Bitmap`` they are ``(noisy,
        albedo_ch="", normals_ch="", to_sensor=None, flow_ch="", previous_denoised_ch="", noisy_ch="<root>")``, where
        the names are those of layers in the bitmap.

        Args:
            noisy: radiance with 3 channels, or 1 in monochromatic variants, and an optional alpha channel at the end. A
                bitmap with several layers also contains the other buffers.
            arguments: see above; their meaning is that of ``mi.OptixDenoiser``, except as described for this class.
            named: the same arguments by name.

        Returns:
            Denoised radiance: a tensor of the shape of ``noisy``, or a float32 bitmap with the pixel format of the
            noisy layer. Alpha is included.

        Raises:
            InputError: a declared buffer or a layer is missing, or a buffer has another size, another number of
                channels, or invalid values.
        """
        if isinstance(noisy, self._mi.Bitmap):
            return self._bitmap(noisy, *arguments, **named)
        if self._dr.is_tensor_v(noisy):
            return self._tensors(noisy, *arguments, **named)
        raise InputError(f"noisy: expected a mitsuba.Bitmap or TensorXf, found {type(noisy).__name__}")

    def _bitmap(
        self,
        noisy: Any,
        albedo_ch: str = "",
        normals_ch: str = "",
        to_sensor: Any = None,
        flow_ch: str = "",
        previous_denoised_ch: str = "",
        noisy_ch: str = _ROOT,
    ) -> Any:
        layers = {noisy_ch: noisy}
        if noisy.pixel_format() == self._mi.Bitmap.PixelFormat.MultiChannel:
            layers = self._split(noisy)

        def layer(argument: str, name: str) -> Any:
            if name not in layers:
                found = ", ".join(f"'{each}'" for each in layers)
                raise InputError(
                    f"{argument}: expected the name of a layer of the bitmap, found '{name}' among {found}"
                )
            return layers[name]

        image = layer("noisy_ch", noisy_ch)
        kind = image.pixel_format()
        if kind.name not in _FORMATS:
            raise InputError(
                f"noisy: expected layer '{noisy_ch}' in a pixel format of {', '.join(_FORMATS)}, found {kind.name}; "
                "convert it, or name another layer with noisy_ch"
            )
        names = {"albedo": albedo_ch, "normals": normals_ch, "flow": flow_ch}
        buffers = {name: self._read(layer(f"{name}_ch", ch)) for name, ch in names.items() if ch}
        previous = self._read(layer("previous_denoised_ch", previous_denoised_ch)) if previous_denoised_ch else None
        color = self._read(image)
        buffers = self._checked(color, buffers)
        self._begin(color, previous)
        clean = self._step(self.denoiser, color, buffers, differentiable=False)
        pixels = np.ascontiguousarray(clean.cpu().numpy())
        result = self._mi.Bitmap(pixels, kind)
        result.set_premultiplied_alpha(image.premultiplied_alpha())
        return result

    def _split(self, bitmap: Any) -> dict[str, Any]:
        """The layers of a bitmap by name. ``mi.Bitmap.split`` fails on some that were written to a file and read."""
        places: dict[str, dict[str, int]] = {}
        for place, field in enumerate(bitmap.struct_()):
            name, _, letter = field.name.rpartition(".")
            places.setdefault(name or _ROOT, {})[letter] = place
        pixels, layers = np.array(bitmap), {}
        for name, own in places.items():
            letters = sorted(own, key="RGBXYZA".find)
            kind = "".join(letters)
            form = getattr(self._mi.Bitmap.PixelFormat, kind if kind in _FORMATS else "MultiChannel")
            chosen = [own[letter] for letter in letters]
            layers[name] = self._mi.Bitmap(np.ascontiguousarray(pixels[..., chosen]), form)
        return layers

    def _tensors(
        self,
        noisy: Any,
        albedo: Any = None,
        normals: Any = None,
        to_sensor: Any = None,
        flow: Any = None,
        previous_denoised: Any = None,
    ) -> Any:
        given = {"albedo": albedo, "normals": normals, "flow": flow, "previous_denoised": previous_denoised}
        for name, each in given.items():
            if each is not None and not self._dr.is_tensor_v(each):
                raise InputError(f"{name}: expected a TensorXf like noisy, found {type(each).__name__}")
        # As in Mitsuba, an empty tensor counts as missing.
        given = {name: each for name, each in given.items() if each is not None and len(each)}
        last = given.pop("previous_denoised", None)
        given = {name: each for name, each in given.items() if self._declared[name]}
        color, previous = noisy.torch(), None if last is None else last.torch()
        buffers = self._checked(color, {name: each.torch() for name, each in given.items()})
        self._begin(color, previous)
        if not any(self._dr.grad_enabled(each) for each in (noisy, *given.values())):
            return type(noisy)(self._step(self.denoiser, color, buffers, differentiable=False))
        return self._differentiable(noisy, given)

    def _differentiable(self, noisy: Any, given: Mapping[str, Any]) -> Any:
        """Denoise a frame as a differentiable operation of Dr.Jit."""
        # Dr.Jit may call the function again for forward derivatives, so each call starts from the state before the
        # frame.
        before, after = self.denoiser, []

        def step(color: Tensor, buffers: dict[str, Tensor]) -> Tensor:
            denoiser = copy.copy(before)
            clean = self._step(denoiser, color, buffers, differentiable=True)
            after.append(denoiser)
            return clean

        try:
            clean = self._dr.wrap(source="drjit", target="torch")(step)(noisy, dict(given))
        except RuntimeError as error:
            if isinstance(error.__cause__, InputError):
                raise error.__cause__ from None
            raise
        self.denoiser = after[0]
        self.denoiser.detach()
        return clean

    def _begin(self, noisy: Tensor, previous: Tensor | None) -> None:
        """Reset the history at the beginning of a shot."""
        if not self._temporal:
            self.denoiser.reset(frames=1)
        elif previous is None or torch.equal(previous.nan_to_num(), noisy.nan_to_num()):
            self.denoiser.reset()

    def _step(
        self, denoiser: Denoiser, noisy: Tensor, buffers: Mapping[str, Tensor], *, differentiable: bool
    ) -> Tensor:
        """Denoise ``(H, W, C)`` images, and store the history in ``denoiser``."""
        colors = 3 if noisy.shape[2] > 2 else 1
        color, alpha = _planes(noisy[..., :colors]).expand(-1, 3, -1, -1), _planes(noisy[..., colors:])
        features: dict[str, Any] = {}
        if "albedo" in buffers:
            features["albedo"] = _planes(buffers["albedo"]).clamp(0, 1)
        if "normals" in buffers:
            features["normal"] = _planes(buffers["normals"]).clamp(-1, 1)
        if "flow" in buffers:
            features["motion"] = -_planes(buffers["flow"])
        if alpha.shape[1]:
            features["alpha"] = alpha.clamp(0, 1)
        denoiser.differentiable, denoiser.alpha = differentiable, self._denoise_alpha
        output = denoiser.output(Frame(color, **features), stages=False)
        image = output.image.to(noisy.device)
        if output.alpha is not None:
            alpha = output.alpha.to(noisy.device)
        clean = image if colors == 3 else image.mean(1, keepdim=True)
        return torch.cat([clean, alpha], 1)[0].permute(1, 2, 0).contiguous()

    def _checked(self, noisy: Tensor, buffers: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The declared buffers, after a check of their shapes."""
        width, height = self._size
        sized = f"for images of {width}x{height} (width x height)"
        if noisy.ndim != 3 or noisy.shape[2] not in (1, 2, 3, 4) or noisy.shape[:2] != (height, width):
            raise InputError(
                f"noisy: expected shape ({height}, {width}, 3 or 4) {sized}, found {tuple(noisy.shape)}; make a "
                "denoiser for each size, and give albedo and normals by themselves"
            )
        found = {}
        for name, channels in _CHANNELS.items():
            if not self._declared[name]:
                continue
            if name not in buffers:
                argument = "temporal" if name == "flow" else name
                advice = "; it may be zero" if name == "flow" else ""
                raise InputError(f"{name}: expected, as the denoiser was made with {argument}=True, found none{advice}")
            shape, expected = tuple(buffers[name].shape), (height, width, channels)
            if shape != expected:
                raise InputError(f"{name}: expected shape {expected} {sized}, found {shape}")
            found[name] = buffers[name]
        return found

    def _read(self, bitmap: Any) -> Tensor:
        """``(H, W, C)`` linear float32 pixels."""
        # Mitsuba cannot convert channels without a color meaning, such as vectors; these need no conversion.
        if bitmap.pixel_format() != self._mi.Bitmap.PixelFormat.MultiChannel:
            bitmap = bitmap.convert(component_format=self._mi.Struct.Type.Float32, srgb_gamma=False)
        pixels = torch.from_numpy(np.array(bitmap).astype(np.float32))
        return pixels if pixels.ndim == 3 else pixels[..., None]


def _planes(image: Tensor) -> Tensor:
    return image.permute(2, 0, 1)[None]


def _size(input_size: Any) -> tuple[int, int]:
    # A Dr.Jit vector may have an additional axis for its lanes.
    sizes = np.ravel(np.array(input_size)).tolist()
    if len(sizes) != 2 or any(int(each) != each or each < 1 for each in sizes):
        raise InputError(f"input_size: expected width and height in pixels, found {input_size}")
    return int(sizes[0]), int(sizes[1])
