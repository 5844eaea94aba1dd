"""Any method is trained as it is used: step by step over a clip, with the gradient through its state."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from recurrent import Guided, Recurrent, accumulated, plain
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn
from torch.autograd import gradcheck
from torch.utils import _pytree as pytree

from mcdenoise import Denoiser, Frame, create_model
from mcdenoise.data import open_sequence
from mcdenoise.errors import InputError
from mcdenoise.models import Output, describe_weights
from mcdenoise.models._adapter import FromBuffers
from mcdenoise.train.clips import Clip
from mcdenoise.train.unroll import Unrolled, unroll

MINE = Path(__file__).parent / "recurrent.py"


def clip_of(frames: int = 3, size: tuple[int, int] = (6, 7), dtype: torch.dtype = torch.float32) -> Clip:
    """Noise that moves by fractions of a pixel."""
    color = 0.2 + torch.rand(2, frames, 3, *size, dtype=dtype)
    motion = 1.3 * torch.rand(2, frames, 2, *size, dtype=dtype) - 0.4
    return Clip({"color": color, "motion": motion, "reference": torch.rand_like(color)})


# The unroll


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


def test_a_method_without_a_state_sees_all_frames_at_once() -> None:
    calls: list[int] = []

    def model(frame: Frame, state: None = None) -> tuple[Output, None]:
        calls.append(len(frame.color))
        return Output(2 * frame.color, {"initial": 3 * frame.color}), None

    clip = clip_of(4)
    at_once = unroll(model, clip, has_state=False)
    step_by_step = unroll(model, clip)
    assert calls == [8, 2, 2, 2, 2]
    for output in (at_once, step_by_step):
        assert torch.equal(output.image, 2 * clip["color"])
        assert torch.equal(output.stages["initial"], 3 * clip["color"])
    with pytest.raises(TypeError, match="expected none with a state"):
        unroll(Recurrent(), clip, has_state=False)


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


# A recurrent method of one's own


def trained(model: str, sequence: Path, out: Path, **changes: Any) -> tuple[Path, list[float]]:
    """The weights of a short run, and its losses."""
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


def frames_of(sequence: Path) -> list[Frame]:
    """The frames of a sequence, with motion of some fractions of a pixel."""
    opened = open_sequence(sequence)
    frames = [opened.frame(number) for number in opened.numbers]
    return [frame.replace(motion=torch.full_like(frame.color[:, :2], 0.3)) for frame in frames]


@pytest.mark.parametrize("factory", [plain, accumulated])
def test_a_state_is_saved_and_loaded(small_sequence: Path, factory: Any) -> None:
    model, frames = factory(), frames_of(small_sequence)
    state: Any = None
    with torch.no_grad():
        for frame in frames[:2]:
            _, state = model(frame, state)
        leaves, structure = pytree.tree_flatten(state)
        tensors = {str(i): leaf.contiguous() for i, leaf in enumerate(leaves) if leaf is not None}
        loaded = load_tensors(save_tensors(tensors))
        again = pytree.tree_unflatten([loaded.get(str(i)) for i in range(len(leaves))], structure)
        file = io.BytesIO()
        torch.save(tensors, file)
        file.seek(0)
        assert all(torch.equal(tensor, tensors[key]) for key, tensor in torch.load(file, weights_only=True).items())
        expected, actual = model(frames[2], state)[0].image, model(frames[2], again)[0].image
        fresh = model(frames[2])[0].image
    assert torch.equal(actual, expected)
    assert not torch.equal(fresh, expected)


def test_a_state_ends_at_a_cut_and_with_the_size(small_sequence: Path) -> None:
    frames = frames_of(small_sequence)
    model = accumulated()
    # Nothing of the scene is where it was.
    elsewhere = frames[2].replace(position=frames[2].position + 50, motion=None)
    small = frames[2].crop(slice(0, 15), slice(0, 18))
    for other in (elsewhere, small):
        denoiser = Denoiser(model)
        for frame in frames[:2]:
            denoiser(frame)
        first = Denoiser(model)
        if other is elsewhere:
            # Motion is of no use to a shot's first frame, but the method asks for one.
            other = other.replace(motion=torch.full_like(other.color[:, :2], 1e4))
        assert torch.equal(denoiser(other), first(other))
        assert denoiser.report.reset in ("cut", "size change")
        after = frames[3].crop(slice(0, 15), slice(0, 18)) if other is small else frames[3]
        assert torch.equal(denoiser(after), first(after))


def test_there_are_no_tiles_of_a_state() -> None:
    with pytest.raises(InputError, match="expected a model that computes tiles of an image, found one without"):
        Denoiser(accumulated(), tile=64)


# Modules of one's own


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


def test_a_module_of_one_buffer_learns_the_best_exposure(small_sequence: Path, tmp_path: Path) -> None:
    path, _ = trained(f"{MINE}:Scaled", small_sequence, tmp_path / "run", steps=2, learning_rate=0.25)
    model = create_model(f"{MINE}:Scaled", weights=path)
    assert isinstance(model, FromBuffers)
    assert model.function.factor.item() != 1
    # It needs no albedo, and the sequence may have none.
    for file in (small_sequence / "inputs").glob("albedo*"):
        file.unlink()
    (small_sequence / "inputs" / "camera.json").write_text('{"color_includes_albedo": true}')
    assert trained(f"{MINE}:Scaled", small_sequence, tmp_path / "other", steps=1)[0].exists()


@pytest.mark.parametrize(
    ("factory", "changes", "expected"),
    [
        ("broken", {}, "expected curvature to train this model on, found no curvature"),
        ("forgetful", {}, "fails on a frame of color, motion, reference: RuntimeError: the state is gone"),
        ("Cropped", {}, "expected the stage 'image' of (1, 3, 16, 16), found (1, 3, 16, 8)"),
        ("Guided", {"losses": "image=1,initial=1"}, "losses: expected stages of the model (image), found 'initial'"),
        ("Guided", {"width": -1}, "width: expected at least 0, found -1"),
        ("plain", {"losses": "image=-1"}, "losses: expected weights of at least 0, found -1 for 'image'"),
        ("plain", {"losses": "input=0"}, "losses: expected one weight above 0 at least, found none"),
        ("plain", {"keep_fireflies": 2}, "keep_fireflies: expected a model that begins with Accumulated"),
        ("plain", {"settings": "height=3"}, "got an unexpected keyword argument 'height'; it takes width"),
        ("without_weights", {}, "expected one that learns, found one without weights"),
        ("no_such", {}, "expected a factory 'no_such'"),
    ],
)
def test_a_model_that_cannot_be_trained_leaves_no_run(
    small_sequence: Path, tmp_path: Path, factory: str, changes: dict[str, Any], expected: str
) -> None:
    with pytest.raises(InputError) as error:
        trained(f"{MINE}:{factory}", small_sequence, tmp_path / "run", **changes)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run" / "config.json").exists()
