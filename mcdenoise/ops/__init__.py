"""Differentiable image operators: tensor in, tensor out; no weights, no files."""

from mcdenoise.ops._backend import use
from mcdenoise.ops._constants import NO_ALBEDO
from mcdenoise.ops._surface import Surface
from mcdenoise.ops.affinity import AffinityFilter, affinity_filter
from mcdenoise.ops.atrous import Atrous, atrous
from mcdenoise.ops.bilateral import CrossBilateralWeights, cross_bilateral_weights
from mcdenoise.ops.bilateral_filter import CrossBilateralFilter, cross_bilateral_filter
from mcdenoise.ops.bilateral_grid import GridSlice, GridSplat, grid_slice, grid_splat
from mcdenoise.ops.demodulation import Demodulate, Remodulate, demodulate, remodulate
from mcdenoise.ops.fireflies import ClampFireflies, clamp_fireflies
from mcdenoise.ops.fusion import LaplacianFusion, downsample, laplacian_fusion, upsample
from mcdenoise.ops.gradients import TemporalGradient, temporal_gradient
from mcdenoise.ops.importance import ImportanceFilter, importance_filter
from mcdenoise.ops.kernel_conv import KernelConv, KernelSplat, kernel_conv, kernel_splat
from mcdenoise.ops.lag import HistoryLag, history_lag
from mcdenoise.ops.moments import MomentsVariance, luminance_moments, moments_variance
from mcdenoise.ops.partition import learned_upsample, pyramid_partition
from mcdenoise.ops.regression import BlockRegression, block_regression
from mcdenoise.ops.resampling import resample
from mcdenoise.ops.softmax_splat import softmax_splat
from mcdenoise.ops.temporal import Accumulate, accumulate, motion_from_position, reproject

__all__ = [
    "NO_ALBEDO",
    "Accumulate",
    "AffinityFilter",
    "Atrous",
    "BlockRegression",
    "ClampFireflies",
    "CrossBilateralFilter",
    "CrossBilateralWeights",
    "Demodulate",
    "GridSlice",
    "GridSplat",
    "HistoryLag",
    "ImportanceFilter",
    "KernelConv",
    "KernelSplat",
    "LaplacianFusion",
    "MomentsVariance",
    "Remodulate",
    "Surface",
    "TemporalGradient",
    "accumulate",
    "affinity_filter",
    "atrous",
    "block_regression",
    "clamp_fireflies",
    "cross_bilateral_filter",
    "cross_bilateral_weights",
    "demodulate",
    "downsample",
    "grid_slice",
    "grid_splat",
    "history_lag",
    "importance_filter",
    "kernel_conv",
    "kernel_splat",
    "laplacian_fusion",
    "learned_upsample",
    "luminance_moments",
    "moments_variance",
    "motion_from_position",
    "pyramid_partition",
    "remodulate",
    "reproject",
    "resample",
    "softmax_splat",
    "temporal_gradient",
    "upsample",
    "use",
]
