"""The zoo: denoisers assembled from the operators, by name, and wrappers that any method can use."""

from mcdenoise.models._adapter import FromBuffers, as_model
from mcdenoise.models._entries import register_model
from mcdenoise.models._interface import Model, Needs, Note, Output, State, prepared
from mcdenoise.models._layers import answered, carried, with_carried
from mcdenoise.models._overview import ModelOverview, overview, users_of
from mcdenoise.models._precision import (
    PRECISIONS,
    Precision,
    computing_in,
    fastest_precision,
    has_network,
)
from mcdenoise.models._registry import build_model, find_model, list_models, troubles
from mcdenoise.models._remembered import frames_remembered
from mcdenoise.models._report import FrameReport, Stage, summarize
from mcdenoise.models._weights import (
    compared_models,
    create_model,
    describe_weights,
    find_weights,
    has_random_weights,
    load_weights,
    model_of,
    pretrained_models,
    save_weights,
    start_with,
)
from mcdenoise.models._wrapper import Wrapper, parts_of
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.chain import Chain
from mcdenoise.models.coarse_to_fine import CoarseToFine
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.exposed import Exposed
from mcdenoise.models.recurrent import Recurrent
from mcdenoise.models.restored import Restored
from mcdenoise.models.skipping import TOLERANCE, Skipping
from mcdenoise.models.tiled import Region, Tiled

DEFAULT = "cascaded_v2"
# For features through a pixel filter, with noise, or of unknown origin.
FILTERED = "oidn_tuned"
# For features without noise, in stills and where the color has little.
EXACT = "oidn_tuned_exact"

__all__ = [
    "DEFAULT",
    "EXACT",
    "FILTERED",
    "PRECISIONS",
    "TOLERANCE",
    "Accumulated",
    "Chain",
    "CoarseToFine",
    "Demodulated",
    "Exposed",
    "FrameReport",
    "FromBuffers",
    "Model",
    "ModelOverview",
    "Needs",
    "Note",
    "Output",
    "Precision",
    "Recurrent",
    "Region",
    "Restored",
    "Skipping",
    "Stage",
    "State",
    "Tiled",
    "Wrapper",
    "answered",
    "as_model",
    "build_model",
    "carried",
    "compared_models",
    "computing_in",
    "create_model",
    "describe_weights",
    "fastest_precision",
    "find_model",
    "find_weights",
    "frames_remembered",
    "has_network",
    "has_random_weights",
    "list_models",
    "load_weights",
    "model_of",
    "overview",
    "parts_of",
    "prepared",
    "pretrained_models",
    "register_model",
    "save_weights",
    "start_with",
    "summarize",
    "troubles",
    "users_of",
    "with_carried",
]
