"""The zoo: denoisers assembled from the operators, by name."""

from mcdenoise.models._overview import ModelOverview, overview
from mcdenoise.models._regions import Region
from mcdenoise.models._registry import list_models, register_model
from mcdenoise.models._weights import create_model, describe_weights, load_weights, pretrained_models, save_weights
from mcdenoise.models.cascaded import (
    Cascade,
    Denoised,
    FusionModule,
    KernelPredictor,
    Known,
    PixelPredictor,
    auto_exposure,
    normalize_depth,
)
from mcdenoise.models.unet import Head, UNet

__all__ = [
    "Cascade",
    "Denoised",
    "FusionModule",
    "Head",
    "KernelPredictor",
    "Known",
    "ModelOverview",
    "PixelPredictor",
    "Region",
    "UNet",
    "auto_exposure",
    "create_model",
    "describe_weights",
    "list_models",
    "load_weights",
    "normalize_depth",
    "overview",
    "pretrained_models",
    "register_model",
    "save_weights",
]
