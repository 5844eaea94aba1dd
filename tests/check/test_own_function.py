"""Checks of users' functions, by the command and in Python: correct ones pass, wrong ones fail or are rejected."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from commands import refuses, run, silently
from torch import Tensor

from mcdenoise.check import check_stability
from mcdenoise.check.own import LARGEST

OWN = '''
"""Somebody's own."""
import torch
from torch import Tensor

number = 3


def weighted(image: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """The mean of each channel over the whole batch, and the image minus the mean."""
    mean = (image * weight).sum((0, 2, 3)) / weight.sum()
    return mean, image - mean[:, None, None]


def inputs():
    return torch.rand(2, 3, 2, 3), torch.rand(2, 1, 2, 3) + 0.5


class Square(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image):
        ctx.save_for_backward(image)
        return image * image

    @staticmethod
    def backward(ctx, gradient):
        (image,) = ctx.saved_tensors
        return 1.5 * image * gradient


def wrong(image):
    return Square.apply(image)


wrong.example_inputs = {"dark": (torch.full((1, 1, 2, 2), 1e-3),), "bright": (torch.full((1, 1, 2, 2), 1e3),)}


def logarithm(image):
    return torch.log(1 + image)


logarithm.example_inputs = lambda: {"ordinary": (torch.rand(1, 3, 2, 2) + 1,), "dark": (torch.full((2, 2), 1e-5),)}


def counts(image):
    return image.argmax()


counts.example_inputs = (torch.rand(3),)


def fails(image):
    raise RuntimeError("no luck\\ntoday")


fails.example_inputs = (torch.rand(3),)


def same(inputs):
    def function(image):
        return image

    function.example_inputs = inputs
    return function


def no_image():
    raise OSError("no such image")


integers, alone, undrawn = same((torch.arange(3),)), same(torch.rand(3)), same(no_image)
large = same(lambda: (torch.rand(1, 3, 64, 64),))
'''


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(OWN)
    return path


def test_a_correct_derivative_passes(mine: Path, tmp_path: Path) -> None:
    path = tmp_path / "gradcheck.json"
    out = silently("gradcheck", f"{mine}:weighted", "demodulate", "--json", path)
    results = json.loads(path.read_text())
    first = results[0]
    assert (first["op"], first["case"], first["inputs"]) == (f"{mine}:weighted", "example", ["image", "weight"])
    assert {result["op"] for result in results[1:]} == {"demodulate"}
    assert out.splitlines()[-1] == f"{len(results)} checks, 0 failed"


def test_a_wrong_derivative_exits_with_1(mine: Path, tmp_path: Path) -> None:
    path = tmp_path / "gradcheck.json"
    status, out, _ = run("gradcheck", f"{mine}:wrong", "--json", path)
    assert status == 1
    assert out.splitlines()[-1] == "2 checks, 2 failed"
    results = json.loads(path.read_text())
    assert [result["case"] for result in results] == ["dark", "bright"]
    # The square of 1e3 has the derivative 2e3, and the wrong one is three quarters of it.
    assert results[1]["message"].endswith("the difference quotient 2000 and the derivative 1500")
    assert results[0]["message"].startswith("Jacobian mismatch for output 0 with respect to input 0: element 0 of ")


def test_a_stable_function_passes(mine: Path, tmp_path: Path) -> None:
    path = tmp_path / "stability.json"
    silently("stability", f"{mine}:weighted", "--json", path)
    checks = json.loads(path.read_text())["checks"]
    assert {check["subject"] for check in checks} == {f"{mine}:weighted"}
    assert [(check["dtype"], check["what"]) for check in checks] == [
        ("float64", "derivative"),
        *((dtype, what) for dtype in ("float32", "bfloat16", "float16") for what in ("forward", "gradient")),
    ]
    # Each pixel depends on all images of the batch, so perturbed inputs must not share a batch.
    assert all(check["error"] > 0 for check in checks[1::2])


def test_cancellation_fails_in_the_case_where_it_occurs(mine: Path, tmp_path: Path) -> None:
    path = tmp_path / "stability.json"
    status, _, _ = run("stability", f"{mine}:logarithm", "--dtypes", "float32", "--json", path)
    assert status == 1
    failed = [check for check in json.loads(path.read_text())["checks"] if not check["passed"]]
    assert {(check["case"], check["what"]) for check in failed} == {("dark", "forward")}


@pytest.mark.parametrize("command", ["gradcheck", "stability"])
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("absent", "expected a function 'absent' in {path}, found "),
        ("number", "expected a function of tensors, found int"),
        ("Square", "expected a function of tensors, found a class"),
        ("counts", "expected one or several floating-point tensors of it, found torch.int64"),
        ("fails", "it fails in float64: RuntimeError: no luck today"),
        ("integers", "expected a floating-point tensor as example input 1, found torch.int64 of (3,)"),
        ("alone", "expected a tuple of tensors as example inputs, or several by name, found Tensor"),
        ("large", f"expected at most {LARGEST} numbers in the example inputs, found 12288"),
        ("undrawn", "its example inputs fail: OSError: no such image"),
    ],
)
def test_functions_that_cannot_be_checked_are_rejected_in_one_line(
    mine: Path, command: str, name: str, message: str
) -> None:
    assert message.format(path=mine) in refuses(command, f"{mine}:{name}")


def test_images_are_drawn_for_a_function_without_example_inputs(tmp_path: Path) -> None:
    mine, path = tmp_path / "mine.py", tmp_path / "own.json"
    mine.write_text(
        "def power(image, other, exponent=2):\n    return image**exponent + other\n\n"
        "def norm(image):\n    return image.square().sum(1).sqrt()\n\n"
        "def mean(image):\n    return (image**2).mean((2, 3)).clamp_min(1e-6).sqrt()\n\n"
        "import torch\nmodule = torch.nn.AvgPool2d(2)\n"
    )

    def failed(name: str, dtype: str) -> set[tuple[str, str]]:
        status = run("stability", f"{mine}:{name}", "--dtypes", dtype, "--json", path)[0]
        found = {(x["case"], x["what"]) for x in json.loads(path.read_text())["checks"] if not x["passed"]}
        assert status == bool(found)
        return found

    assert run("gradcheck", f"{mine}:power", "--json", path)[0] == 0
    assert [result["inputs"] for result in json.loads(path.read_text())] == [["image", "other"]]
    assert run("gradcheck", f"{mine}:module", "--json", path)[0] == 0
    assert failed("power", "float32") == set()
    # The derivative of a root at 0 is infinite or NaN, and a square leaves the range: those of 1e30 and 1e-30 that of
    # float32, and that of 300 the one of half precision.
    squares = {(f"radiance {value}", what) for value in ("1e+30", "1e-30") for what in ("forward", "gradient")}
    assert failed("norm", "float32") == {("black", "gradient"), *squares}
    assert {("bright", "forward"), ("firefly", "forward")} <= failed("mean", "float16")
    assert {case for case, _ in failed("mean", "float32")} == {"radiance 1e+30"}


def test_an_infinite_input_may_have_an_infinite_result_but_no_nan_in_the_gradient_of_a_finite_one() -> None:
    def masked(depth: Tensor) -> Tensor:
        return torch.where(depth.isinf(), 0, depth * depth.exp())

    depth = torch.tensor([1.0, torch.inf])

    def failed(function: Callable[[Tensor], Tensor]) -> set[str]:
        checks = check_stability(function, depth, dtypes=(torch.float32,))
        return {check.what for check in checks if not check.passed} - {"derivative"}

    assert failed(torch.relu) == set()
    assert failed(masked) == {"gradient"}
