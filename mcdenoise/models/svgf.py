"""SVGF, a filter without weights that follows the variance of the light.

Schied et al. 2017, "Spatiotemporal Variance-Guided Filtering: Real-Time Reconstruction for Path-Traced Global
Illumination", High Performance Graphics. The paper leaves open the epsilons of its edge-stopping functions (see
:func:`mcdenoise.ops.atrous`), the test of surfaces (here that of :func:`mcdenoise.ops.reproject`), and how a history
begins (here with an average, ``alpha = 1 / n`` until that is less than ``alpha``). As in the authors' published code,
but not in the paper, the spatial estimate of the variance is multiplied by ``4 / n`` for a history of ``n`` frames. It
fades into the temporal one between three and four frames, as bilinear taps blend histories of several lengths.
Direct and indirect light are not separated here, and there is no antialiasing afterwards.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import MOTION, Frame
from mcdenoise.models._contract import check_needs
from mcdenoise.models._history import Past, motion_unless_still, reset_of, surface_before
from mcdenoise.models._interface import Needs, Note, Output, State
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._published import behind
from mcdenoise.models._registry import register_model
from mcdenoise.models._state import own_state
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.ops import accumulate, atrous, luminance_moments, moments_variance
from mcdenoise.ops._window import accumulator_dtype

# With fewer frames, moments over time hardly determine the variance.
_FEW_FRAMES, WINDOW = 4, 7
LEVELS = 5  # of the a-trous transform, whose taps lie 1, 2, 4, ... pixels apart
# Brighter light counts as this in the moments, so that float32 can represent the square.
BRIGHTEST = 1e18


class Svgf(nn.Module):
    """Spatiotemporal variance-guided filtering of Schied et al. 2017, on demodulated light.

    It accumulates light and its moments, and filters it as far as its variance asks for.

    Args:
        alpha: smallest weight of the current frame, of light and of moments, in (0, 1].

    Raises:
        InputError: the weight is out of its range.
    """

    def __init__(self, *, alpha: float = 0.2) -> None:
        super().__init__()
        if not 0 < alpha <= 1:
            raise InputError(f"alpha: expected in (0, 1], found {alpha}")
        self.alpha, self.persistence = alpha, 1 - alpha
        self.needs = Needs(frozenset({"color", "normal", "depth"}), MOTION | {"view_projection"}, trainable=False)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        check_needs(self.needs, frame.buffers)
        # Half precision represents no squares of bright light.
        entering = with_carried(frame).to(accumulator_dtype(frame.color.dtype))
        # Light that was accumulated and filtered once, with layers and alpha; two moments; and the length, in frames.
        past = own_state(state, Past, frame, channels=entering.shape[1] + 3, keeper="svgf")
        reset = reset_of(frame, past)
        light, moments, length = self._accumulate(frame, entering, None if reset else past)
        variance = variance_of(moments, length, frame)
        filtered, kept = light, light
        for level in range(LEVELS):
            filtered, variance = atrous(filtered, variance, frame.normal, frame.depth, step=1 << level)  #  Eqs. 1 and 2
            # Sec. 4.3: the first level feeds the history.
            kept = filtered if level == 0 else kept
        found = None if reset else (length > 1).to(torch.float32).mean()
        output = answered(frame, filtered.to(frame.color.dtype)).noted(Note("history", reset, value=found))
        after = Past.of(frame, torch.cat([kept, moments, length], 1))
        return output._replace(stages={"accumulated": light[:, :3].to(frame.color.dtype)}), after

    def _accumulate(self, frame: Frame, light: Tensor, past: Past | None) -> tuple[Tensor, Tensor, Tensor]:
        """Sec. 4.1: light, moments and length with the history, where there is one."""
        entering = torch.cat([light, luminance_moments(light[:, :3].clamp_max(BRIGHTEST))], 1)
        if past is None:
            return light, entering[:, -2:], torch.ones_like(light[:, :1])
        both, length = self._blend(frame, entering, past, motion_unless_still(frame, past.view_projection)[0])
        return both[:, :-2], both[:, -2:], length

    def _blend(self, frame: Frame, entering: Tensor, past: Past, motion: Tensor | None) -> tuple[Tensor, Tensor]:
        """Light and moments with their history, and its length."""
        before, length = past.image[:, :-1], past.image[:, -1:]
        surfaces = surface_before(frame), past.surface
        return accumulate(entering, before, length, motion, *surfaces, alpha_min=self.alpha)


def variance_of(moments: Tensor, length: Tensor, frame: Frame) -> Tensor:
    """Sec. 4.2: the variance of a sample's luminance, from neighbours where there are few frames.

    Args:
        moments: ``(B, 2, H, W)`` accumulated.
        length: ``(B, 1, H, W)`` over so many frames.
        frame: with the normals and depths of these pixels.
    """
    few = moments_variance(moments, frame.normal, frame.depth, kernel_size=WINDOW) * (_FEW_FRAMES / length)
    variance = torch.lerp(moments_variance(moments), few, (_FEW_FRAMES - length).clamp(0, 1))
    # The error of rounded luminance, by which even light would stop the filter, also that of its layers.
    return variance + (16 * torch.finfo(moments.dtype).eps) ** 2 * moments[:, 1:]


svgf = register_model("svgf", kind="filter", paper="Schied et al. 2017")(behind(Demodulated, Svgf))
