"""Checks of users' functions, by the command and in Python: correct ones pass, wrong ones fail or are rejected."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from mcdenoise.check import check_stability, gradcheck
from mcdenoise.check.own import LARGEST
from mcdenoise.cli import main
from mcdenoise.errors import InputError

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


def scaled(image, scale):
    return image * scale.round()


scaled.example_inputs = (torch.rand(1, 1, 2, 2, requires_grad=True), torch.rand(()) + 2)


def single(image):
    if image.dtype == torch.float16:
        raise RuntimeError("no kernel\\nfor [/half]")
    return 2 * image


single.example_inputs = (torch.ones(3),)


class Forgetful(Square):
    @staticmethod
    def backward(ctx, gradient):
        (image,) = ctx.saved_tensors
        return 2 * image.detach() * gradient


def forgetful(image):
    return Forgetful.apply(image)


forgetful.example_inputs = (torch.rand(2, 2) + 1,)


def counts(image):
    return image.argmax()


counts.example_inputs = (torch.rand(3),)


def fails(image):
    raise RuntimeError("no luck\\ntoday")


fails.example_inputs = (torch.rand(3),)


def integers(image):
    return image


integers.example_inputs = (torch.arange(3),)


def alone(image):
    return image


alone.example_inputs = torch.rand(3)


def large(image):
    return image


large.example_inputs = lambda: (torch.rand(1, 3, 64, 64),)


def undrawn(image):
    return image


def _fail():
    raise OSError("no such image")


undrawn.example_inputs = _fail
'''

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(OWN)
    return path


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def command(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main([*map(str, arguments)])
        out, err = capsys.readouterr()
        return int(stop.value.code or 0), out, err

    return command


def test_a_correct_derivative_passes(mine: Path, run: Run, tmp_path: Path) -> None:
    path = tmp_path / "gradcheck.json"
    status, out, err = run("gradcheck", f"{mine}:weighted", "demodulate", "--json", path)
    assert (status, err) == (0, "")
    results = json.loads(path.read_text())
    first = results[0]
    assert (first["op"], first["case"], first["inputs"]) == (f"{mine}:weighted", "example", ["image", "weight"])
    assert {result["op"] for result in results[1:]} == {"demodulate"}
    assert out.splitlines()[-1] == f"{len(results)} checks, 0 failed"


def test_a_wrong_derivative_exits_with_1(mine: Path, run: Run, tmp_path: Path) -> None:
    path = tmp_path / "gradcheck.json"
    status, out, _ = run("gradcheck", f"{mine}:wrong", "--json", path)
    assert status == 1
    assert out.splitlines()[-1] == "2 checks, 2 failed"
    results = json.loads(path.read_text())
    assert [result["case"] for result in results] == ["dark", "bright"]
    # The square of 1e3 has the derivative 2e3, and the wrong one is three quarters of it.
    assert results[1]["message"] == (
        "Jacobian mismatch for output 0 with respect to input 0: element 0 of the output in element 0 of the input has "
        "the difference quotient 2000 and the derivative 1500"
    )
    assert results[0]["message"].startswith("Jacobian mismatch for output 0 with respect to input 0: element 0 of ")


def test_a_stable_function_passes(mine: Path, run: Run, tmp_path: Path) -> None:
    path = tmp_path / "stability.json"
    status, _, err = run("stability", f"{mine}:weighted", "--json", path)
    assert (status, err) == (0, "")
    checks = json.loads(path.read_text())["checks"]
    assert {check["subject"] for check in checks} == {f"{mine}:weighted"}
    assert [(check["dtype"], check["what"]) for check in checks] == [
        ("float64", "derivative"),
        *((dtype, what) for dtype in ("float32", "bfloat16", "float16") for what in ("forward", "gradient")),
    ]
    # Each pixel depends on all images of the batch, so perturbed inputs must not share a batch.
    assert all(check["error"] > 0 for check in checks[1::2])


def test_a_wrong_derivative_is_not_stable(mine: Path, run: Run, tmp_path: Path) -> None:
    path = tmp_path / "stability.json"
    status, out, _ = run("stability", f"{mine}:wrong", "--dtypes", "float32", "--json", path)
    assert status == 1
    assert "FAILED: derivative, dark: Jacobian mismatch" in out
    failed = [check for check in json.loads(path.read_text())["checks"] if not check["passed"]]
    assert {check["what"] for check in failed} == {"derivative"}


def test_cancellation_fails_in_the_case_where_it_occurs(mine: Path, run: Run, tmp_path: Path) -> None:
    path = tmp_path / "stability.json"
    status, _, _ = run("stability", f"{mine}:logarithm", "--dtypes", "float32", "--json", path)
    assert status == 1
    failed = [check for check in json.loads(path.read_text())["checks"] if not check["passed"]]
    assert {(check["case"], check["what"]) for check in failed} == {("dark", "forward")}


def test_a_function_that_fails_in_one_precision(mine: Path, run: Run, tmp_path: Path) -> None:
    path = tmp_path / "stability.json"
    status, out, _ = run("stability", f"{mine}:single", "--json", path)
    assert status == 1
    # A table may wrap lines between words.
    assert "[/half]" in out
    (failed,) = [check for check in json.loads(path.read_text())["checks"] if not check["passed"]]
    assert (failed["dtype"], failed["what"]) == ("float16", "runs")
    assert failed["message"] == "RuntimeError: no kernel for [/half]"


def test_derivatives_only_in_tensors_that_require_gradients(mine: Path, run: Run, tmp_path: Path) -> None:
    path = tmp_path / "gradcheck.json"
    assert run("gradcheck", f"{mine}:scaled", "--json", path)[0] == 0
    assert [result["inputs"] for result in json.loads(path.read_text())] == [["image"]]


def test_a_function_of_a_package(run: Run, mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine.rename(mine.with_name("package_of_mine.py"))
    monkeypatch.syspath_prepend(str(mine.parent))
    assert run("gradcheck", "package_of_mine:weighted")[0] == 0
    assert run("gradcheck", "package_of_mine:wrong")[0] == 1


@pytest.mark.parametrize("command", ["gradcheck", "stability"])
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("absent", "expected a function 'absent' in {path}, found "),
        ("number", "expected a function of tensors, found int"),
        ("counts", "expected one or several floating-point tensors of it, found torch.int64"),
        ("fails", "it fails in float64: RuntimeError: no luck today"),
        ("integers", "expected a floating-point tensor as example input 1, found torch.int64 of (3,)"),
        ("alone", "expected a tuple of tensors as example inputs, or several by name, found Tensor"),
        ("large", f"expected at most {LARGEST} numbers in the example inputs, found 12288"),
        ("undrawn", "its example inputs fail: OSError: no such image"),
    ],
)
def test_functions_that_cannot_be_checked_are_rejected_in_one_line(
    mine: Path, run: Run, command: str, name: str, message: str
) -> None:
    status, _, err = run(command, f"{mine}:{name}")
    assert status == 2
    assert message.format(path=mine) in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("command", ["gradcheck", "stability"])
def test_a_missing_function_is_rejected(tmp_path: Path, run: Run, command: str) -> None:
    bare = tmp_path / "bare.py"
    bare.write_text("def halves(image, half):\n    return image * half[..., :3]\n\ndef none(*images): ...\n")
    broken = tmp_path / "broken.py"
    broken.write_text("import nothing_of_this_name")
    beside = tmp_path / "beside.py"
    beside.write_text("def inputs(): ...\n\ndef square(image): ...\n")
    for name, message in {
        f"{tmp_path}/absent.py:square": "expected a Python file with a function, found no such file",
        f"{broken}:square": "cannot be imported: ModuleNotFoundError",
        "package.of.nobody:square": "package.of.nobody cannot be imported",
        f"{bare}:halves": "cannot be tried on images of (1, 3, 5, 6): it fails in float64: RuntimeError: The size of ",
        f"{bare}:none": "it names no argument without a default; give it an attribute example_inputs, or its file",
        str(bare): f"expected {bare}:function, found only the file; add :halves or :none",
        str(beside): f"expected {beside}:function, found only the file; add :square\n",
        "bare": "or path/to/file.py:function",
    }.items():
        status, _, err = run(command, name)
        assert status == 2
        assert message in err
        assert err.count("\n") == 1


def test_images_are_drawn_for_a_function_without_example_inputs(tmp_path: Path, run: Run) -> None:
    mine, path = tmp_path / "mine.py", tmp_path / "own.json"
    mine.write_text(
        "def power(image, other, exponent=2):\n    return image**exponent + other\n\n"
        "def norm(image):\n    return image.square().sum(1).sqrt()\n\n"
        "def mean(image):\n    return (image**2).mean((2, 3)).clamp_min(1e-6).sqrt()\n"
    )

    def failed(name: str, dtype: str) -> set[tuple[str, str]]:
        status = run("stability", f"{mine}:{name}", "--dtypes", dtype, "--json", path)[0]
        found = {(x["case"], x["what"]) for x in json.loads(path.read_text())["checks"] if not x["passed"]}
        assert status == bool(found)
        return found

    assert run("gradcheck", f"{mine}:power", "--json", path)[0] == 0
    assert [result["inputs"] for result in json.loads(path.read_text())] == [["image", "other"]]
    assert failed("power", "float32") == set()
    # The derivative of a root at 0 is infinite or NaN, and a square leaves the range: those of 1e30 and 1e-30 that of
    # float32, and that of 300 the one of half precision.
    squares = {(f"radiance {value}", what) for value in ("1e+30", "1e-30") for what in ("forward", "gradient")}
    assert failed("norm", "float32") == {("black", "gradient"), *squares}
    assert {("bright", "forward"), ("firefly", "forward")} <= failed("mean", "float16")
    assert {case for case, _ in failed("mean", "float32")} == {"radiance 1e+30"}


def test_an_op_that_is_undefined_in_float64_fails(tmp_path: Path, run: Run) -> None:
    mine, path = tmp_path / "mine.py", tmp_path / "own.json"
    mine.write_text(
        "import torch\n\n"
        "def ratio(color, history):\n    return color / history\n\n"
        "def root(color):\n    return color.sqrt()\n\n"
        "def exponential(color):\n    return color.exp()\n\n"
        "def logarithm(color):\n    return torch.log(1 - color)\n\n"
        # The next number is 1, where the logarithm is infinite.
        "logarithm.example_inputs = (torch.tensor([1 - 2**-24]),)\n"
    )

    def undefined(name: str) -> dict[tuple[str, str], str]:
        status, out, _ = run("stability", f"{mine}:{name}", "--dtypes", "float32", "--json", path)
        assert "of nan" not in out
        checks = json.loads(path.read_text())["checks"]
        assert status == 1
        return {(x["case"], x["what"]): x["message"] for x in checks if not x["passed"]}

    nan, infinity = (f"{value} in float64, where all inputs are finite" for value in ("NaN", "infinity"))
    assert undefined("ratio") == {("black", "forward"): nan, ("black", "gradient"): nan}
    assert undefined("root") == {("black", "gradient"): infinity}
    large = ("bright", "firefly", "radiance 60000", "radiance 1e+30")
    assert undefined("exponential") == {(x, what): infinity for x in large for what in ("forward", "gradient")}
    assert undefined("logarithm").keys() == {("example", "derivative")}


def test_an_infinite_input_may_have_an_infinite_result_but_no_nan_in_the_gradient_of_a_finite_one() -> None:
    def masked(depth: Tensor) -> Tensor:
        return torch.where(depth.isinf(), 0, depth * depth.exp())

    depth = torch.tensor([1.0, torch.inf])

    def failed(function: Callable[[Tensor], Tensor]) -> set[str]:
        checks = check_stability(function, depth, dtypes=(torch.float32,))
        return {check.what for check in checks if not check.passed} - {"derivative"}

    assert failed(torch.relu) == set()
    assert failed(masked) == {"gradient"}


def test_a_firefly_in_one_argument_only(tmp_path: Path, run: Run) -> None:
    mine, path = tmp_path / "mine.py", tmp_path / "own.json"
    mine.write_text("def grows(color, history):\n    return (history / (color + 0.1)).exp()\n")
    assert run("stability", f"{mine}:grows", "--dtypes", "float32", "--json", path)[0] == 1
    failed = {(x["case"], x["what"]) for x in json.loads(path.read_text())["checks"] if not x["passed"]}
    assert failed == {("firefly in history", "forward"), ("firefly in history", "gradient")}


def test_example_inputs_that_replace_images_are_reported(mine: Path, run: Run, tmp_path: Path) -> None:
    _, out, _ = run("stability", f"{mine}:logarithm", "--dtypes", "float32")
    assert f"{mine}:logarithm: its example inputs (ordinary, dark) replace the stiff and extreme images" in out
    bare = tmp_path / "bare.py"
    bare.write_text("def twice(image):\n    return 2 * image\n")
    assert "replace" not in run("stability", f"{bare}:twice", "downsample", "--dtypes", "float32")[1]


def test_settings_of_a_function(tmp_path: Path, run: Run) -> None:
    mine, path = tmp_path / "mine.py", tmp_path / "own.json"
    mine.write_text("def power(image, exponent):\n    return image**exponent\n")
    assert run("gradcheck", f"{mine}:power(exponent=3)", "--json", path)[0] == 0
    (result,) = json.loads(path.read_text())
    assert (result["op"], result["inputs"]) == (f"{mine}:power(exponent=3)", ["image"])
    # A root has no derivative at 0.
    assert [run("stability", f"{mine}:power(exponent={x})", "--dtypes", "float32")[0] for x in (1, 0.5)] == [0, 1]
    status, _, err = run("gradcheck", f"{mine}:power(power=3)")
    assert status == 2
    assert f"function '{mine}:power(power=3)': got an unexpected keyword argument 'power'" in err
    assert err.count("\n") == 1


def cube(image: Tensor) -> Tensor:
    return image**3


def inputs() -> dict[str, tuple[Tensor, ...]]:
    return {"rows": (torch.rand(2, 3),), "number": (torch.rand(()),)}


def test_python_and_the_command_agree(mine: Path, run: Run, tmp_path: Path) -> None:
    path = tmp_path / "own.json"
    name = f"{Path(__file__)}:cube"
    assert run("gradcheck", name, "--json", path)[0] == 0
    found = gradcheck(cube)
    assert [replace(result, op=name, seconds=0.0) for result in found] == [
        type(found[0])(**{**result, "inputs": tuple(result["inputs"]), "seconds": 0.0})
        for result in json.loads(path.read_text())
    ]
    assert run("stability", name, "--dtypes", "float32", "--json", path)[0] == 0
    checks = check_stability(cube, dtypes=(torch.float32,))
    assert [(check.case, check.what, check.error, check.allowed) for check in checks] == [
        (check["case"], check["what"], check["error"], check["allowed"])
        for check in json.loads(path.read_text())["checks"]
    ]


def test_inputs_may_be_passed() -> None:
    (result,) = gradcheck(cube, torch.rand(2, 2))
    assert (result.op, result.case, result.inputs, result.passed) == ("cube", "example", ("image",), True)
    (right,) = gradcheck(lambda image: image * image.detach(), torch.zeros(2, 2))
    (wrong,) = gradcheck(lambda image: image * image.detach(), torch.ones(2, 2))
    assert (right.passed, wrong.passed) == (False, False)
    assert "has the difference quotient 2 and the derivative 1" in wrong.message
    with pytest.raises(InputError, match="expected a floating-point tensor as example input 1"):
        gradcheck(cube, torch.arange(3))


def test_first_derivatives_only(mine: Path, run: Run) -> None:
    class Once(torch.autograd.Function):
        @staticmethod
        def forward(ctx: object, image: Tensor) -> Tensor:
            return 3 * image

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: object, gradient: Tensor) -> Tensor:
            return 3 * gradient

    def once(image: Tensor) -> Tensor:
        result: Tensor = Once.apply(image)
        return result

    with pytest.raises(InputError, match="expected example input 1 on cpu, found it on meta"):
        gradcheck(once, torch.rand(2, 2, device="meta"))
    assert [gradcheck(once, torch.rand(2, 2), order=order)[0].passed for order in (1, 2)] == [True, False]
    assert all(check.passed for check in check_stability(once, torch.rand(2, 2)))
    # The second derivative is wrong although the first is correct.
    assert [run("gradcheck", f"{mine}:forgetful", "--order", order)[0] for order in (1, 2)] == [0, 1]
    assert run("gradcheck", f"{mine}:forgetful", "--order", 3)[0] == 2
