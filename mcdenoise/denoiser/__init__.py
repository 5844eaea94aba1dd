"""Denoising frame by frame, with a history; and denoising of a single image from arrays to an array."""

from mcdenoise.denoiser._denoiser import AskedPrecision, Denoiser
from mcdenoise.denoiser._single import denoise

__all__ = ["AskedPrecision", "Denoiser", "denoise"]
