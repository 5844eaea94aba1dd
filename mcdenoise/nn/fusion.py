"""The fusion module: learnt weights for replacing the low frequencies of a fine image by a coarse image."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mcdenoise.ops import laplacian_fusion, upsample


class FusionModule(nn.Module):
    """FM of the paper's Fig. 2: predicts the blending weight of Eq. 2 from both images, and blends.

    ``alpha = sigmoid(conv3x3([i_f, U i_c]))``, ``o = i_f - alpha U D i_f + alpha U i_c``. The paper names the module
    and its inputs but not its layers: here it is one convolution.
    """

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(6, 1, 3, padding=1)

    def weight(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """The blending weight ``(B, 1, H, W)`` in (0, 1).

        Args:
            fine: ``(B, 3, H, W)`` i_f, radiance.
            coarse: ``(B, 3, ceil(H / 2), ceil(W / 2))`` i_c, radiance.
        """
        both = torch.cat([fine, upsample(coarse, (fine.shape[-2], fine.shape[-1]))], 1)
        return torch.sigmoid(self.conv(both))

    @staticmethod
    def mean(fine: Tensor, coarse: Tensor, weight: Tensor) -> Tensor:
        """Blend both scales by a weighted mean, for layers and alpha, which must stay between the two inputs.

        Args:
            fine: ``(B, C, H, W)``, any unit.
            coarse: ``(B, C, ceil(H / 2), ceil(W / 2))`` in the same unit.
            weight: ``(B, 1, H, W)`` weight of the coarse image.
        """
        return torch.lerp(fine, upsample(coarse, (fine.shape[-2], fine.shape[-1])), weight.to(fine.dtype))

    def forward(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """Fuse two scales.

        Args:
            fine: ``(B, 3, H, W)`` i_f, radiance.
            coarse: ``(B, 3, ceil(H / 2), ceil(W / 2))`` i_c, radiance.
        """
        return laplacian_fusion(fine, coarse, self.weight(fine, coarse))
