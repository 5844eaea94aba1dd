"""Properties of every model of the zoo, whatever its weights are; the tests read the register."""

import hashlib
import inspect
import json
import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import refused
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.utils import _pytree as pytree
from toys import one_of_each, small, whole_frame

from mcdenoise import Frame
from mcdenoise.frame import RADIANCE, Hints, scale_samples
from mcdenoise.methods import parse_method
from mcdenoise.models import (
    DEFAULT,
    Accumulated,
    Model,
    Needs,
    Output,
    create_model,
    describe_weights,
    list_models,
    load_weights,
    register_model,
    save_weights,
)
from mcdenoise.models._registry import find_model
from mcdenoise.models._weights import compared_models, pretrained_models
from mcdenoise.models._wrapper import as_model, parts_of
from mcdenoise.nn.oidn import oidn_exposure

SHIPPED = Path(__file__).parents[2] / "mcdenoise" / "models" / "weights"
WIDTH = 8
MODELS = list_models()
KINDS = one_of_each(MODELS)
DIFFERENTIABLE: dict[str, dict[str, Any]] = {"oidn_temporal": {"engine": "torch"}}
FAMILY = ["wild", "wild_large", "wild_small"]
SIZES = [(1, 1), (5, 7), (17, 33)]


def trainable(name: str) -> bool:
    return bool(find_model(name).construct) and create_model(name).needs.trainable


TRAINABLE = [name for name in KINDS if trainable(name)]


def tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in pytree.tree_leaves(tree) if isinstance(leaf, Tensor)]


@pytest.mark.parametrize("name", MODELS)
def test_a_model_says_what_it_needs(name: str) -> None:
    model = create_model(name)
    assert isinstance(model, Model)
    needs = model.needs
    assert isinstance(needs, Needs)
    assert "color" in needs.buffers
    known = whole_frame(model, 3, 4).buffers
    assert needs.buffers | needs.uses <= known | {"previous_position"}
    assert needs.reach is None or needs.reach >= 0
    assert needs.stride >= 1
    parameters = list(model.parameters()) if isinstance(model, nn.Module) else []
    assert bool(parameters) or not needs.trainable
    assert as_model(model) is model
    if isinstance(model, nn.Module):
        assert not model.training
        assert {parameter.dtype for parameter in parameters} <= {torch.float32}


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("name", KINDS)
@torch.no_grad()
def test_images_of_any_size(name: str, size: tuple[int, int]) -> None:
    model, state = small(name), None
    for seed in range(3):
        frame = whole_frame(model, *size, seed=seed)
        output, state = model(frame, state)
        assert isinstance(output, Output)
        for stage, image in {**output.stages, "image": output.image}.items():
            assert image.shape == (1, 3, *size), stage
            assert image.dtype == torch.float32, stage
            assert torch.isfinite(image).all(), stage
        assert (output.image >= 0).all()


@pytest.mark.parametrize("name", KINDS)
@torch.no_grad()
def test_a_step_is_a_pure_function(name: str) -> None:
    """The same frame and state give the same image and state, and are not changed."""
    model, state = small(name), None
    for seed in range(3):
        frame = whole_frame(model, 24, 40, seed=seed)
        before = pytree.tree_map_only(Tensor, torch.clone, (frame, state))
        output, after = model(frame, state)
        for one, other in zip(pytree.tree_leaves((frame, state)), pytree.tree_leaves(before), strict=True):
            assert one is other or torch.equal(one, other)
        model(whole_frame(model, 24, 40, seed=seed + 10), state)
        again, same = model(frame, state)
        for one, other in zip(tensors((again, same)), tensors((output, after)), strict=True):
            # Beyond the pixels' own rounding, if a library sums in an order of its own each time.
            assert torch.equal(one, other)
        state = after


@pytest.mark.parametrize("name", KINDS)
@torch.no_grad()
def test_a_state_is_of_tensors_with_the_batch_first_and_of_one_structure(name: str) -> None:
    """The frames move, then stand still, and then there is a cut."""
    model, state, structures, batch = small(name), None, [], 2
    for number in range(6):
        frame = whole_frame(model, 24, 40, batch, seed=number)
        if number in (2, 3, 4):
            frame = frame.replace(motion=torch.zeros(batch, 2, 24, 40))
        _, state = model(frame, state)
        assert all(isinstance(leaf, Tensor) for leaf in tensors(state))
        assert {len(leaf) for leaf in tensors(state)} <= {batch}
        structures.append(dict(pytree.tree_flatten_with_path(state)[0]))
    # An absent tensor may appear, and disappear again; a tensor that is there keeps its number of axes.
    for before, after in pairwise(structures):
        for path in before.keys() & after.keys():
            pair = [each[path] for each in (before, after)]
            assert None in [None if one is None else 0 for one in pair] or pair[0].dim() == pair[1].dim(), path


@pytest.mark.parametrize("name", KINDS)
@torch.no_grad()
def test_images_of_a_batch_do_not_see_each_other(name: str) -> None:
    model = small(name)
    states: list[Any] = [None, None, None]
    for seed in range(2):
        both = whole_frame(model, 17, 20, batch=2, seed=seed)
        both.color[1] *= 1000
        alone = [both.map(lambda image, index=index: image[index : index + 1]) for index in (0, 1)]
        images = []
        for index, frame in enumerate((both, *alone)):
            output, states[index] = model(frame, states[index])
            images.append(output.image)
        # 2e-6 was measured: another batch size may sum in another order. Rounding grows with the light.
        together, apart = (
            image / torch.tensor([1, 1000]).reshape(2, 1, 1, 1) for image in (images[0], torch.cat(images[1:]))
        )
        torch.testing.assert_close(together, apart, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", [name for name in KINDS if name not in ("oidn", "oidn_temporal")])
@torch.no_grad()
def test_vmap_is_a_batch(name: str) -> None:
    model = small(name)
    frame = whole_frame(model, 17, 20, batch=2)
    apart = pytree.tree_map(lambda image: image[:, None], frame)
    mapped = torch.func.vmap(lambda each: model(each)[0].image)(apart)
    torch.testing.assert_close(mapped[:, 0], model(frame)[0].image, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", KINDS)
@torch.no_grad()
def test_hints_change_no_image(name: str) -> None:
    """They change none by more than the tolerance, and that of a single frame not at all."""
    model = small(name)
    frame = whole_frame(model, 24, 40)
    expected, _ = model(frame)
    for hints in (Hints(last=True), Hints(keep_all=True), Hints(stages=False)):
        output, _ = model(frame.replace(hints=hints))
        torch.testing.assert_close(output.image, expected.image, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", KINDS)
@torch.no_grad()
def test_the_declared_needs_suffice(name: str) -> None:
    """All or any of the buffers that are only useful may be missing."""
    model = small(name)
    whole = whole_frame(model, 17, 20)
    # Extra buffers are not of the frame's own.
    optional = sorted(whole.buffers - model.needs.buffers - whole.extra.keys())
    for absent in (optional, *([name] for name in optional)):
        frame = whole.replace(**dict.fromkeys(absent))
        assert model.needs.missing(frame) == []
        output, state = model(frame)
        again, _ = model(frame, state)
        for result in (output, again):
            assert result.image.shape == (1, 3, 17, 20), absent
            assert torch.isfinite(result.image).all(), absent
    assert model.needs.missing(Frame(whole.color)) == sorted(model.needs.buffers - {"color"})


@pytest.mark.parametrize("bare", [False, True], ids=["", "bare"])
# The squares of the first are near the smallest numbers of float32.
@pytest.mark.parametrize("factor", [2.0**-60, 1e5])
@pytest.mark.parametrize("name", KINDS)
@torch.no_grad()
def test_exposure_only_scales_the_result(name: str, factor: float, bare: bool) -> None:
    """Of a first and a second frame, with all features and without those that are only useful."""
    model = small(name)
    states: list[Any] = [None, None]
    for seed in range(2):
        frame = whole_frame(model, 33, 20, seed=seed)
        if bare:
            unneeded = frame.buffers - model.needs.buffers - {"motion"} - set(RADIANCE) - frame.extra.keys()
            frame = frame.replace(**dict.fromkeys(unneeded))
        result, states[0] = model(frame, states[0])
        light = {name: image * factor for name, image in frame.items() if name in RADIANCE}
        samples = None if frame.samples is None else scale_samples(frame.samples, torch.tensor([factor]))
        variance = None if frame.variance is None else frame.variance * factor**2
        scaled, states[1] = model(frame.replace(**light, samples=samples, variance=variance), states[1])
        torch.testing.assert_close(scaled.image / factor, result.image, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("name", sorted(set(KINDS) - {"oidn"}))
@torch.no_grad()
def test_half_precision_rounds_only_the_result(name: str, dtype: torch.dtype) -> None:
    """Of light whose squares overflow, and of dim light."""
    model = small(name)
    for factor in (1000, 2.0**-12):
        states: list[Any] = [None, None]
        for seed in range(2):
            frame = whole_frame(model, 24, 40, seed=seed)
            frame = frame.replace(color=frame.color * factor).to(dtype)
            rounded, states[0] = model(frame, states[0])
            exact, states[1] = model(frame.to(torch.float32), states[1])
            assert rounded.image.dtype == dtype
            error = (rounded.image.float() - exact.image).abs().mean() / exact.image.mean()
            assert error < torch.finfo(dtype).eps, (factor, seed)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
@pytest.mark.parametrize("name", TRAINABLE)
@torch.no_grad()
def test_the_unit_of_the_scene_does_not_matter(name: str, factor: float) -> None:
    model = small(name)
    frame = whole_frame(model, 17, 20)
    result, _ = model(frame)
    scaled, _ = model(frame.replace(depth=frame.depth * factor))
    torch.testing.assert_close(scaled.image, result.image, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", TRAINABLE)
def test_a_gradient_reaches_every_parameter(name: str) -> None:
    model, state, loss = small(name), None, torch.zeros(())
    for seed in range(2):
        output, state = model(whole_frame(model, 24, 24, seed=seed), state)
        for image in (output.image, *output.stages.values()):
            loss = loss + (image - 1).square().mean()
    loss.backward()
    for key, parameter in model.named_parameters():
        assert parameter.grad is not None, key
        assert torch.isfinite(parameter.grad).all(), key
        assert parameter.grad.abs().max() > 0, key


def hostile(model: Any, number: int) -> Frame:
    """A frame with black, saturated and even pixels, without albedo and hits at places; the fourth one is black."""
    frame = whole_frame(model, 24, 40, seed=number)

    def changed(name: str, image: Tensor) -> Tensor:
        image = image.clone()
        if name in RADIANCE or name == "samples":
            image[..., 2:5, 2:9], image[..., 8:12, 10:18], image[..., 13, :] = 0, 0.5, 1e-30
            image[..., 6, 3], image[..., 7, 12], image[..., 0, 0, 0] = 1e4, 6e4, 0
            image[..., 24 - 8 * number :, :] = 0
        elif name == "depth":
            image[..., 3:6, :], image[..., 10, 10], image[..., 12:14, 5:9] = torch.inf, 0, 3
        elif name in ("albedo", "normal", "specular_albedo", "roughness", "alpha"):
            image[..., 4:7, :], image[..., 12, 12] = 0, 1
        elif name == "motion":
            image[..., 9:, :], image[..., 0, :] = 0, 100
        return image

    given = [name for name in frame.buffers if name != "view_projection" and name not in frame.extra]
    return frame.replace(**{name: changed(name, getattr(frame, name)) for name in given})


@pytest.mark.parametrize("name", sorted(set(KINDS) - {"oidn"}))
def test_gradients_of_hostile_frames_are_finite(name: str) -> None:
    """In all buffers of four frames, the last of which is black, and in all weights."""
    model, state, loss = small(name, **DIFFERENTIABLE.get(name, {})), None, torch.zeros(())
    leaves: dict[str, Tensor] = dict(model.named_parameters())
    for number in range(4):
        frame = hostile(model, number)
        given = {key: image.requires_grad_() for key, image in frame.items() if key not in frame.extra}
        leaves |= {f"{key} of frame {number}": image for key, image in given.items()}
        output, state = model(frame, state)
        for image in (output.image, *output.stages.values()):
            assert torch.isfinite(image).all()
            loss = loss + (image * torch.linspace(0.5, 1.5, 40)).mean()
    leaves = {key: leaf for key, leaf in leaves.items() if leaf.requires_grad}
    found = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    for key, gradient in zip(leaves, found, strict=True):
        assert gradient is None or torch.isfinite(gradient).all(), key
    assert found[list(leaves).index("color of frame 0")] is not None


@pytest.mark.parametrize("name", ["wild_small", "svgf", "guided", "joint_bilateral"])
def test_gradients_are_those_of_difference_quotients(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a first frame in float64, along a direction that leaves black pixels and the largest ones as they are."""
    model = create_model(name, pretrained=name in pretrained_models()).double().eval()
    frame = whole_frame(model, 24, 40).to(torch.float64)
    frame.color[..., 3:9, 4:20] = 0
    # An exposure, which has no derivative by design, stays that of the frame.
    exposure = oidn_exposure(frame.color)
    monkeypatch.setattr("mcdenoise.models.wild.oidn_exposure", lambda color: exposure)
    generator = torch.Generator().manual_seed(0)
    direction = torch.randn(1, 3, 24, 40, dtype=torch.float64, generator=generator) * frame.color
    direction = torch.where(frame.color < frame.color.amax() / 2, direction, 0)

    def total(color: Tensor) -> Tensor:
        return (model(frame.replace(color=color))[0].image * torch.linspace(0.5, 1.5, 40)).sum()

    leaf = frame.color.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(total(leaf), leaf)
    with torch.no_grad():
        apart = [total(frame.color + sign * 1e-6 * direction) for sign in (1, -1)]
    expected = float(apart[0] - apart[1]) / 2e-6
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-5)


def even(height: int, width: int, model: Any) -> Frame:
    """A constant image with constant features; positions are those of a wall."""
    color = torch.tensor([0.8, 0.4, 0.2]).reshape(1, 3, 1, 1).expand(1, 3, height, width).clone()
    frame = whole_frame(model, height, width)
    given: dict[str, Tensor] = {"albedo": torch.full_like(color, 0.5), "depth": torch.full_like(color[:, :1], 2)}
    given |= {name: color.clone() for name in RADIANCE if name in frame.buffers}
    if frame.samples is not None:
        given["samples"] = color[:, None].expand_as(frame.samples).clone()
    if "length" in frame.buffers:
        given["length"] = torch.ones_like(color[:, :1])
    return frame.replace(**given)


@pytest.mark.parametrize("name", sorted(set(KINDS) - {"oidn"}))
@torch.no_grad()
def test_a_constant_image_stays_constant_at_every_size(name: str) -> None:
    """Up to its borders: it varies by little more than far from them, or than it is wrong there anyway."""
    plain = {"restore": False} if "restore" in inspect.signature(find_model(name).construct).parameters else {}
    model = create_model(name, pretrained=name in [*pretrained_models(), *compared_models()], **plain).eval()

    def ratios(height: int, width: int) -> Tensor:
        frame = even(height, width, model)
        return model(frame)[0].image / frame.color

    far = ratios(192, 192)[..., 64:128, 64:128]
    level = far.mean((2, 3), keepdim=True)
    bound = 0.025 + max(2 * float((far - level).abs().max()), float((far - 1).abs().max()))
    for size in ((1, 1), (3, 5), (17, 31), (33, 1), (96, 128)):
        assert float((ratios(*size) / level - 1).abs().max()) < bound, size


@pytest.mark.parametrize("name", TRAINABLE)
def test_a_gradient_goes_through_the_state(name: str) -> None:
    """It reaches the light of the first frame from the image of the third, in a direction that changes the image."""
    model = small(name)
    first, *others = (whole_frame(model, 24, 24, seed=seed) for seed in range(3))
    light = {name: image.requires_grad_() for name, image in first.items() if name in RADIANCE}
    _, state = model(first.replace(**light))
    if state is None:
        pytest.skip("it keeps no state")
    for frame in others:
        output, state = model(frame, state)
    # A method that is given the light in parts does not look at their sum.
    found = torch.autograd.grad(output.image.sum(), list(light.values()), allow_unused=True)
    gradients = [gradient for gradient in found if gradient is not None]
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert sum(float(gradient.abs().sum()) for gradient in gradients) > 0


def test_the_register() -> None:
    assert {"cascaded", *FAMILY} <= set(MODELS)
    assert sorted(MODELS) == MODELS
    assert list_models("wild_[ls]*") == ["wild_large", "wild_small"]
    assert set(FAMILY) == set(pretrained_models())
    assert DEFAULT in FAMILY
    message = refused(lambda: create_model("nothing"))
    assert message.startswith("model 'nothing': expected one of ")
    assert all(name in message for name in MODELS)
    with pytest.raises(ValueError, match="'cascaded'"):
        register_model("cascaded")(nn.Identity)


@pytest.mark.parametrize("name", MODELS)
def test_a_setting_that_is_none_is_refused_in_one_line(name: str) -> None:
    message = refused(lambda: create_model(name, nonsense=1))
    assert message.startswith(f"model '{name}': ")
    assert "'nonsense'" in message


@pytest.mark.parametrize(
    ("thing", "expected"),
    [
        (7, "found int"),
        (nn.Linear, "found the class Linear"),
        (lambda: 0, "found <lambda>()"),
        (lambda *images: 0, "found <lambda>(*images)"),
        (lambda frame: 0, "found <lambda>(frame)"),
    ],
)
def test_an_object_that_is_no_model_is_refused(thing: Any, expected: str) -> None:
    message = refused(lambda: as_model(thing))
    assert "expected a model with `needs` that takes (frame, state)" in message
    assert expected in message


def test_a_module_of_images_is_a_method() -> None:
    class Net(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.conv = nn.Conv2d(6, 3, 1)

        def forward(self, color: Tensor, albedo: Tensor, crypto: Tensor | None = None) -> Tensor:
            return self.conv(torch.cat([color, albedo], 1)) + (0 if crypto is None else crypto)

    model = as_model(net := Net())
    assert model.needs == Needs(frozenset({"color", "albedo"}), frozenset({"crypto"}), trainable=True, reach=None)
    frame = whole_frame(model, 4, 5).replace(extra={})
    expected = net(frame.color, frame.albedo)
    assert torch.equal(model(frame)[0].image, expected)
    # A buffer outside the vocabulary is found by its name, too.
    crypto = torch.rand(1, 3, 4, 5)
    assert torch.equal(model(frame.replace(extra={"crypto": crypto}))[0].image, expected + crypto)
    assert as_model(lambda color: Output(color, {"half": color / 2}))(frame)[0].stages.keys() == {"half"}


@pytest.mark.parametrize("name", [*TRAINABLE, "wild_small"])
@torch.no_grad()
def test_saved_and_loaded_it_is_the_same_model(name: str, tmp_path: Path) -> None:
    path, saved = tmp_path / "weights.safetensors", small(name)
    settings = {"width": WIDTH} if "width" in find_model(name).architecture else {}
    for parameter in saved.parameters():
        parameter.copy_(parameter.half().float())
    path.write_bytes(save_weights(saved, name, settings, {"steps": "7"}))
    assert {tensor.dtype for tensor in load_file(path).values()} == {torch.float16}
    assert describe_weights(path)["steps"] == "7"
    # Every setting that weights are of, whatever the code's defaults will be.
    assert describe_weights(path)["settings"] == {**find_model(name).architecture, **settings}
    frame = whole_frame(saved, 17, 20)
    for loaded in (load_weights(path), create_model(name, weights=path), load_weights(path, name)):
        assert not loaded.training
        assert torch.equal(loaded(frame)[0].image, saved(frame)[0].image)


def digest_of(tensors: dict[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for key, tensor in sorted(tensors.items()):
        digest.update(key.encode() + tensor.view(torch.int16).numpy().tobytes())
    return digest.hexdigest()


def altered(weights: Path, change: Callable[[dict[str, Tensor], dict[str, str]], object]) -> Path:
    """The file with other tensors or another header, and the digest of these."""
    tensors = load_file(weights)
    about = describe_weights(weights)
    header = {key: value if isinstance(value, str) else json.dumps(value) for key, value in about.items()}
    change(tensors, header)
    save_file(tensors, weights, header | {"sha256": digest_of(tensors)})
    return weights


def test_widths_without_channels_are_refused() -> None:
    for name in (each for each in list_models() if "width" in find_model(each).architecture):
        for width in (-1, 0, "wide"):
            assert "width" in refused(create_model, name, width=width)


def test_a_text_is_no_truth_value() -> None:
    message = refused(lambda: create_model("oidn_temporal", restore="false"))
    assert "restore" in message
    assert "'false'" in message
    assert parse_method("mine.py:make(this=false, that=TRUE)").settings == {"this": False, "that": True}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            lambda tensors, header: tensors.pop("initial.heads.0.weight"),
            "layer 'initial.heads.0.weight': model 'cascaded' expects (3, 8, 3, 3), found no such layer",
        ),
        (
            lambda tensors, header: tensors.update(third=torch.zeros(2, dtype=torch.float16)),
            "layer 'third': model 'cascaded' expects no such layer, found (2,)",
        ),
        (
            lambda tensors, header: header.update(settings=json.dumps(json.loads(header["settings"]) | {"width": 6})),
            "layer 'final.heads.0.weight': model 'cascaded' expects (28, 6, 3, 3), found (28, 8, 3, 3)",
        ),
        *(
            (
                lambda tensors, header, value=value: tensors["final.heads.0.bias"][3:4].fill_(value),
                "layer 'final.heads.0.bias': expected finite weights, found NaN or infinite ones",
            )
            for value in (torch.nan, torch.inf)
        ),
    ],
    ids=["missing", "unknown", "of another shape", "nan", "infinite"],
)
def test_a_layer_that_does_not_fit_is_named(weights: Path, change: Any, expected: str) -> None:
    assert expected in refused(lambda: load_weights(altered(weights, change)))


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("architecture", "other", "found those of 'other'"),
        ("architecture", "os:system", "'os:system'; a file names no code"),
        ("settings", "{", "header 'settings': expected a JSON object"),
        ("settings", "[1]", "header 'settings': expected a JSON object"),
        ("settings", {"colour": 1}, "found 'colour'"),
        ("settings", {"width": 10**9}, "expected for 'width'"),
        ("settings", {"width": float("nan")}, "expected for 'width'"),
        ("settings", {"width": {"of": 8}}, "expected for 'width'"),
        ("settings", {"bilateral": "a" * 1000}, "expected for 'bilateral'"),
        # A model of this width takes 5 GB.
        ("settings", {"width": 4000}, "expects "),
        ("settings", {"width": -1}, "width: expected at least 1, found -1"),
        ("settings", '{"width": 8}', "found no bilateral, cascade, kernel_size, normalize; save the weights again"),
    ],
)
def test_a_header_that_means_nothing_is_refused(weights: Path, key: str, value: Any, expected: str) -> None:
    if isinstance(value, dict):
        value = json.dumps({**describe_weights(weights)["settings"], **value})
    path = altered(weights, lambda tensors, header: header.update({key: value}))
    message = refused(lambda: load_weights(path))
    assert expected in message
    assert str(path) in message


def test_shipped_weights_fix_the_settings_that_determine_them() -> None:
    beside = (
        "model 'wild': expected no settings but alpha_min, anti_lag, tolerance, features beside its weights, found "
    )
    for setting, value in (("quality", "high"), ("size", "small")):
        message = refused(lambda given={setting: value}: create_model("wild", pretrained=True, **given))
        assert message.startswith(f"{beside}{setting}={value}; the weights fix size; ")
        assert message.endswith(": wild_large, wild_small")
    create_model("wild", pretrained=True, size="base")


def test_settings_in_a_name_are_refused_with_the_call_that_has_them() -> None:
    for name, call in (
        ("wild(tolerance=0.4)", 'Denoiser("wild", tolerance=0.4)'),
        ("oidn(quality=fast, clean=False)", 'Denoiser("oidn", quality="fast", clean=False)'),
        ("mine.py:make(radius=2)", 'Denoiser("mine.py:make", radius=2)'),
    ):
        message = refused(lambda name=name: create_model(name))
        assert f"'{name}'" in message
        assert call in message


def test_files_that_are_no_weights_are_refused(weights: Path, tmp_path: Path) -> None:
    whole = weights.read_bytes()
    for content in (b"", b"a text, and no tensors", whole[:-100], whole[:100]):
        weights.write_bytes(content)
        assert str(weights) in refused(lambda: load_weights(weights))
    save_file({"layer": torch.zeros(1)}, weights)
    assert "found no 'architecture' in the header" in refused(lambda: load_weights(weights))
    assert "No such file" in refused(lambda: load_weights(tmp_path / "nothing"))
    refused(lambda: load_weights(tmp_path))


def test_a_damaged_tensor_and_an_infinite_weight_are_refused(tmp_path: Path) -> None:
    model, path = create_model("cascaded", width=4), tmp_path / "cascaded.safetensors"
    content = bytearray(save_weights(model, "cascaded", {"width": 4}, {}))
    path.write_bytes(content)
    load_weights(path)
    content[-1] ^= 1
    path.write_bytes(content)
    assert "sha256" in refused(lambda: load_weights(path))
    with torch.no_grad():
        next(model.parameters()).flatten()[0] = 1e6  # more than half precision holds
    assert "NaN or infinite" in refused(lambda: save_weights(model, "cascaded", {"width": 4}, {}))


@pytest.mark.parametrize(
    "file", [*SHIPPED.glob("*.safetensors"), *SHIPPED.glob("compared/*.safetensors")], ids=lambda file: file.stem
)
def test_the_shipped_weights(file: Path) -> None:
    name, about = file.stem, describe_weights(file)
    model = create_model(name, pretrained=True)
    assert about["licence"] == "Apache-2.0"
    assert int(about["steps"]) == json.loads(about["config"])["steps"]
    assert all(re.fullmatch("[0-9a-f]{40}", part["commit"]) for part in json.loads(about["commits"]))
    with torch.no_grad():
        assert torch.isfinite(model(whole_frame(model, 33, 20))[0].image).all()


def test_compared_weights_have_equal_training_settings() -> None:
    """All but the steps: a method trains until its curve is flat."""
    about = {name: describe_weights(SHIPPED / "compared" / f"{name}.safetensors") for name in compared_models()}
    assert not set(about) & set(pretrained_models())
    own = {"model", "settings", "loss", "temporal_weight", "steps"}
    configs = [json.loads(each["config"]) for each in about.values()]
    assert len({json.dumps({k: v for k, v in each.items() if k not in own}) for each in configs}) == 1
    assert {each["initial_weights"] for each in about.values()} == {"none"}
    # Not their checksums: another processor renders the same takes with other roundings.
    data = [[(part["takes"], part["credits"]) for part in json.loads(each["data"])] for each in about.values()]
    assert all(part == data[0] for part in data)


def test_weights_in_bfloat16_load(weights: Path) -> None:
    def converted(tensors: dict[str, Tensor], header: dict[str, str]) -> None:
        tensors.update({key: tensor.bfloat16() for key, tensor in tensors.items()})

    expected = {key: value.bfloat16().float() for key, value in load_file(weights).items()}
    loaded = load_weights(altered(weights, converted))
    parameters = [parameter for _, parameter in sorted(loaded.named_parameters())]
    assert {parameter.dtype for parameter in parameters} == {torch.float32}
    assert torch.equal(parameters[0], expected["final.fusions.0.conv.bias"])


def test_weights_fit_with_and_without_wrappers(weights: Path) -> None:
    """A file holds the networks' weights alone: what is around them is not of its business."""
    names = set(load_file(weights))
    assert all(name.startswith(("initial.", "final.")) for name in names)
    loaded = load_weights(weights, alpha_min=0.3)
    assert [part.alpha_min for part in parts_of(loaded, Accumulated)] == [0.3]
