"""A step never waits for a device: shown on a processor, where what would wait can be counted.

Three proofs, of every method of the zoo. A dispatch mode sees every operator of torch, and counts those that hand a
value to the host or whose result has a size that depends on values, and constants that come from the host. Tensors of
the device ``meta`` have no values at all: an operation that asks for one fails, in whatever way it asks. And the images
are those of a step that looks.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import kornia  # noqa: F401 - makes constants when it is first imported
import pytest
import torch
from reads import without_reads
from refusals import refused
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from toys import Same, one_of_each, small, whole_frame

from mcdenoise import Denoiser, Frame, InputError, create_model, ops
from mcdenoise.models import Accumulated, Demodulated, _report, _times, list_models
from mcdenoise.models._report import FrameReport
from mcdenoise.models._times import Stopwatch
from mcdenoise.models._wrapper import FromBuffers

# Open Image Denoise is a library for processors here: images go there and back, which waits.
ON_THE_HOST = {"oidn", "oidn_temporal"}
MODELS = [name for name in one_of_each(list_models()) if name not in ON_THE_HOST]
SIZE = (40, 56)

READS = {
    *("_local_scalar_dense", "item", "is_nonzero", "equal", "allclose"),
    # Their result has as many elements as the values say.
    *("nonzero", "masked_select", "unique_consecutive", "_unique", "_unique2", "unique_dim", "bincount", "histc"),
    # A constant that the host made.
    "lift_fresh",
}


class Reads(TorchDispatchMode):
    """Counts the operators that would make the host wait for a device."""

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[str] = Counter()

    def __torch_dispatch__(self, function: Any, types: Any, given: Any = (), named: Any = None) -> Any:
        name = function._schema.name.removeprefix("aten::")
        by_mask = name in ("index", "index_put", "index_put_", "_index_put_impl_") and any(
            index is not None and index.dtype in (torch.bool, torch.uint8) for index in given[1]
        )
        by_counts = name == "repeat_interleave" and function._overloadname != "self_int"
        if name in READS or by_mask or by_counts:
            self.found[name] += 1
        return function(*given, **(named or {}))


def shot(model: Any, count: int = 3) -> list[Frame]:
    return [whole_frame(model, *SIZE, seed=seed) for seed in range(count)]


def as_on_a_gpu(denoiser: Denoiser, frames: list[Frame]) -> tuple[list[Tensor], Counter[str]]:
    """Images of a shot, and what was read meanwhile; without forms for processors."""
    images = []
    with ops.use("torch"), without_reads(), Reads() as reads:
        for frame in frames:
            images.append(denoiser(frame))
    return images, reads.found


@pytest.mark.parametrize("name", MODELS)
def test_a_step_reads_nothing(name: str) -> None:
    model = small(name)
    images, reads = as_on_a_gpu(Denoiser(model), shot(model))
    assert not reads
    assert all(torch.isfinite(image).all() for image in images)


def test_a_step_with_layers_alpha_and_stages_reads_nothing() -> None:
    model = small("cascaded")
    denoiser, frames = Denoiser(model, alpha=True), shot(model)
    with ops.use("torch"), without_reads(), Reads() as reads:
        for frame in frames:
            layers = {"diffuse": 0.25 * frame.color, "glossy": 0.5 * frame.color}
            output = denoiser.output(frame.replace(layers=layers, alpha=torch.ones(1, 1, *SIZE)))
    assert not reads.found
    assert set(output.layers) == {"diffuse", "glossy"}


@pytest.mark.parametrize("name", MODELS)
@torch.no_grad()
def test_a_step_runs_without_any_values(name: str) -> None:
    model: Any = small(name)
    frames = shot(model, 2)
    if isinstance(model, nn.Module):
        model.to("meta")
    state = None
    for frame in frames:
        output, state = model(frame.to("meta").repaired()[0], state)
        assert output.image.shape == (1, 3, *SIZE)
        assert output.image.device.type == "meta"


WAYS: dict[str, Callable[[Tensor], object]] = {
    "item": lambda x: x.sum().item(),
    "bool": lambda x: bool((x > 0).any()),
    "mask": lambda x: x[x > 0],
    "equal": lambda x: torch.equal(x, x + 1),
    "nonzero": lambda x: x.nonzero(),
    "constant": lambda x: torch.tensor([1.0, 2.0]),
    "put": lambda x: x.clone().index_put_((x > 3,), torch.zeros_like(x[0])),
}


@pytest.mark.parametrize("way", WAYS)
def test_the_counter_sees_a_read(way: str) -> None:
    x = torch.rand(5)
    with Reads() as reads:
        WAYS[way](x)
    assert reads.found


@pytest.mark.parametrize("name", ["wild_small", "kpcn", "nppd", "rae", "bmfr", "joint_bilateral"])
def test_the_images_are_those_of_a_step_that_looks(name: str) -> None:
    model = small(name)
    frames = shot(model)
    # After a still frame comes a cut: nothing of the frame before is seen again.
    frames += [frames[-1].replace(motion=torch.zeros(1, 2, *SIZE))]
    frames += [frames[0].replace(motion=torch.full((1, 2, *SIZE), 1e4)), frames[1]]
    found, _ = as_on_a_gpu(Denoiser(model), frames)
    denoiser = Denoiser(model, keep_all=True)
    with ops.use("torch"):
        expected = [denoiser(frame) for frame in frames]
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


def test_a_report_is_complete_when_it_is_asked_for() -> None:
    model = create_model("wild_small", pretrained=True)
    frames = shot(model, 2)
    frames[1].color[0, :, 5, 6:9] = torch.nan
    denoiser = Denoiser(model)
    as_on_a_gpu(denoiser, frames)
    looking = Denoiser(model, keep_all=True)
    with ops.use("torch"):
        for frame in frames:
            looking(frame)
    report, expected = denoiser.report, looking.report
    assert report.replaced_pixels == expected.replaced_pixels == 3
    assert report.history == pytest.approx(expected.history)
    assert set(report.milliseconds) == set(expected.milliseconds)
    assert report.stages["noise-free pixels"] == expected.stages["noise-free pixels"]


def test_a_cut_is_told_late() -> None:
    denoiser = Denoiser(Demodulated(Accumulated(Same())))
    frames = shot(denoiser.model, 2)
    as_on_a_gpu(denoiser, [frames[0], frames[1].replace(motion=torch.full((1, 2, *SIZE), 1e4))])
    assert denoiser.report.reset == "cut"


BAD = {
    "normal": (torch.nan, "buffer 'normal': expected finite values"),
    "depth": (-1.0, "buffer 'depth': expected values in [0, inf]"),
    "albedo": (7.0, "buffer 'albedo': expected values in [0, 1]"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_values_are_told_a_frame_late_and_the_history_begins_anew(name: str) -> None:
    value, message = BAD[name]
    denoiser = Denoiser(Demodulated(Accumulated(Same())))
    good = shot(denoiser.model, 3)
    bad = good[1].replace(**{name: torch.full_like(good[1].buffer(name), value)})
    with ops.use("torch"), without_reads():
        denoiser(good[0])
        denoiser(bad)
        told = refused(lambda: denoiser(good[2]))
        assert told.startswith(message)
        assert told.endswith("(of the last frame, told a frame late; the history begins anew)")
        denoiser(good[2])
        assert denoiser.report.reset == "first frame"
        denoiser(bad)
        assert refused(lambda: denoiser.report).startswith(message)
        assert denoiser.report.history is not None


def test_layers_that_are_no_parts_and_images_that_are_not_finite_are_told_late() -> None:
    denoiser, broken = Denoiser(Same()), Denoiser(FromBuffers(lambda color: color / 0))
    (frame,) = shot(denoiser.model, 1)
    with without_reads():
        denoiser.output(frame.replace(layers={"twice": 2 * frame.color}))
        broken(frame)
    assert refused(lambda: denoiser.report).startswith("layers: expected parts of the color, found twice brighter")
    assert f"found {SIZE[0] * SIZE[1]} NaN or infinite pixels" in refused(lambda: broken.report)


def test_repairs_are_those_of_validation() -> None:
    frame = whole_frame(small("wild_small"), *SIZE)
    frame.color[0, 1, 3, 4] = torch.inf
    frame.color[0, 0, 20, 30:33] = -1
    frame = frame.replace(albedo=frame.albedo * 1.9, normal=frame.normal * 1.001, layers={"half": frame.color / 2})
    expected, count = frame.validate()
    repaired, numbers, judge = frame.repaired()
    assert judge(numbers.tolist()).pixels == count == 4
    for name, value in expected.items():
        assert torch.equal(value, repaired.buffer(name)), name
    assert torch.equal(repaired.layers["half"], expected.layers["half"])
    late = frame.replace(albedo=torch.where(frame.depth == torch.inf, 9, 0.5).expand(-1, 3, -1, -1))
    _, numbers, judge = late.repaired()
    with pytest.warns(UserWarning, match="buffer 'albedo'"):
        judge(numbers.tolist())


class Event:
    """A stand-in for ``torch.cuda.Event``, of a device that is as fast as this processor."""

    waits = 0

    def __init__(self) -> None:
        self.time = time.perf_counter() * 1e3

    def synchronize(self) -> None:
        Event.waits += 1

    def elapsed_time(self, end: Event) -> float:
        return end.time - self.time


class Behind(Stopwatch):
    @property
    def runs_behind(self) -> bool:
        return True

    def mark(self) -> Event:
        return Event()


def test_a_streamed_frame_waits_for_no_mark(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_times, "Stopwatch", Behind)
    monkeypatch.setattr(_report, "Stopwatch", Behind)
    model = small("wild_small")
    denoiser = Denoiser(model)
    frames = shot(model, 2)
    with ops.use("torch"), without_reads():
        denoiser(frames[0])
        denoiser.report  # noqa: B018
        Event.waits = 0
        denoiser(frames[1])
        assert Event.waits == 0
        assert {"validate", "accumulate", "network"} <= denoiser.report.milliseconds.keys()
        assert Event.waits > 0


def test_all_are_told_before_one_that_fails_is_heard() -> None:
    told: list[list[float]] = []

    def refuse(numbers: Any) -> None:
        told.append(list(numbers))
        raise InputError("no")

    found = FrameReport()
    with without_reads():
        found.ask(torch.tensor([1.0, 2.0]), refuse)
        found.ask(torch.tensor(True), lambda numbers: told.append(list(numbers)))
        assert not told
        found.send()
    assert refused(found.settle) == "no"
    assert told == [[1.0, 2.0], [1.0]]
