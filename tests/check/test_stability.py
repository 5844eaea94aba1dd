"""The checks of numerical stability: the ops pass, and what is unstable fails."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from commands import refuses, run
from torch import Tensor

from mcdenoise.check.cases import OPS, Op
from mcdenoise.check.stability import _models, check_case, check_denoiser, check_model, check_op, long_runs
from mcdenoise.check.stability._trial import backends
from mcdenoise.ops import _backend, _op, kernel_conv
from mcdenoise.ops._op import op, plain

BY_NAME = {op.name: op for op in OPS}


def failures(op: Op, dtype: torch.dtype = torch.float32) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for check in check_op(op, (dtype,)):
        if not check.passed:
            assert check.message
            found.setdefault(check.what, set()).add(check.case)
    return found


def like(name: str, function: Callable[..., Any], **changes: Any) -> Op:
    op = replace(BY_NAME[name], function=function, **changes)
    function.__name__ = name
    return op


# Those with 25 or more taps, or all pixels, at each of many cases take half a minute.
SLOW = ("affinity_filter", "atrous", "moments_variance", "temporal_gradient")


# bfloat16 and float16 use the same code in the ops; `mcdenoise stability` checks all dtypes and cases.
@pytest.mark.parametrize(
    "op", [pytest.param(op, marks=[pytest.mark.slow] if op.name in SLOW else []) for op in OPS], ids=lambda op: op.name
)
def test_every_op_is_stable(op: Op) -> None:
    # In float64 all of them equal their equation, and the command has them all.
    cases = op.cases[::2]
    checks = list(check_op(replace(op, cases=cases), (torch.float32,)))
    assert not [f"{check.what}, {check.case}: {check.message}" for check in checks if not check.passed]
    for what in ("forward", "gradient"):
        assert {check.case for check in checks if check.what == what} == {case.name for case in cases}


def test_sums_in_half_precision_fail() -> None:
    def halved(image: Tensor, kernel: Tensor, *, border: str) -> Tensor:
        taps = [
            kernel_conv(image, kernel * one, border="zeros") for one in torch.eye(kernel.shape[1])[:, :, None, None]
        ]
        total = taps[0]
        for tap in taps[1:]:
            total = total + tap
        return total

    cases = tuple(case for case in BY_NAME["kernel_conv"].cases if case.settings.get("border") == "zeros")[:2]
    assert "forward" in failures(like("kernel_conv", halved, cases=cases), torch.bfloat16)
    # In float32 the same sum is accurate enough.
    assert not failures(like("kernel_conv", halved, cases=cases), torch.float32).get("forward")


def test_a_softmax_that_overflows_fails() -> None:
    op = BY_NAME["cross_bilateral_weights"]

    def naive(
        kernel: Tensor, guides: Any, falloffs: Any, distance_falloff: Any, *, border: Any = "replicate", **_: Any
    ) -> Tensor:
        one = torch.ones_like(kernel)
        falloff = op.function(one, guides, falloffs, distance_falloff, normalize="none", border=border)
        weights = falloff * torch.exp(kernel)
        return weights / weights.sum(1, keepdim=True)

    cases = tuple(case for case in op.cases if case.settings.get("normalize") != "none")
    found = failures(like("cross_bilateral_weights", naive, cases=cases))
    assert {"logits to +-1e4", "logits of -1e4", "logits of 1e4"} <= found["forward"] & found["weights"]
    assert not found["forward"] & {case.name for case in cases if case.kind == "ordinary"}


def test_a_nan_gradient_fails() -> None:
    def clamped(color: Tensor, albedo: Tensor, *, floor: float = 0.04) -> Tensor:
        divided = color / albedo
        return torch.where(albedo.amax(1, keepdim=True) >= 1e-4, color / albedo.clamp_min(floor), color + 0 * divided)

    found = failures(like("demodulate", clamped))
    assert "albedo 0" in found["gradient"]


@pytest.mark.parametrize("scale", [1 + 1e-5, 1 - 1e-5])
def test_an_error_of_a_hundred_rounding_errors_fails(scale: float) -> None:
    def scaled(image: Tensor, albedo: Tensor) -> Tensor:
        result: Tensor = BY_NAME["remodulate"].function(image, albedo)
        return result if result.dtype == torch.float64 else result * scale

    ordinary = tuple(case for case in BY_NAME["remodulate"].cases if case.kind == "ordinary" and not case.settings)
    assert failures(like("remodulate", scaled, cases=ordinary))["forward"] == {case.name for case in ordinary}


@op("numba")
def two_forms(image: Tensor) -> Tensor:
    return plain(BY_NAME["downsample"].function)(image)


def test_backends_are_checked_and_unavailable_ones_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_op, "fast_form", lambda page, name: lambda image: 2 * two_forms.plain(image))
    tried = like("downsample", two_forms)
    assert backends(tried) == ("torch", "numba")
    assert backends(BY_NAME["upsample"]) == (None,)
    failed = {check.backend for check in check_case(tried, tried.cases[0], torch.float32) if not check.passed}
    assert failed == {"numba"}
    monkeypatch.setattr(_backend, "_missing", lambda: "is not there")
    (told,) = [check for check in check_case(tried, tried.cases[0], torch.float32) if check.backend == "numba"]
    assert told.passed
    assert "is not there" in told.message


def test_a_model_is_stable(monkeypatch: pytest.MonkeyPatch) -> None:
    # The command has all frames; ordinary light, none, much, uneven light, and one pixel suffice here.
    every = _models.frames()
    few = {name: every[name] for name in ("ordinary", "color 0", "color 1e+30", "uneven radiance", "albedo 0", "1x1")}
    monkeypatch.setattr(_models, "frames", lambda: few)
    checks = list(check_model("wild_small", (torch.float32,)))
    assert not [f"{check.what}, {check.case}: {check.message}" for check in checks if not check.passed]
    assert {(check.what, check.case) for check in checks} == {
        (what, x) for what in ("forward", "gradient") for x in few
    }


def test_derivatives_of_a_denoiser_in_black_pixels(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(
        "def root():\n    return lambda color: color.sqrt()\n\n"
        "def safe():\n    return lambda color: color.where(color > 0, 1).sqrt().where(color > 0, 0)\n"
    )
    found = {}
    for name in ("root", "safe"):
        checks = [each for each in check_denoiser(f"{path}:{name}", (torch.float32,)) if each.what == "gradient"]
        found[name] = {each.case for each in checks if not each.passed}
        assert len(checks) > len(found[name])
    assert found == {"root": {"uneven radiance", "color 0"}, "safe": set()}


OWN = """
def same():
    return lambda color: color

def brighter():
    return lambda color: color + 1

def negative():
    return lambda color: -color
"""


def test_a_users_model_is_checked(tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text(OWN)
    failed = {}
    for name in ("same", "brighter", "negative"):
        assert not list(check_model(f"{path}:{name}"))
        checks = list(check_denoiser(f"{path}:{name}", (torch.float32,)))
        assert {check.subject for check in checks} == {f"Denoiser, {path}:{name}"}
        failed[name] = {check.what for check in checks if not check.passed}
    assert failed == {"same": set(), "brighter": {"exposure"}, "negative": {"valid"}}


def test_long_runs() -> None:
    runs = {(run.case, run.dtype): run for run in long_runs(frames=300, moving_frames=60)}
    assert not [run for run in runs.values() if not run.passed]
    still = runs["still", "bfloat16"]
    # Errors in half precision are not zero, and close enough to the bound to make it meaningful.
    assert 0.01 * still.allowed < still.error < still.allowed < 0.05
    assert {name for name, _ in runs} == {"still", "moving", "average"}


def test_the_command_has_a_row_for_each_unusual_shot(tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text("def own():\n    return lambda color, normal: color * (normal.abs().sum(1, keepdim=True) - 0.05)\n")
    status, out, _ = run("stability", "--models", f"{path}:own", "--dtypes", "float32")
    assert status == 1
    rows = {}
    for case in ("depth 0 in some rows", "normal 0 in some rows", "albedo 93 in some rows"):
        (rows[case],) = (line for line in out.splitlines() if f" {case} " in line)
    assert [case for case, row in rows.items() if "FAILED" in row] == ["normal 0 in some rows"]


@pytest.mark.parametrize("arguments", [("sharpen",), ("--models", "unet"), ("--dtypes", "float8"), ("--frames", "0")])
def test_bad_usage_exits_with_2(arguments: tuple[str, ...]) -> None:
    refuses("stability", *arguments)
