"""Errors against references, of a folder of images or of a method on a sequence."""

from mcdenoise.evaluate.folder import Evaluation, Table, evaluate_folder, evaluate_method, find_images
from mcdenoise.evaluate.halves import Halves, evaluate_halves
from mcdenoise.evaluate.noise import reference_noise
from mcdenoise.evaluate.scores import METRICS, USUAL, Scores, check_references, measure
from mcdenoise.metrics import Metric

__all__ = [
    "METRICS",
    "USUAL",
    "Evaluation",
    "Halves",
    "Metric",
    "Scores",
    "Table",
    "check_references",
    "evaluate_folder",
    "evaluate_halves",
    "evaluate_method",
    "find_images",
    "measure",
    "reference_noise",
]
