"""Compiles the Triton kernels for a GPU that need not be there: ``python compile_kernels.py 90 float32``."""

import sys

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.runtime.jit import JITFunction

from mcdenoise.ops._triton import _filter as _triton_filter


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

    color, kernel, guides, scales = image(3), image(25), [image(3), image(1)], [image(1), image(1)]
    _triton_filter.derivatives(color, color, kernel, (), (), None, False, "replicate")
    _triton_filter.filtered(color, kernel, (), (), None, False, "replicate")
    _triton_filter.derivatives(color, color, kernel, guides, scales, image(1), True, "renormalize")
    _triton_filter.derivatives(color, color, kernel, guides, scales, None, False, "zeros")


if __name__ == "__main__":
    main(int(sys.argv[1]), getattr(torch, sys.argv[2]))
