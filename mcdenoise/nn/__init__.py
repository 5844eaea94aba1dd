"""Layers with weights that models share, and what networks see of a frame."""

from mcdenoise.nn.fusion import FusionModule, LogFusion
from mcdenoise.nn.inputs import auto_exposure, normalize_depth
from mcdenoise.nn.unet import Head, UNet

__all__ = ["FusionModule", "Head", "LogFusion", "UNet", "auto_exposure", "normalize_depth"]
