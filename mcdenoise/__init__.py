"""Interactive Monte Carlo denoising you can open up: differentiable operators, and denoisers assembled from them."""

from importlib.metadata import version

from mcdenoise import ops
from mcdenoise.denoiser import Denoiser, denoise
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models import create_model, list_models

__version__ = version("mcdenoise")

__all__ = ["Denoiser", "Frame", "InputError", "create_model", "denoise", "list_models", "ops"]
