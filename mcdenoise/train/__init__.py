"""Train a denoiser of the zoo, or one of your own, on rendered sequences."""

from mcdenoise.train.config import Schedule, TrainConfig
from mcdenoise.train.devices import is_first_process
from mcdenoise.train.loop import Progress, train
from mcdenoise.train.unroll import unroll

__all__ = ["Progress", "Schedule", "TrainConfig", "is_first_process", "train", "unroll"]
