"""Compiles the Triton kernels for a GPU that need not be there: ``python compile_kernels.py 90 float32``."""

import sys
from collections.abc import Callable

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.runtime.jit import JITFunction

from mcdenoise.ops import Surface
from mcdenoise.ops._triton import _filter as _triton_filter
from mcdenoise.ops._triton import history, network, temporal


class Driver:
    """Stands in for the one of a GPU: nothing is launched."""

    def __init__(self, capability: int) -> None:
        self.target = GPUTarget("cuda", capability, 32)

    def get_current_target(self) -> GPUTarget:
        return self.target

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int) -> int:
        return 0


def main(capability: int, dtype: torch.dtype) -> None:
    triton.runtime.driver.set_active(Driver(capability))
    launch = JITFunction.run

    def compile_only(function: JITFunction, *arguments: object, grid: object, warmup: bool, **settings: object) -> None:
        compiled = launch(function, *arguments, grid=grid, warmup=True, **settings)
        assert compiled.asm["cubin"]
        # One layout for all tensors: what moves between threads waits for all of them.
        assert "convert_layout" not in compiled.asm["ttgir"]
        assert compiled.metadata.shared == 0
        print(function.__name__)

    JITFunction.run = compile_only

    def image(channels: int) -> torch.Tensor:
        return torch.zeros(1, channels, 72, 128, dtype=dtype)

    color, kernel, guides, falloffs = image(3), image(25), [image(3), image(1)], [image(1), image(1)]
    _triton_filter.derivatives(color, color, kernel, (), (), None, False, "replicate")
    _triton_filter.filtered(color, kernel, (), (), None, False, "replicate")
    _triton_filter.derivatives(color, color, kernel, guides, falloffs, image(1), True, "renormalize")
    _triton_filter.derivatives(color, color, kernel, guides, falloffs, None, False, "zeros")
    steps(image)


def steps(image: Callable[[int], torch.Tensor]) -> None:
    """Call the operators and steps that have no derivatives, with all that may be requested of them."""
    color, one = image(3), image(1)
    factor = one[:, :, :1, :1]
    surface = Surface(image(3), image(3), one, one)
    limits = (0.1, "relative", None, None)
    history.incoming(color, color, 15.0, 7, True)
    history.incoming(color, None, 15.0, 7, False)
    history.lights(one)
    given = (image(5), image(9), one, image(2), surface, surface)
    history.blend(*given, *limits, color, 2.0, 2.0, 5)
    flat = surface._replace(position=None, label=None)
    temporal.accumulate(color, color, one, None, flat, flat, *limits)
    flat = surface._replace(depth=None)
    temporal.accumulate(color, color, one, image(2), flat, flat, 0.1, "bmfr", 0.1, 0.1)
    temporal.motion_from_position(color, torch.zeros(1, 4, 4))
    network.depth_scale(one)
    network.network_guides(color, one, (factor, factor))
    network.softplus(color, (1.0, 10.0, 1000.0))
    network.buffers_input(color, color, color, one, color, one, factor, (factor, factor), True, factor)
    network.buffers_input(color, color, color, one, color, None, factor, (factor, factor), False, None)
    halves, weight = color[..., ::2, ::2], torch.zeros(1, 6, 3, 3)
    network.gated_fusion(color, halves, weight, weight[0, 0, 0, :1], color, factor, False)
    network.gated_fusion(color, halves, weight, weight[0, 0, 0, :1], None, None, True)
    network.low_frequencies_of(color, halves, factor, factor)


if __name__ == "__main__":
    main(int(sys.argv[1]), getattr(torch, sys.argv[2]))
