"""Integrations into renderers, one module each, which imports its renderer on first use."""

from mcdenoise.threads import wait_passively

# The renderer's threads are in this process: torch's, if they spun while they wait, would take the cores from them.
wait_passively()
