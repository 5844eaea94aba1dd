"""Errors against references: of every way to denoise a sequence, and of any folder of images."""

from mcdenoise.evaluate.comparison import Verdict, folded, mean_over_scenes, summary, verdicts
from mcdenoise.evaluate.folder import Evaluation, Table, evaluate_folder, find_images
from mcdenoise.evaluate.noise import noise_floor, reference_noise
from mcdenoise.evaluate.scores import METRICS, Score, Scorer, check_references, measure, score_sequence
from mcdenoise.metrics import Metric

__all__ = [
    "METRICS",
    "Evaluation",
    "Metric",
    "Score",
    "Scorer",
    "Table",
    "Verdict",
    "check_references",
    "evaluate_folder",
    "find_images",
    "folded",
    "mean_over_scenes",
    "measure",
    "noise_floor",
    "reference_noise",
    "score_sequence",
    "summary",
    "verdicts",
]
