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

    def forward(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """Fuse two scales.

        Args:
            fine: ``(B, C, H, W)`` i_f, radiance, and after it layers and alpha in any unit. These are blended by a
                weighted mean, because they must stay between the two inputs.
            coarse: ``(B, C, ceil(H / 2), ceil(W / 2))`` i_c, likewise.
        """
        weight = self.weight(fine[:, :3], coarse[:, :3])
        color = laplacian_fusion(fine[:, :3], coarse[:, :3], weight)
        if fine.shape[1] == 3:
            return color
        others = upsample(coarse[:, 3:], (fine.shape[-2], fine.shape[-1]))
        return torch.cat([color, torch.lerp(fine[:, 3:], others, weight.to(fine.dtype))], 1)
