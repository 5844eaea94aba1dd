"""Denoising inside renderers: one module per renderer, which imports the renderer on first use."""
