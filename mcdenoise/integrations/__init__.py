"""Integrations into renderers, one module each, which imports its renderer on first use."""
