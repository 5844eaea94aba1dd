"""Numerical stability."""
