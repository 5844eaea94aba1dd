"""Properties of every fused step: its formula, its derivatives, and its stability."""

import inspect

import pytest
import torch
from oracles import oracle
from reference_cases import by
from torch import Tensor

from mcdenoise.check import gradients
from mcdenoise.check.cases import STEPS, Case, Op
from mcdenoise.check.stability._ops import check_op
from mcdenoise.ops._op import backends_of
from mcdenoise.ops._steps import history

every_step = pytest.mark.parametrize("step", STEPS, ids=lambda step: step.name)
every_case = pytest.mark.parametrize(
    ("step", "case"), [pytest.param(step, case, id=f"{step.name}-{case.name}") for step in STEPS for case in step.cases]
)


def test_every_step_is_in_the_table() -> None:
    functions = [
        function
        for name, function in inspect.getmembers(history, inspect.isfunction)
        if not name.startswith("_") and function.__module__ == history.__name__
    ]
    fast = {each for each in functions if len(backends_of(each)) > 1}
    assert {step.function for step in STEPS} == {history.incoming, *fast}


@every_case
@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_is_its_formula(step: Op, case: Case, backend: str) -> None:
    found = by(backend, step.function)(**case.inputs(), **case.settings)
    expected = oracle(step.name)(**case.inputs(), **case.settings)
    pairs = [(found, expected)] if isinstance(found, Tensor) else zip(found, expected, strict=True)
    for result, formula in pairs:
        torch.testing.assert_close(result.double(), formula, rtol=1e-6 if result.ndim == 1 else 1e-9, atol=1e-12)


@every_step
def test_gradcheck(step: Op) -> None:
    results = [gradients.check_case(*each) for each in gradients.select([step.name])]
    assert not [f"{result.case}: {result.message}" for result in results if not result.passed]


@every_step
def test_stability(step: Op) -> None:
    checks = list(check_op(step))
    assert checks
    assert not [str(check) for check in checks if not check.passed]
