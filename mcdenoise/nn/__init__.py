"""Layers with weights that several models use, and the conversion of a frame to network inputs."""

from mcdenoise.nn.fusion import FusionModule
from mcdenoise.nn.inputs import auto_exposure, normalize_depth
from mcdenoise.nn.unet import UNet

__all__ = ["FusionModule", "UNet", "auto_exposure", "normalize_depth"]
