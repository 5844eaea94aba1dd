"""Denoising inside a renderer: one module for each, which imports the renderer on first use."""
