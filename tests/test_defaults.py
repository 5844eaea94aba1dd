"""Whatever torch's default dtype and device are in a program, what is computed is the same, bit for bit."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from planes import random_shot
from refusals import refused
from torch import Tensor

from mcdenoise import Denoiser, Frame, InputError, list_models, ops
from mcdenoise.check.case import as_tuple
from mcdenoise.check.cases import OPS
from mcdenoise.models import describe_weights

DEFAULTS = ["float64", "meta"]


@contextmanager
def default(name: str) -> Iterator[None]:
    """A default that the user's program has set. On a device without data every use is an error."""
    try:
        if name == "meta":
            torch.set_default_device("meta")
        else:
            torch.set_default_dtype(getattr(torch, name))
        yield
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(torch.float32)


def denoised(name: str, frames: list[Frame]) -> list[Tensor]:
    denoiser = Denoiser(name, precision="float32")
    return [denoiser(frame) for frame in frames]


@pytest.mark.parametrize("model", list_models())
def test_a_model_is_made_and_denoises_alike(model: str) -> None:
    frames = random_shot(0, 40, 48, 2)
    try:
        expected = denoised(model, frames)
    except InputError as error:
        pytest.skip(str(error))
    for name in DEFAULTS:
        with default(name):
            found = denoised(model, frames)
        assert all(map(torch.equal, found, expected)), name
        assert (found[0].dtype, found[0].device.type) == (torch.float32, "cpu")


@pytest.mark.parametrize("name", DEFAULTS)
def test_compiled_kernels_denoise_alike(name: str) -> None:
    pytest.importorskip("numba")
    frames = random_shot(0, 90, 120, 2)
    with ops.use("numba", strict=False):
        expected = denoised("wild_small", frames)
        with default(name):
            found = denoised("wild_small", frames)
    assert all(map(torch.equal, found, expected))


@pytest.mark.parametrize("op", OPS, ids=lambda op: op.name)
def test_an_op_and_its_derivatives_are_alike(op: Any) -> None:
    def outcomes(inputs: dict[str, Any]) -> list[Tensor]:
        leaves = dict(inputs)
        for key, value in inputs.items():
            if isinstance(value, Tensor):
                leaves[key] = value.detach().clone().requires_grad_(value.is_floating_point())
        results = as_tuple(op.function(**leaves, **case.settings))
        total = sum((each * each).sum() for each in results if each.requires_grad)
        wanted = [value for value in leaves.values() if isinstance(value, Tensor) and value.requires_grad]
        gradients = torch.autograd.grad(total, wanted, allow_unused=True) if isinstance(total, Tensor) else ()
        return [each.detach() for each in (*results, *gradients) if each is not None]

    for case in op.cases[:3]:
        inputs = case.inputs(torch.float32)
        expected = outcomes(inputs)
        for name in DEFAULTS:
            with default(name):
                found = outcomes(inputs)
            for a, b in zip(found, expected, strict=True):
                torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("name", DEFAULTS)
def test_training_is_alike(name: str, small_sequence: Path, tmp_path: Path) -> None:
    pytest.importorskip("lightning_fabric")
    pytest.importorskip("tensorboard")
    from mcdenoise.train import TrainConfig, train

    small: dict[str, Any] = {"settings": "width=4", "crop": 16, "frames": 2, "batch": 2, "steps": 2}
    config = TrainConfig(model="cascaded", **small, validation_frames=1)
    # The checksum covers the tensors alone; the header of a file has no order.
    expected = describe_weights(train(config, [small_sequence], tmp_path / "expected"))["sha256"]
    before = torch.get_default_dtype(), torch.get_default_device()
    with default(name):
        among = torch.get_default_dtype(), torch.get_default_device()
        found = describe_weights(train(config, [small_sequence], tmp_path / "found"))["sha256"]
        assert (torch.get_default_dtype(), torch.get_default_device()) == among
    assert (torch.get_default_dtype(), torch.get_default_device()) == before
    assert found == expected


WRONG: list[dict[str, Any]] = [
    *({"tile": value} for value in ("64", 64.0, True, [64], -1, 32, 100)),
    *({"max_memory": value} for value in ("1", True, float("nan"), -1, 0, [1])),
    {"tile": 128, "max_memory": 4.0},
    *({"model": value} for value in (5, "", torch.zeros(3), Denoiser, [], Frame)),
    *({"device": value} for value in (None, [], "nowhere", "meta", "hpu", "cuda:99", 1.5)),
    *({"precision": value} for value in (None, 16, [], "float16")),
    *({"weights": value} for value in (5, b"x", "nothing.safetensors", ".")),
    *({name: value} for name in ("keep_all", "differentiable", "alpha") for value in ("no", 1, None)),
    *({name: 5} for name in ("plan", "alpha_min")),
]


@pytest.mark.parametrize("wrong", WRONG, ids=str)
def test_an_argument_of_another_kind_is_told_by_its_name(wrong: dict[str, Any]) -> None:
    message = refused(lambda: Denoiser(**{"model": "wild_small", **wrong}))
    # A file is told by its own.
    name, value = next(iter(wrong.items()))
    assert name in message or message.startswith(f"{value}: expected a safetensors file")


@pytest.mark.parametrize("given", [torch.zeros(1, 3, 4, 4), None, 5, "x", [], {}, Frame], ids=str)
def test_objects_that_are_no_frame_are_named(given: Any) -> None:
    denoiser = Denoiser("noisy")
    for call in (denoiser, denoiser.output):
        assert refused(lambda call=call: call(given)).startswith(
            "frame: expected a Frame, such as Frame(color=...), found "
        )


@pytest.mark.parametrize("wrong", [{"frames": "3"}, {"frames": True}, {"layers": "x"}, {"layers": None}], ids=str)
def test_invalid_options_of_a_shot_are_named(wrong: dict[str, Any]) -> None:
    assert refused(lambda: Denoiser("noisy").reset(**wrong)).startswith(f"{next(iter(wrong))}: expected a whole number")
