"""The cross-bilateral filter."""

from mcdenoise.ops._filters import filter_operator
from mcdenoise.ops._triton import _filter

cross_bilateral_filter, cross_bilateral_filter_gradients = filter_operator("triton", _filter)
