"""`mcdenoise export`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import tyro

from mcdenoise.cli._options import Out
from mcdenoise.cli._output import say
from mcdenoise.data import open_sequence
from mcdenoise.errors import InputError
from mcdenoise.export import default_buffers, differences, export_model
from mcdenoise.methods import parse_method
from mcdenoise.models import create_model


def export(
    model: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="MODEL")]],
    out: Out,
    buffers: str | None = None,
    check: Path | None = None,
) -> None:
    """Export one step of a model as a graph, with its state as inputs and outputs, for frames of any size.

    The inputs are the buffers by name and the tensors of the state as state.NAME, which are zeros for the first frame;
    the outputs are image and next_state.NAME. An export takes some minutes.

    Args:
        model: name of a model, see `mcdenoise models`, optionally with settings; a weights file; or your own:
            path/to/file.py:factory or package.module:factory, with its weights as file.py:factory(weights=FILE).
        out: file to write, .onnx, or .pt2 for torch.export.load.
        buffers: names of the buffers that frames will have, such as color,albedo,normal,depth,motion; by default those
            of the sequence --check, or else all that the model uses.
        check: folder of a sequence: run the ONNX graph in onnxruntime on its first five frames, and print the
            differences.
    """
    spelling = parse_method(model)
    weights = spelling.weights
    made = create_model(spelling.model, pretrained=weights is None, weights=weights, **spelling.settings)
    sequence = None if check is None else open_sequence(check)
    if sequence is not None and out.suffix == ".pt2":
        raise InputError("--check: expected an ONNX file, for onnxruntime, found another format")
    if buffers is not None:
        chosen = frozenset(name.strip() for name in buffers.split(","))
    elif sequence is not None:
        wanted = made.needs.buffers | made.needs.uses
        chosen = (sequence.buffers & wanted) | made.needs.buffers
    else:
        chosen = default_buffers(made)
    start = time.perf_counter()
    exported = export_model(made, out, buffers=chosen, name=model)
    print(f"{exported.nodes} operators, in {time.perf_counter() - start:.0f} seconds")
    print(f"inputs: {', '.join(exported.inputs)}")
    print(f"outputs: {', '.join(exported.outputs)}")
    if sequence is not None:
        for number, difference in differences(exported, made, sequence):
            print(f"frame {number}: maximum relative difference from torch {difference:.1e}")
    say(f"wrote {out}")
