"""The zoo: denoisers assembled from the operators, by name, and wrappers that any method can use."""

from mcdenoise.models._interface import Model, Needs, Note, Output, State
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._registry import list_models, register_model
from mcdenoise.models._weights import create_model, describe_weights, load_weights, save_weights, start_with
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.chain import Chain
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.exposed import Exposed
from mcdenoise.models.recurrent import Recurrent
from mcdenoise.models.restored import Restored
from mcdenoise.models.skipping import Skipping
from mcdenoise.models.tiled import Tiled

DEFAULT = "wild"

__all__ = [
    "DEFAULT",
    "Accumulated",
    "Chain",
    "Demodulated",
    "Exposed",
    "Model",
    "Needs",
    "Note",
    "Output",
    "Recurrent",
    "Restored",
    "Skipping",
    "State",
    "Tiled",
    "Wrapper",
    "answered",
    "create_model",
    "describe_weights",
    "list_models",
    "load_weights",
    "register_model",
    "save_weights",
    "start_with",
    "with_carried",
]
