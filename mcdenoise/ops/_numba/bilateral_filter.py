"""The cross-bilateral filter."""

from mcdenoise.ops._filters import filter_operator
from mcdenoise.ops._numba import _filter

cross_bilateral_filter, cross_bilateral_filter_gradients = filter_operator("numba", _filter)
