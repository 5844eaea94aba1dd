"""Per-pixel kernel convolution and its transpose."""

from mcdenoise.ops._filters import kernel_operators
from mcdenoise.ops._triton import _filter

kernel_conv, kernel_conv_gradients, kernel_splat, kernel_splat_gradients = kernel_operators("triton", _filter)
