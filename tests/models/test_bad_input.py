"""Every method refuses a frame, a state or a weights file that does not fit it, in one line, and computes nothing."""

import functools
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import refused
from test_models import KINDS, SIZES, TRAINABLE, WIDTH, tensors
from torch import Tensor, nn
from torch.utils import _pytree as pytree
from toys import small, whole_frame

from mcdenoise import Denoiser, Frame
from mcdenoise.errors import MissingBufferError
from mcdenoise.models import (
    Accumulated,
    Chain,
    Output,
    _registry,
    create_model,
    load_weights,
    register_model,
    save_weights,
)
from mcdenoise.models._registry import find_model
from mcdenoise.models._weights import pretrained_models
from mcdenoise.models._wrapper import as_model
from mcdenoise.models.accumulated import History
from mcdenoise.models.recurrent import Recurrent

HEIGHT, WIDE = 12, 16


@functools.cache
def model_of(name: str) -> Any:
    return small(name)


@functools.cache
def state_of(name: str, batch: int = 1) -> Any:
    model, state = model_of(name), None
    with torch.no_grad():
        for seed in range(2):
            _, state = model(whole_frame(model, HEIGHT, WIDE, batch, seed=seed), state)
    return state


def shape_of(state: Any) -> Any:
    """Kinds, names and shapes: what tells one state from another."""
    if state is None or isinstance(state, Tensor):
        return None if state is None else tuple(state.shape)
    if isinstance(state, History):
        # How much light lasts is kept where fireflies are clamped, and begins anew where it is missing.
        state = state._replace(light=None)
    parts = list(state.items()) if isinstance(state, dict) else list(enumerate(state))
    return type(state), [(name, shape_of(part)) for name, part in parts]


# Named, since to run every method while tests are collected would take a minute.
KEEPING = [name for name in KINDS if name not in ("noisy", "oidn", "oidn_open")]
DEMANDING = [name for name in KINDS if model_of(name).needs.buffers != {"color"}]


@torch.no_grad()
@pytest.mark.parametrize("name", DEMANDING)
def test_a_missing_buffer_is_named_with_methods_that_do_without(name: str) -> None:
    """The bare step and the denoiser name every buffer that is needed, if one is missing or all are."""
    model = model_of(name)
    whole = whole_frame(model, HEIGHT, WIDE)
    needed = sorted(model.needs.buffers - {"color"})
    for absent in (needed, *([each] for each in needed)):
        # A depth would come of positions and a camera.
        frame = whole.replace(**dict.fromkeys(absent), view_projection=None)
        messages = [refused(lambda frame=frame: model(frame)), refused(lambda frame=frame: Denoiser(model)(frame))]
        for message in messages:
            assert message.startswith("buffer")
            assert all(f"'{each}'" in message.partition(":")[0] for each in absent)
            others = message.partition("a model that does without: ")[2].split(", ")
            assert {*pretrained_models(), "joint_bilateral"} <= {name, *others}
            assert "noisy" not in others
            for other in others:
                assert model_of(other).needs.buffers <= frame.buffers
    with pytest.raises(MissingBufferError):
        model(Frame(whole.color))


def test_methods_that_would_do_are_found_without_drawing_numbers() -> None:
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    refused(lambda: model_of("svgf")(Frame(torch.rand(1, 3, 4, 5, generator=torch.Generator()))))
    assert torch.equal(torch.rand(2), expected)


@torch.no_grad()
@pytest.mark.parametrize("name", KINDS)
def test_buffers_of_use_come_and_go_within_a_shot(name: str) -> None:
    model = model_of(name)
    whole, denoiser = whole_frame(model, HEIGHT, WIDE), Denoiser(model)
    denoiser(whole)
    for absent in sorted(whole.buffers - model.needs.buffers - whole.extra.keys()):
        for frame in (whole.replace(**{absent: None}), whole):
            assert torch.isfinite(denoiser(frame)).all(), absent


@torch.no_grad()
def test_an_accumulated_buffer_that_comes_or_goes_begins_a_new_shot() -> None:
    frames = [whole_frame(model_of("kpcn"), HEIGHT, WIDE, seed=seed) for seed in range(4)]
    denoiser, alone = (Denoiser(model_of("kpcn")) for _ in range(2))
    reasons = []
    for number, frame in enumerate(frames):
        given = frame.replace(specular=None) if number in (1, 2) else frame
        image = denoiser(given)
        reasons.append(denoiser.report.reset)
        if number == 1:
            assert torch.equal(image, alone(given))
    other = "other buffers than in the frame before"
    assert reasons == ["first frame", other, "", other]


@torch.no_grad()
@pytest.mark.parametrize("name", KINDS)
def test_a_state_of_another_method_is_refused(name: str) -> None:
    """A state of the same parts, such as the accumulated radiance, is accepted; a method without a state reads none."""
    model, own = model_of(name), state_of(name)
    frame = whole_frame(model, HEIGHT, WIDE, seed=5)
    for other in KINDS:
        state = state_of(other)
        if state is None or shape_of(state) == shape_of(own):
            assert torch.isfinite(model(frame, state)[0].image).all()
        elif own is None:
            assert torch.equal(model(frame, state)[0].image, model(frame)[0].image)
        else:
            message = refused(lambda state=state: model(frame, state))
            assert message.startswith("state: expected what "), other


@torch.no_grad()
@pytest.mark.parametrize("name", KEEPING)
def test_an_invalid_state_is_refused(name: str) -> None:
    model = model_of(name)
    frame = whole_frame(model, HEIGHT, WIDE)
    for state in (frame.color, {}, {"a": frame.color}, (), (None,), (1, 2), "state", [frame.color, frame.color]):
        assert refused(lambda state=state: model(frame, state)).startswith("state: expected what ")


def altered(state: Any, change: Any) -> Any:
    return pytree.tree_map_only(Tensor, change, state)


@torch.no_grad()
@pytest.mark.parametrize("name", KEEPING)
def test_a_state_of_another_batch_device_or_precision_is_refused(name: str) -> None:
    model = model_of(name)
    frame, state = whole_frame(model, HEIGHT, WIDE, seed=5), state_of(name)
    message = refused(lambda: model(frame, state_of(name, 2)))
    assert "of a batch of 1 like 'color', found it of 2" in message
    message = refused(lambda: model(whole_frame(model, HEIGHT, WIDE, 2), state))
    assert "of a batch of 2 like 'color', found it of 1" in message
    message = refused(lambda: model(frame, altered(state, lambda leaf: leaf.to("meta"))))
    assert "on cpu like 'color', found it on meta" in message
    double = altered(state, lambda leaf: leaf.double() if leaf.is_floating_point() else leaf)
    assert "of frames of torch.float32, found it of frames of torch.float64" in refused(lambda: model(frame, double))
    denoiser = Denoiser(model)
    denoiser(frame)
    assert "reset the denoiser" in refused(lambda: denoiser(whole_frame(model, HEIGHT, WIDE, 2)))
    denoiser.reset()
    denoiser(whole_frame(model, HEIGHT, WIDE, 2))


@torch.no_grad()
@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("name", KEEPING)
def test_another_size_begins_a_new_shot(name: str, size: tuple[int, int]) -> None:
    model = model_of(name)
    frame = whole_frame(model, *size, seed=5)
    assert torch.equal(model(frame, state_of(name))[0].image, model(frame)[0].image)


@torch.no_grad()
def test_a_state_of_another_width_is_refused() -> None:
    frame = whole_frame(model_of("rae"), HEIGHT, WIDE)
    _, state = small("rae", width=6)(frame)
    assert "keeps in 8 channels, found 6" in refused(lambda: model_of("rae")(frame, state))


@torch.no_grad()
def test_wrappers_of_ones_own_refuse_one_anothers_states() -> None:
    def blur(color: Tensor) -> Output:
        return Output(color)

    frame = whole_frame(model_of("kp"), HEIGHT, WIDE)
    wearing = {
        "accumulated": Accumulated(as_model(blur)),
        "recurrent": Recurrent(as_model(blur)),
        "chain": Chain(one=Accumulated(as_model(blur)), two=Recurrent(as_model(blur))),
        "both": Accumulated(Recurrent(as_model(blur))),
    }
    states = {name: model(frame)[1] for name, model in wearing.items()}
    for name, model in wearing.items():
        model(frame, states[name])
        for other in wearing.keys() - {name}:
            # A method without a state looks at none, and one may begin beside a history that goes on.
            if {name, other} != {"accumulated", "both"}:
                message = refused(lambda model=model, other=other: model(frame, states[other]))
                assert message.startswith("state: expected what ")
    message = refused(lambda: wearing["recurrent"](frame, states["accumulated"]))
    assert "expected what recurrent keeps of a frame, found (what accumulated keeps, None)" in message


@functools.cache
def weights_of(name: str) -> bytes:
    settings = {"width": WIDTH} if "width" in find_model(name).architecture else {}
    return save_weights(model_of(name), name, settings, {})


@pytest.mark.parametrize("name", TRAINABLE)
def test_weights_of_another_method_or_width_are_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    for other in TRAINABLE:
        path.write_bytes(weights_of(other))
        if other != name:
            message = refused(lambda: create_model(name, weights=path))
            assert f"expected weights of model '{name}', found those of '{other}'" in message
            assert refused(lambda: Denoiser(name, weights=path)) == message
    path.write_bytes(weights_of(name))
    architecture = find_model(name).architecture
    size = {"width": 2 * WIDTH} if "width" in architecture else {"layers": 2}
    message = refused(lambda: load_weights(path, name, **size))
    ((setting, value),) = size.items()
    assert message.startswith(f"model '{name}': expected no settings")
    assert f" beside its weights, found {setting}={value}; the weights fix " in message


def test_weights_of_a_model_in_a_wrapper_are_those_of_the_model(tmp_path: Path) -> None:
    """Names in messages do not include wrappers; for another model in the same wrapper, the message names a layer."""
    path = tmp_path / "weights.safetensors"
    path.write_bytes(save_weights(Recurrent(model_of("kp")), "kp", {"width": WIDTH}, {}))
    loaded = create_model("kp", weights=path)
    assert list(loaded.state_dict()) == list(model_of("kp").state_dict())
    path.write_bytes(save_weights(Recurrent(model_of("mrkp")), "kp", {"width": WIDTH}, {}))
    message = refused(lambda: create_model("kp", weights=path))
    assert "layer '" in message
    assert "model 'kp' expects " in message


def test_a_network_without_weights_says_which_have_them() -> None:
    @register_model("unweighted", "a network for this test", kind="kernel")
    def unweighted() -> nn.Module:
        return nn.Conv2d(3, 3, 1)

    try:
        message = refused(lambda: Denoiser("unweighted"))
        assert "'unweighted': expected shipped weights, found them only for: " in message
    finally:
        _registry.MODELS.pop("unweighted")


def test_states_are_of_tensors_that_these_tests_look_at() -> None:
    assert [name for name in KINDS if state_of(name) is not None] == KEEPING
    assert all(tensors(state_of(name)) for name in KEEPING)
