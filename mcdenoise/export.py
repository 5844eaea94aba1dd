"""Export of a method as a graph for another runtime: one step with the state as input and output, for any size."""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from mcdenoise.data import Sequence
from mcdenoise.data.files import atomic_path
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError, import_optional
from mcdenoise.frame import BUFFERS, Frame, Hints
from mcdenoise.models import Model, State
from mcdenoise.models._contract import check_needs
from mcdenoise.models._wrapper import parts_of
from mcdenoise.models.filtered import Filtered

SUFFIXES = (".onnx", ".pt2")

# Odd, with different remainders, so that the tracer does not specialize to a property of these sizes.
_SIZE, _OTHER_SIZE, _BATCH, _OTHER_BATCH = (61, 91), (54, 77), 2, 3
# The motion carries the same information as cameras and positions.
_CAMERA = frozenset({"position", "previous_position", "view_projection"})
# Number of frames on which a graph is compared with torch.
_COMPARED = 5
# The order of sums differs in accumulation, so results differ by rounding, see `Exported.check`.
_NO_HISTORY_TOLERANCE = 1e-3


class Step(nn.Module):
    """A method as a function of named tensors.

    Args:
        model: the method.
        buffers: names of the buffers that the method receives.

    Raises:
        InputError: the method needs another buffer, or its state contains something other than tensors or changes its
            structure from frame to frame.
    """

    def __init__(self, model: Model, buffers: Collection[str]) -> None:
        super().__init__()
        self.model = copy.deepcopy(model)
        for part in parts_of(self.model, Filtered):
            # No graph can look for noise in features.
            if part.features == "auto":
                part.features, part.filters = "clean", nn.ModuleDict()
        self.given = tuple(name for name in [*BUFFERS, "view_projection"] if name in buffers)
        self.given += tuple(sorted(set(buffers) - set(self.given)))
        check_needs(model.needs, self.given)
        small, large = _examples(self.given, _SIZE, _BATCH), _examples(self.given, _OTHER_SIZE, _OTHER_BATCH)
        self.axes = {name: _free_axes(small[name], large[name]) for name in self.given}
        # Use the structure of a state after the first frame; the graph keeps it.
        before, other = self._state_of(small), self._state_of(large)
        paths, self._spec = pytree.tree_flatten_with_path(before)
        self._names: list[str | None] = _names([path if isinstance(leaf, Tensor) else None for path, leaf in paths])
        self.state = tuple(name for name in self._names if name is not None)
        others = pytree.tree_leaves(other)
        for (_, a), b, name in zip(paths, others, self._names, strict=True):
            if name is not None:
                self.axes[f"state.{name}"] = _free_axes(a, b)

    @torch.no_grad()
    def _state_of(self, buffers: Mapping[str, Tensor]) -> State:
        return self.model(self.frame(buffers))[1]

    def no_history(self, buffers: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The state before the first frame of a shot with such buffers: zeros."""
        color = buffers["color"]
        size = int(color.shape[-2]), int(color.shape[-1])
        leaves = pytree.tree_leaves(self._state_of(_examples(self.given, size, len(color))))
        named = zip(self._names, leaves, strict=True)
        return {name: torch.zeros_like(leaf, device=color.device) for name, leaf in named if name is not None}

    def forward(self, buffers: dict[str, Tensor], state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Run a step.

        Args:
            buffers: by name, with valid values (:meth:`mcdenoise.frame.Frame.validate`).
            state: state after the previous frame, by name; zeros for the first frame.

        Returns:
            The image, and the state for the next frame.
        """
        before = pytree.tree_unflatten([None if name is None else state[name] for name in self._names], self._spec)
        output, after = self.model(self.frame(buffers), before if self.state else None)
        leaves = pytree.tree_leaves(after)
        if len(leaves) != len(self._names):
            raise InputError("model: expected a state of the same structure as for the frame before, found another")
        return output.image, {name: leaf for name, leaf in zip(self._names, leaves, strict=True) if name is not None}

    def frame(self, buffers: Mapping[str, Tensor]) -> Frame:
        """Build the frame from buffers by name."""
        known: dict[str, Any] = dict(buffers)
        extra = {name: known.pop(name) for name in buffers if name not in (*BUFFERS, "view_projection", "samples")}
        return Frame(**known, extra=extra, hints=Hints(stages=False))


@dataclass(frozen=True)
class Exported:
    """An exported graph.

    Args:
        path: the file.
        inputs: names in order: buffers, then ``state.NAME``.
        outputs: names in order: ``image``, then ``next_state.NAME``.
        nodes: number of operators in the graph.
    """

    path: Path
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    nodes: int


def default_buffers(model: Model) -> frozenset[str]:
    """The buffers that a method needs or uses; motion instead of positions and cameras."""
    wanted = model.needs.buffers | model.needs.uses
    return wanted - (_CAMERA - model.needs.buffers if "motion" in wanted else frozenset())


def traced(step: Step) -> torch.export.ExportedProgram:
    """Trace a step to a graph for any batch size, height and width.

    Raises:
        InputError: the method cannot be traced (it branches on the values of tensors or on the size of the image), or a
            state of zeros does not act as the state before the first frame.
    """
    buffers = _examples(step.given, _SIZE, _BATCH)
    state = step.no_history(buffers)
    dynamic = {name: step.axes[name] for name in buffers}, {name: step.axes[f"state.{name}"] for name in state}
    try:
        with torch.no_grad(), _quiet():
            program = torch.export.export(step.eval(), (buffers, state), dynamic_shapes=dynamic, strict=False)
    except InputError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        if "Constraints violated" in reason:
            # Python's len() is a number, where the graph needs the size of any batch.
            reason = f"a size that is fixed, such as that of len(x): write x.shape[0]; {reason}"
        raise InputError(
            f"model: expected one that torch.export can trace for images of any size, found {type(error).__name__}: "
            f"{reason}"
        ) from error
    _check_no_history(step, program, buffers, state)
    return program


def export_model(
    model: Model,
    path: Path,
    *,
    buffers: Collection[str] | None = None,
    name: str = "",
) -> Exported:
    """Write one step of a method as a graph, with the state as inputs and outputs, for frames of any size.

    The inputs are the buffers by name and the tensors of the state as ``state.NAME``; the outputs are ``image`` and
    ``next_state.NAME``. Begin a shot with a state of zeros, and pass each frame the state that the previous one
    returned. Batch size, height and width are free. Frames must be valid: :meth:`mcdenoise.frame.Frame.validate`
    repairs NaN, infinite and negative values of ``color``. In ONNX the free axes are named ``batch``, ``height`` and
    ``width``; a state of a coarser resolution has axes of other names.

    Args:
        model: the method; it runs in float32 on the CPU while it is traced.
        path: the file, ``.onnx``; or ``.pt2`` for ``torch.export.load``, whose program takes two dicts, buffers and
            state, and returns the image and a dict.
        buffers: names of the buffers that frames will have; :func:`default_buffers` by default.
        name: name of the model, stored in the file.

    Raises:
        InputError: see :func:`traced`; or a package is missing, the suffix or a buffer is unknown, or the file cannot
            be written. In each case no file is written.
    """
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: expected a file that ends with one of {', '.join(SUFFIXES)}")
    # Check this first, because tracing takes minutes.
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: cannot be written: expected its folder to exist, found none")
    if path.suffix == ".onnx":
        for package in ("onnx", "onnxscript"):
            import_optional(package, "an export", "export")
    step = Step(model, default_buffers(model) if buffers is None else buffers)
    program = traced(step)
    inputs = (*step.given, *(f"state.{each}" for each in step.state))
    outputs = ("image", *(f"next_state.{each}" for each in step.state))
    about = {"model": name or type(model).__name__, "mcdenoise": version("mcdenoise"), "torch": torch.__version__}
    with atomic_path(path) as temporary, _quiet():
        if path.suffix == ".onnx":
            _write_onnx(program, temporary, inputs, outputs, about)
        else:
            torch.export.save(program, temporary, extra_files=about)
    return Exported(path, inputs, outputs, len(program.graph.nodes))


def differences(exported: Exported, model: Model, sequence: Sequence) -> Iterator[tuple[int, float]]:
    """Compare onnxruntime running an exported graph with torch running the method, over the first five frames.

    Args:
        exported: result of :func:`export_model`, in ONNX.
        model: the method.
        sequence: frames with the buffers that the graph takes.

    Yields:
        Number of each frame, and the largest difference of a pixel, relative to the pixel or to the image's mean,
        whichever is larger.

    Raises:
        InputError: onnxruntime is missing, or the frames lack a buffer.
    """
    onnxruntime = import_optional("onnxruntime", "a comparison", "export")
    states = [name for name in exported.inputs if name.startswith("state.")]
    names = [name for name in exported.inputs if name not in states]
    if absent := [name for name in names if name not in sequence.buffers | {"depth"}]:
        raise InputError(f"{sequence.root}: expected the buffer '{absent[0]}', which the graph takes, found none")
    options = onnxruntime.SessionOptions()
    # Log errors only; warnings about constant folding do not matter here.
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(exported.path), options, providers=["CPUExecutionProvider"])
    # A graph does not skip anything, so the comparison must not skip either.
    step = Step(model, names)
    denoiser = Denoiser(step.model, precision="float32", keep_all=True)
    state: dict[str, Any] = {}
    for number in sequence.numbers[:_COMPARED]:
        frame = sequence.frame(number, reference=False).to(torch.float32).validate()[0].with_depth()
        given = {name: buffer for name, buffer in frame.items() if name in names}
        expected = denoiser(step.frame(given))
        state = state or {f"state.{key}": value.numpy() for key, value in step.no_history(given).items()}
        feeds = {name: buffer.numpy() for name, buffer in given.items()} | state
        # The exporter removes inputs that do not influence the result.
        feeds = {each.name: feeds[each.name] for each in session.get_inputs()}
        image, *after = session.run(list(exported.outputs), feeds)
        state = dict(zip(states, after, strict=True))
        yield number, _difference(torch.from_numpy(image), expected)


def _difference(found: Tensor, expected: Tensor) -> float:
    return float(((found - expected).abs() / expected.abs().clamp_min(float(expected.mean()) + 1e-30)).max())


def _check_no_history(
    step: Step, program: torch.export.ExportedProgram, buffers: dict[str, Tensor], state: dict[str, Tensor]
) -> None:
    # The guards concern memory layouts, which do not influence the result.
    with torch.no_grad():
        found = program.module(check_guards=False)(buffers, state)[0]
        expected = step.model(step.frame(buffers))[0].image
    if not _difference(found, expected) <= _NO_HISTORY_TOLERANCE:
        raise InputError(
            "model: expected the graph's first image, with a state of zeros, to be that of no state, found them "
            f"{_difference(found, expected):.2g} apart; zeros must stand for no history"
        )


def _write_onnx(
    program: torch.export.ExportedProgram,
    path: Path,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    about: dict[str, str],
) -> None:
    try:
        written = torch.onnx.export(
            program, dynamo=True, input_names=list(inputs), output_names=list(outputs), optimize=True, verbose=False
        )
    except Exception as error:
        first: BaseException = error
        while first.__cause__ is not None:
            first = first.__cause__
        reason = " ".join(str(first).split())[:300]
        raise InputError(f"model: expected a graph that ONNX has operators for, found: {reason}") from error
    if written is None:
        raise InputError("model: expected a graph that ONNX has operators for, found another")
    written.model.metadata_props.update(about)
    # The exporter numbers the sizes that are free; those of the color have names.
    graph: Any = written.model.graph
    color = next(each.shape for each in graph.inputs if each.name == "color")
    known = {str(size): name for size, name in zip(color, ("batch", "", "height", "width"), strict=True) if name}
    for each in (*graph.inputs, *graph.outputs):
        for axis, size in enumerate(each.shape):
            each.shape[axis] = known.get(str(size), size)
    # A state goes in as it came out.
    after = {each.name.removeprefix("next_"): each.shape for each in graph.outputs}
    for each in graph.inputs:
        each.shape = after.get(each.name, each.shape)
    written.save(path, external_data=False)


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the warnings and logs that torch's exporters cause themselves."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def _examples(names: Iterable[str], size: tuple[int, int], batch: int) -> dict[str, Tensor]:
    return {name: _example(name, size, batch) for name in names}


def _example(name: str, size: tuple[int, int], batch: int) -> Tensor:
    """A valid buffer with arbitrary values and non-zero motion."""
    drawn = torch.Generator().manual_seed(0)
    if name == "view_projection":
        return torch.eye(4).roll(-1, 1).expand(batch, 4, 4).clone() + 0.01 * torch.eye(4)
    if name == "motion":
        return torch.full((batch, 2, *size), 0.5)
    channels = BUFFERS[name].channels if name in BUFFERS else 3
    shape = (batch, 2, 3, *size) if name == "samples" else (batch, channels, *size)
    values = torch.rand(shape, generator=drawn) * 0.9 + 0.1
    return nn.functional.normalize(values, dim=1) if name == "normal" else values


def _free_axes(small: Tensor, large: Tensor) -> dict[int, Any]:
    """The axes whose sizes differ between two examples of different batch and image size."""
    pairs = enumerate(zip(small.shape, large.shape, strict=True))
    return {axis: torch.export.Dim.DYNAMIC for axis, (a, b) in pairs if a != b}


def _names(paths: list[Any]) -> list[str | None]:
    """A readable name for each path: its field names, with indices only where needed for uniqueness."""
    short = [
        None if path is None else ".".join(_part(key) for key in path if not isinstance(key, pytree.SequenceKey))
        for path in paths
    ]
    if len({name for name in short if name}) == sum(path is not None for path in paths):
        return short
    return [None if path is None else ".".join(_part(key) for key in path) or "all" for path in paths]


def _part(key: Any) -> str:
    return str(next(getattr(key, each) for each in ("name", "key", "idx") if hasattr(key, each)))
