"""Kernel prediction at one scale, the paper's baseline "KP": MRKP's U-Net and one larger kernel per pixel.

After Bako et al. 2017, "Kernel-predicting convolutional networks for denoising Monte Carlo renderings", whose kernels
are normalised by a softmax. The paper (doi:10.1007/s00371-023-02951-6) uses the backbone of MRKP and a larger kernel,
so that the run time is about that of its own network, but does not state the size. It is 13 here: at 320x180 on one
thread of a busy processor, a frame took 1.0 s with 13, 1.5 s with 17 and 1.1 s by `cascaded`, measured once after a
first frame; 15 was not measured. Network input and wrappers are the same as for `mrkp`.
"""

from __future__ import annotations

from torch import nn

from mcdenoise.frame import Frame
from mcdenoise.models._interface import GUIDES, Needs, Output, State
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._published import Network, check_odd, published
from mcdenoise.models._registry import register_model
from mcdenoise.models.mrkp import Backbone, with_glorot
from mcdenoise.ops import cross_bilateral_filter


class KpNetwork(Network):
    """Predicts a kernel for each pixel, and filters with it.

    Args:
        width: channels of every convolution, 48.
        kernel_size: k of the kernels, odd.

    Raises:
        InputError: a setting is out of its range.
    """

    def __init__(self, width: int = 48, kernel_size: int = 13) -> None:
        super().__init__()
        check_odd(kernel_size)
        self.unet = Backbone(10, width)
        self.head = with_glorot(nn.Conv2d(self.unet.out_channels, kernel_size**2, 3, padding=1))
        # A pixel for the head.
        reach = self.unet.reach() + 1 + kernel_size // 2
        self.needs = Needs(uses=GUIDES, reach=reach, stride=self.unet.multiple)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        logits = self.head(self.unet(self.input_of(frame, frame.color))[0])
        # Without guides this is a filter with the softmax of the logits, and it needs no extra tensor for the weights.
        filtered = cross_bilateral_filter(with_carried(frame), logits, [], [], normalize="softmax")
        return answered(frame, filtered), None


kp = register_model(
    "kp",
    "one larger kernel at full resolution, as the paper compares with",
    kind="kernel",
    paper="after Bako et al. 2017",
)(published(KpNetwork))
