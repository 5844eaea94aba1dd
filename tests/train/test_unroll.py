"""Any method is trained as it is used: step by step over a clip, with the gradient through its state."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from recurrent import Guided, Recurrent, plain
from refusals import refused
from torch import Tensor, nn
from torch.autograd import gradcheck

from mcdenoise import Denoiser, create_model
from mcdenoise.data import open_sequence
from mcdenoise.models import Output, describe_weights
from mcdenoise.models._wrapper import FromBuffers
from mcdenoise.train.clips import Clip
from mcdenoise.train.unroll import Unrolled, unroll

MINE = Path(__file__).parent / "recurrent.py"


def clip_of(frames: int = 3, size: tuple[int, int] = (6, 7), dtype: torch.dtype = torch.float32) -> Clip:
    color = 0.2 + torch.rand(2, frames, 3, *size, dtype=dtype)
    motion = 1.3 * torch.rand(2, frames, 2, *size, dtype=dtype) - 0.4
    return Clip({"color": color, "motion": motion, "reference": torch.rand_like(color)})


def test_the_state_goes_from_frame_to_frame() -> None:
    model, clip = Recurrent(), clip_of(4)
    output = unroll(model, clip)
    assert output.image.shape == (2, 4, 3, 6, 7)
    state: Any = None
    for t in range(4):
        step, state = model(clip.frame(t), state)
        assert torch.equal(output.image[:, t], step.image)
        assert torch.equal(output.stages["input"][:, t], clip["color"][:, t])
    assert not torch.equal(output.image[:, 3], model(clip.frame(3))[0].image)


def test_the_gradient_through_time() -> None:
    """The gradient of the last frame in the colours of all frames and every weight agrees with finite differences."""
    torch.manual_seed(1)
    model, clip = Recurrent(2).double(), clip_of(3, (3, 4), torch.float64)
    # No output is at the kink of the clamp.
    nn.init.constant_(model.head.bias, 0.5)
    names, weights = zip(*model.named_parameters(), strict=True)

    def last(color: Tensor, *values: Tensor) -> Tensor:
        own = Unrolled(model)
        buffers = {**clip.buffers, "color": color}
        named = dict(zip((f"model.{name}" for name in names), values, strict=True))
        output: Output = torch.func.functional_call(own, named, (buffers,))
        return output.image[:, -1]

    inputs = [tensor.detach().clone().requires_grad_() for tensor in (clip["color"], *weights)]
    assert gradcheck(last, inputs, fast_mode=True)
    (through_time,) = torch.autograd.grad(last(*inputs).sum(), inputs[:1])
    assert (through_time[:, 0] != 0).any()


def trained(model: str, sequence: Path, out: Path, **changes: Any) -> tuple[Path, list[float]]:
    pytest.importorskip("lightning_fabric", reason="training needs the packages of mcdenoise[train]")
    pytest.importorskip("tensorboard", reason="training needs the packages of mcdenoise[train]")
    from mcdenoise.train import TrainConfig, train

    settings: dict[str, Any] = {"crop": 16, "frames": 3, "batch": 2, "steps": 4, "validation_frames": 1, **changes}
    losses: list[float] = []
    config = TrainConfig(model=model, **settings)
    every = max(1, config.steps // 3)
    path = train(config, [sequence], out, checkpoint_every=every, report=lambda progress: losses.append(progress.loss))
    return path, losses


@pytest.mark.parametrize(("factory", "precision"), [("plain", "bfloat16"), ("accumulated", "float32")])
def test_a_recurrent_method_learns(small_sequence: Path, tmp_path: Path, factory: str, precision: str) -> None:
    settings = {"precision": precision, "steps": 60, "learning_rate": 1e-2, "validation_frames": 0}
    path, losses = trained(f"{MINE}:{factory}", small_sequence, tmp_path / "run", **settings)
    assert path.name == f"{factory}.safetensors"
    # 0.364 to 0.287 and 0.254 to 0.213 was measured.
    assert losses[-1] < 0.9 * losses[0]
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert log[-1]["step"] == 60
    # Every weight has learnt through time: those of the gates see the state alone.
    fresh, learnt = (dict(model.named_parameters()) for model in (plain(), create_model(f"{MINE}:plain", weights=path)))
    assert all(not torch.equal(learnt[name], weight) for name, weight in fresh.items())


def test_a_module_of_four_buffers_learns_and_denoises(small_sequence: Path, tmp_path: Path) -> None:
    name = f"{MINE}:Guided"
    settings = {"steps": 30, "learning_rate": 1e-2, "settings": "width=6", "validation_frames": 0}
    path, losses = trained(name, small_sequence, tmp_path / "run", **settings)
    assert path.name == "Guided.safetensors"
    assert losses[-1] < losses[0]
    about = describe_weights(path)
    # No folder of the machine.
    assert (about["architecture"], about["settings"]) == (name.rpartition("/")[2], {"width": 6})
    own = Guided(6)
    model = create_model(name, weights=path)
    assert isinstance(model, FromBuffers)
    own.load_state_dict(model.function.state_dict())
    frame = open_sequence(small_sequence).frame(0)
    expected = own(frame.color, frame.albedo, frame.normal, frame.depth)
    torch.testing.assert_close(Denoiser(name, weights=path)(frame), expected.detach(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("factory", "changes", "expected"),
    [
        ("broken", {}, "expected curvature to train this model on, found no curvature"),
        ("forgetful", {}, "fails on a frame of color, motion, reference: RuntimeError: the state is gone"),
        ("Cropped", {}, "expected the stage 'image' of (1, 3, 16, 16), found (1, 3, 16, 8)"),
        ("Detached", {}, "expected an image with derivatives in its weights, found one without"),
        ("plain", {"settings": "height=3"}, "got an unexpected keyword argument 'height'; it takes width"),
        ("without_weights", {}, "expected one that learns, found one without weights"),
        ("no_such", {}, "expected a factory 'no_such'"),
    ],
)
def test_a_model_that_cannot_be_trained_leaves_no_run(
    small_sequence: Path, tmp_path: Path, factory: str, changes: dict[str, Any], expected: str
) -> None:
    message = refused(trained, f"{MINE}:{factory}", small_sequence, tmp_path / "run", **changes)
    assert expected in message
    assert not (tmp_path / "run" / "config.json").exists()
