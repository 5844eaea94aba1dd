"""A method as one graph for another runtime: a step whose state goes in and out, for images of any size."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from mcdenoise.data import Sequence
from mcdenoise.data.files import atomic_path
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.frame import BUFFERS, Frame, Hints
from mcdenoise.models import Model, State
from mcdenoise.models._contract import check_needs

Format = Literal["onnx", "torch"]
SUFFIXES: dict[Format, str] = {"onnx": ".onnx", "torch": ".pt2"}

# Odd and of unlike remainders, so that no size of the example is one that only some images have.
_SIZE, _OTHER_SIZE, _BATCH, _OTHER_BATCH = (61, 91), (54, 77), 2, 3
# What a camera and positions say, the motion says alone.
_CAMERA = frozenset({"position", "previous_position", "view_projection"})
# Accumulation in another order of sums: a result differs by rounding, see `Exported.check`.
_NO_HISTORY_TOLERANCE = 1e-3


class Step(nn.Module):
    """A method as a function of named tensors.

    Args:
        model: the method.
        buffers: names of the buffers that it is given.

    Raises:
        InputError: the method needs another buffer, or its state is none of tensors, or has no structure that is the
            same for every frame.
    """

    def __init__(self, model: Model, buffers: Collection[str]) -> None:
        super().__init__()
        self.model = model
        self.given = tuple(name for name in [*BUFFERS, "view_projection"] if name in buffers)
        self.given += tuple(sorted(set(buffers) - set(self.given)))
        check_needs(model.needs, self.given)
        self.axes = _axes(self._example, self.given)
        # The structure is that of a state after the first frame, which a graph keeps from then on.
        small, large = self._state_of(_SIZE, _BATCH), self._state_of(_OTHER_SIZE, _OTHER_BATCH)
        paths, self._spec = pytree.tree_flatten_with_path(small)
        self._names: list[str | None] = _names([path if isinstance(leaf, Tensor) else None for path, leaf in paths])
        self.state = tuple(name for name in self._names if name is not None)
        others = pytree.tree_leaves(large)
        for (_, a), b, name in zip(paths, others, self._names, strict=True):
            if name is not None:
                self.axes[f"state.{name}"] = _free_axes(a, b)

    @torch.no_grad()
    def _state_of(self, size: tuple[int, int], batch: int) -> State:
        return self.model(self.frame(self._example(size, batch)))[1]

    def _example(self, size: tuple[int, int], batch: int) -> dict[str, Tensor]:
        return {name: _example(name, size, batch) for name in self.given}

    def example(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Buffers of a frame, and the state of no frame."""
        buffers = self._example(_SIZE, _BATCH)
        return buffers, self.no_history(buffers)

    def no_history(self, buffers: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The state before the first frame of a shot like this: zeros."""
        color = buffers["color"]
        size, batch = (int(color.shape[-2]), int(color.shape[-1])), len(color)
        leaves = pytree.tree_leaves(self._state_of(size, batch))
        named = zip(self._names, leaves, strict=True)
        return {name: torch.zeros_like(leaf, device=color.device) for name, leaf in named if name is not None}

    def forward(self, buffers: dict[str, Tensor], state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """A step.

        Args:
            buffers: by name, with valid values (:meth:`mcdenoise.frame.Frame.validate`).
            state: of the frame before by name, zeros for the first one.

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
        """The frame that buffers by name are."""
        known: dict[str, Any] = {
            name: buffer
            for name, buffer in buffers.items()
            if name in BUFFERS or name in ("view_projection", "samples")
        }
        extra = {name: buffer for name, buffer in buffers.items() if name not in known}
        return Frame(**known, extra=extra, hints=Hints(stages=False))


@dataclass(frozen=True)
class Exported:
    """What was exported.

    Args:
        path: the file.
        inputs: names in order: buffers, then ``state.NAME``.
        outputs: names in order: ``image``, then ``next_state.NAME``.
        nodes: how many operators the graph has.
    """

    path: Path
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    nodes: int


def default_buffers(model: Model) -> frozenset[str]:
    """The buffers that a method needs or is better with; a motion rather than positions and cameras."""
    wanted = model.needs.buffers | model.needs.uses
    return wanted - (_CAMERA - model.needs.buffers if "motion" in wanted else frozenset())


def traced(step: Step) -> torch.export.ExportedProgram:
    """The graph of a step, for frames of any number, height and width.

    Raises:
        InputError: the method cannot be traced (it decides by the values of tensors, or by the size of the image), or a
            state of zeros is not, to it, the state of no frame.
    """
    buffers, state = step.example()
    dynamic = (
        {name: step.axes[name] for name in buffers},
        {name: step.axes[f"state.{name}"] for name in state},
    )
    try:
        with torch.no_grad(), _quiet():
            program = torch.export.export(step.eval(), (buffers, state), dynamic_shapes=dynamic, strict=False)
    except InputError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:300] or type(error).__name__
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
    format: Format | None = None,
    name: str = "",
) -> Exported:
    """Write a method as one graph: a step with the state as inputs and outputs, for frames of any size.

    The inputs are the buffers by name and the tensors of the state as ``state.NAME``; the outputs ``image`` and
    ``next_state.NAME``. A state of zeros is that of no frame: begin a shot with that, and feed each frame what the one
    before returned. Number, height and width of frames are free. Frames must be valid: what is not finite or negative
    in ``color`` is for :meth:`mcdenoise.frame.Frame.validate` to mend.

    Args:
        model: the method; it runs in float32 on the CPU while it is traced.
        path: the file.
        buffers: names of those that frames will have; :func:`default_buffers` by default.
        format: ``"onnx"``, or ``"torch"`` for ``torch.export.load``, whose program takes a dict of buffers and one of
            the state, and returns the image and such a dict; by default that of the path's suffix.
        name: of the model, kept in the file.

    Raises:
        InputError: as :func:`traced`; a package is missing, the suffix or a buffer is unknown, or the file cannot be
            written. Nothing is written then.
    """
    kind = _format_of(path, format)
    # Before minutes are spent.
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: cannot be written: expected its folder to exist, found none")
    if kind == "onnx":
        _check_packages("onnx", "onnxscript")
    step = Step(model, default_buffers(model) if buffers is None else buffers)
    program = traced(step)
    inputs = (*step.given, *(f"state.{each}" for each in step.state))
    outputs = ("image", *(f"next_state.{each}" for each in step.state))
    about = {"model": name or type(model).__name__, "mcdenoise": version("mcdenoise"), "torch": torch.__version__}
    write = _write_onnx if kind == "onnx" else _write_torch
    with atomic_path(path) as temporary:
        write(program, temporary, inputs, outputs, about)
    return Exported(path, inputs, outputs, len(program.graph.nodes))


def differences(exported: Exported, model: Model, sequence: Sequence, frames: int = 5) -> Iterator[tuple[int, float]]:
    """How far onnxruntime, running an exported graph, is from torch, running the method, over the frames of a shot.

    Args:
        exported: of :func:`export_model`, in ONNX.
        model: the method.
        sequence: frames with the buffers that the graph takes.
        frames: how many of them.

    Yields:
        For each frame its number, and the largest difference of a pixel, relative where the image is bright, and of
        its mean where it is dark.

    Raises:
        InputError: onnxruntime is missing, or the frames lack a buffer.
    """
    _check_packages("onnxruntime")
    names = [name for name in exported.inputs if not name.startswith("state.")]
    if absent := [name for name in names if name not in sequence.buffers | {"depth"}]:
        raise InputError(f"{sequence.root}: expected the buffer '{absent[0]}', which the graph takes, found none")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    # Of errors only: what could be folded is of no interest here.
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(exported.path), options, providers=["CPUExecutionProvider"])
    # A graph decides nothing by what a scene has, so nothing may be skipped beside it.
    denoiser = Denoiser(model, precision="float32", keep_all=True)
    step = Step(denoiser.model, names)
    state: dict[str, Any] = {}
    for number in sequence.numbers[:frames]:
        frame = sequence.frame(number, reference=False).to(torch.float32).validate()[0].with_depth()
        given = {name: buffer for name, buffer in frame.items() if name in names}
        expected = denoiser(step.frame(given))
        state = state or {f"state.{key}": value.numpy() for key, value in step.no_history(given).items()}
        feeds = {name: buffer.numpy() for name, buffer in given.items()} | state
        # What makes no difference to the result, the graph does not take.
        feeds = {each.name: feeds[each.name] for each in session.get_inputs()}
        image, *after = session.run(list(exported.outputs), feeds)
        state = {
            name.replace("next_state.", "state."): value
            for name, value in zip(exported.outputs[1:], after, strict=True)
        }
        yield number, _difference(torch.from_numpy(image), expected)


def _difference(found: Tensor, expected: Tensor) -> float:
    return float(((found - expected).abs() / expected.abs().clamp_min(float(expected.mean()) + 1e-30)).max())


def _check_no_history(
    step: Step, program: torch.export.ExportedProgram, buffers: dict[str, Tensor], state: dict[str, Tensor]
) -> None:
    # Guards are of layouts in memory and the like, and none of the result.
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
        with _quiet():
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
    written.save(path, external_data=False)


def _write_torch(
    program: torch.export.ExportedProgram,
    path: Path,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    about: dict[str, str],
) -> None:
    with _quiet():
        torch.export.save(program, path, extra_files=about)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the warnings and the log of torch's exporters, which are of their own code."""
    import logging

    loggers = [logging.getLogger(name) for name in ("torch.onnx", "torch.export", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.ERROR)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _format_of(path: Path, format: Format | None) -> Format:
    known = ", ".join(SUFFIXES.values())
    found = next((kind for kind, suffix in SUFFIXES.items() if path.suffix == suffix), None)
    if format is None and found is None:
        raise InputError(f"{path}: expected a file that ends with one of {known}, or a --format")
    if format is not None and format not in SUFFIXES:
        raise InputError(f"format: expected one of {', '.join(SUFFIXES)}, found '{format}'")
    if format is not None and found not in (None, format):
        raise InputError(f"{path}: expected a name that ends with {SUFFIXES[format]}, found {path.suffix}")
    return format or found or "onnx"


def _check_packages(*names: str) -> None:
    for name in names:
        if importlib.util.find_spec(name) is None:
            raise InputError(f"{name}: expected it to be installed, found it missing; pip install 'mcdenoise[export]'")


def _example(name: str, size: tuple[int, int], batch: int) -> Tensor:
    """A valid buffer; its values are of no importance, but that something moves."""
    drawn = torch.Generator().manual_seed(0)
    if name == "view_projection":
        return torch.eye(4).roll(-1, 1).expand(batch, 4, 4).clone() + 0.01 * torch.eye(4)
    if name == "motion":
        return torch.full((batch, 2, *size), 0.5)
    channels = BUFFERS[name].channels if name in BUFFERS else 3
    shape = (batch, 2, 3, *size) if name == "samples" else (batch, channels, *size)
    values = torch.rand(shape, generator=drawn) * 0.9 + 0.1
    return nn.functional.normalize(values, dim=1) if name == "normal" else values


def _axes(example: Callable[[tuple[int, int], int], dict[str, Tensor]], names: tuple[str, ...]) -> dict[str, Any]:
    small, large = example(_SIZE, _BATCH), example(_OTHER_SIZE, _OTHER_BATCH)
    return {name: _free_axes(small[name], large[name]) for name in names}


def _free_axes(small: Tensor, large: Tensor) -> dict[int, Any]:
    """The axes that are others for frames of another number and size."""
    pairs = enumerate(zip(small.shape, large.shape, strict=True))
    return {axis: torch.export.Dim.DYNAMIC for axis, (a, b) in pairs if a != b}


def _names(paths: list[Any]) -> list[str | None]:
    """A readable name of each path: that of its fields, without positions where names are unique so."""
    short = [None if path is None else ".".join(_part(key) for key in path if not _is_index(key)) for path in paths]
    if len({name for name in short if name}) == sum(path is not None for path in paths):
        return short
    return [None if path is None else ".".join(_part(key) for key in path) or "all" for path in paths]


def _is_index(key: Any) -> bool:
    return isinstance(key, pytree.SequenceKey)


def _part(key: Any) -> str:
    for attribute in ("name", "key", "idx"):
        if hasattr(key, attribute):
            return str(getattr(key, attribute))
    return str(key)
