"""A wrapper with a small network that filters noisy features and predicts how diffuse the light is.

Albedo and normals have noise where renderers average or scatter rays: under a pixel filter, behind glass, on rough
metal, out of focus. A denoised image that is multiplied by such an albedo has its noise again, and guides with noise
keep noise.

Only diffuse light is proportional to the albedo. What a coat or a mirror reflects is not, and dividing it by the albedo
of a texture multiplies the texture into the reflection. So the light is divided by an effective albedo ``e = 1 + m (a -
1)`` between one (m = 0) and the albedo a (m = 1). For ``color = a D + S`` with diffuse light D and reflected light S,
``m / (1 - m) = D / S`` makes ``color / e`` as smooth as D and S.

A history of many frames has less noise and more blur than the frame, and lags behind highlights and reflections. So the
network also predicts how far each pixel trusts it.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from mcdenoise.frame import Frame, Skip
from mcdenoise.models._interface import GUIDES, Model, Needs, Note, Output, State, prepared
from mcdenoise.models._published import Network
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.inputs import FEATURES, features_of, input_of
from mcdenoise.nn.unet import Head, UNet
from mcdenoise.ops import downsample, kernel_conv, upsample
from mcdenoise.ops.demodulation import modulation

# Stages of the network.
NORMAL, DIVISOR, DIFFUSE, HISTORY = "normal", "divisor", "diffuse", "history"
_TAPS = 9
# Initial logits: of the central tap and of the coarser scale, so that features are unchanged; of diffuse light, and of
# the history.
_CENTRE, _COARSER, _DIFFUSE, _HISTORY = 5.0, -5.0, 4.0, 2.0


class FeatureNetwork(Network):
    """Predicts kernels for albedo and normal at three scales and the fraction of each coarser scale, and filters.

    Args:
        width: feature channels at half the resolution; the coarser levels have twice as many.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.unet = UNet(6 + FEATURES, [width, 2 * width, 2 * width], half=True)
        # Kernel and fraction of the coarser scale; for the finest one also those of diffuse light and of the history.
        counts = [_TAPS + 3, *[_TAPS + 1] * (self.unet.scales - 2), _TAPS]
        self.heads = nn.ModuleList(Head(self.unet, scale, count) for scale, count in enumerate(counts))
        for head, count in zip(self.heads, counts, strict=True):
            nn.init.normal_(head.weight, std=0.01)  # type: ignore[arg-type]
            rest = torch.zeros(count)
            rest[_TAPS // 2] = _CENTRE
            rest[_TAPS : _TAPS + 1], rest[_TAPS + 1 : _TAPS + 2], rest[_TAPS + 2 :] = _COARSER, _DIFFUSE, _HISTORY
            with torch.no_grad():
                # A head at half the resolution predicts each channel for 2x2 pixels.
                head.bias.copy_(rest.repeat_interleave(head.side**2))  # type: ignore[operator]
        # Beyond the U-Net head, kernel and interpolation at each scale.
        scales = range(self.unet.scales)
        reach = max(self.unet.reach(scale) + (2 << scale) for scale in scales) + sum(2 << scale for scale in scales)
        uses = GUIDES | {"current", "length"}
        self.needs = Needs(uses=uses, reach=reach, stride=self.unet.multiple, live=self.unet.live)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """The filtered albedo; as stages the filtered normal and divisor of the demodulation, and the fraction m."""
        frame = frame.replace(statistics=frame.statistics or self.statistics(frame))
        albedo, normal, _ = features_of(frame)
        image = frame.color * frame.statistics["exposure"]
        seen = torch.cat([input_of(frame, image), torch.log1p(image * modulation(albedo))], 1)
        # The divisor of lamps and mirrors, whose albedo is zero, is one: it has an average of its own.
        scales = [torch.cat([albedo, normal, modulation(albedo)], 1)]
        for _ in self.heads[1:]:
            scales.append(downsample(scales[-1]))
        filtered = fractions = None
        for level, features, head in reversed(list(zip(self.unet(seen), scales, self.heads, strict=True))):
            predicted = head(level, features.shape[-2:]).to(torch.promote_types(features.dtype, torch.float32))
            fine = kernel_conv(features, torch.softmax(predicted[:, :_TAPS], 1))
            fractions = torch.sigmoid(predicted[:, _TAPS:])
            size = (features.shape[-2], features.shape[-1])
            filtered = fine if filtered is None else torch.lerp(fine, upsample(filtered, size), fractions[:, :1])
        assert filtered is not None
        assert fractions is not None
        albedo, normal, divisor = filtered.split(3, 1)
        stages = {NORMAL: normal, DIVISOR: divisor, DIFFUSE: fractions[:, 1:2], HISTORY: fractions[:, 2:]}
        return Output(albedo, stages), None


class Refined(Wrapper):
    """Gives a method filtered features, and converts demodulated radiance to the signal of the effective albedo.

    With the albedo a of the frame, the filtered albedo b and the predicted fraction m, the method sees
    ``color a / (1 + m (a - 1))``, and its result is multiplied by ``(1 + m (b - 1)) / a``. So after the remodulation by
    a, which an outer :class:`mcdenoise.models.Demodulated` does, the image has the texture of b. Without an albedo,
    both are one. The color is the mean of the frame and its history with the predicted weight of the history.

    Args:
        inner: any method without a state.
        width: see :class:`FeatureNetwork`.
    """

    def __init__(self, inner: Model, width: int = 16) -> None:
        super().__init__(inner)
        self.features = Tiled(FeatureNetwork(width))

    @property
    def needs(self) -> Needs:
        """The needs of both; it depends on statistics of the whole signal."""
        inner, own = self.inner.needs, self.features.needs
        return Needs(inner.buffers | own.buffers, inner.uses | own.uses, True, None, max(inner.stride, own.stride))

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """Those of the feature network."""
        return self.features.statistics(frame)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        refined, _ = self.features(frame.replace(skip=None, layers={}))
        own = torch.ones_like(frame.color) if frame.albedo is None else modulation(frame.albedo)
        diffuse = refined.stages[DIFFUSE]
        into = own / torch.lerp(torch.ones_like(own), own, diffuse)
        out = torch.lerp(torch.ones_like(own), refined.stages[DIVISOR], diffuse) / own
        color = current = frame.color * into
        if frame.current is not None:
            current = frame.current * into
            color = torch.lerp(current, color, refined.stages[HISTORY])
        layers = {name: layer * into for name, layer in frame.layers.items()}
        skip = frame.skip and Skip(frame.skip.mask, {name: image / out for name, image in frame.skip.images.items()})
        features = {"albedo": refined.image, "normal": refined.stages[NORMAL]}
        features = {name: image for name, image in features.items() if name in frame.buffers}
        changed = frame.replace(color=color, current=current, **features, layers=layers, skip=skip, statistics={})
        output, state = self.inner(prepared(self.inner, changed), state)
        return output.lit(lambda image: image * out).noted(Note("refine", "features and history")), state
