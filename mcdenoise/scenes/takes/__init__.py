"""Takes to train on: what a number draws, and how it is traced."""
