"""Train a denoiser of the zoo, or one of your own, on rendered sequences."""

from mcdenoise.train.config import Schedule, TrainConfig
from mcdenoise.train.devices import is_first_process
from mcdenoise.train.loop import Progress, train
from mcdenoise.train.recipe import Recipe, Rendering, Run
from mcdenoise.train.references import clean_references
from mcdenoise.train.run_folder import RunFolder
from mcdenoise.train.unroll import unroll

__all__ = [
    "Progress",
    "Recipe",
    "Rendering",
    "Run",
    "RunFolder",
    "Schedule",
    "TrainConfig",
    "clean_references",
    "is_first_process",
    "train",
    "unroll",
]
