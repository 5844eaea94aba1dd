"""Forward mode, ``torch.func`` and ``vmap``: right for every op, even where a fast backend exists."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from mcdenoise.check.case import as_tuple, tensors_in
from mcdenoise.check.cases import OPS, Case, Inputs, Op, map_tensors
from mcdenoise.ops import _backend

# The warning is torch's own: it comes when its rules for forward mode are loaded.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")

every_case = pytest.mark.parametrize(
    ("op", "case"),
    # Others change numbers and settings, of which the transforms know nothing.
    [pytest.param(op, case, id=f"{op.name}-{case.name}") for op in OPS for case in op.cases[1:2]],
)


@pytest.fixture(autouse=True)
def no_image_is_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Choose fast backends wherever they can run."""
    monkeypatch.setattr(_backend, "_FEW_PIXELS", 0)


def parted(op: Op, case: Case) -> tuple[Callable[..., Tensor], list[Tensor]]:
    """The op as a function of its differentiable arguments to all numbers of its results, and these arguments."""
    inputs = case.inputs()
    chosen = {name: value for name, value in inputs.items() if name in case.differentiable}

    def function(*tensors: Tensor) -> Tensor:
        rest = iter(tensors)
        given: Inputs = {**inputs, **map_tensors(lambda _: next(rest), chosen)}
        return torch.cat([part.flatten() for part in as_tuple(op.function(**given, **case.settings))])

    return function, tensors_in(chosen)


def drawn(like: Tensor, seed: int) -> Tensor:
    return torch.randn(like.shape, generator=torch.Generator().manual_seed(seed), dtype=like.dtype)


@every_case
def test_forward_mode_is_the_transpose_of_reverse_mode(op: Op, case: Case) -> None:
    function, leaves = parted(op, case)
    tangents = [drawn(leaf, seed) for seed, leaf in enumerate(leaves)]
    result, moved = torch.func.jvp(function, tuple(leaves), tuple(tangents))
    upstream = drawn(result, 100)
    gradients = torch.func.vjp(function, *leaves)[1](upstream)
    terms = [gradient * tangent for gradient, tangent in zip(gradients, tangents, strict=True)]
    size = sum(term.abs().sum() for term in terms) + (upstream * moved).abs().sum()
    assert (upstream * moved).sum().item() == pytest.approx(
        sum(term.sum() for term in terms).item(), rel=0, abs=1e-13 * float(size)
    )
    with forward_ad.dual_level():
        dual = function(*(forward_ad.make_dual(*each) for each in zip(leaves, tangents, strict=True)))
        torch.testing.assert_close(forward_ad.unpack_dual(dual).tangent, moved, rtol=1e-12, atol=1e-12)
    alone = [
        torch.func.jvp(lambda x, i=i: function(*leaves[:i], x, *leaves[i + 1 :]), (leaves[i],), (tangents[i],))[1]
        for i in range(len(leaves))
    ]
    torch.testing.assert_close(sum(alone), moved, rtol=1e-10, atol=1e-12 * float(moved.abs().max()))


@every_case
def test_vmap_is_a_loop(op: Op, case: Case) -> None:
    function, leaves = parted(op, case)
    several = [torch.stack([leaf, leaf * 0.75 + 0.125 * leaf.mean()]) for leaf in leaves]
    found = torch.func.vmap(function)(*several)
    gradients = torch.func.vmap(torch.func.grad(lambda *x: function(*x).cos().sum(), tuple(range(len(leaves)))))(
        *several
    )
    for i in range(2):
        one = [each[i].clone().requires_grad_() for each in several]
        expected = function(*one)
        torch.testing.assert_close(found[i], expected.detach(), rtol=1e-12, atol=1e-12)
        # A single tap sees no difference of features.
        plain = torch.autograd.grad(expected.cos().sum(), one, allow_unused=True, materialize_grads=True)
        for found_gradient, gradient in zip(gradients, plain, strict=True):
            torch.testing.assert_close(found_gradient[i], gradient, rtol=1e-9, atol=1e-11)
    for k in range(len(leaves)):
        dims = tuple(0 if i == k else None for i in range(len(leaves)))
        arguments = [several[i] if i == k else leaves[i] for i in range(len(leaves))]
        found = torch.func.vmap(function, in_dims=dims)(*arguments)
        for i in range(2):
            expected = function(*(each[i] if j == k else each for j, each in enumerate(arguments)))
            torch.testing.assert_close(found[i], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("op", OPS, ids=lambda op: op.name)
def test_the_gradient_of_a_vmap_and_jacobians(op: Op) -> None:
    function, leaves = parted(op, op.cases[1])
    several = [leaf[None] for leaf in leaves]
    whole = torch.func.grad(lambda *x: torch.func.vmap(function)(*x).cos().sum())(*several)
    leaf = leaves[0].clone().requires_grad_()
    (expected,) = torch.autograd.grad(function(leaf, *leaves[1:]).cos().sum(), leaf)
    torch.testing.assert_close(whole[0], expected, rtol=1e-9, atol=1e-11)
    for number in range(min(len(leaves), 3)):
        forward, reverse = (
            jacobian(function, argnums=number)(*leaves) for jacobian in (torch.func.jacfwd, torch.func.jacrev)
        )
        torch.testing.assert_close(forward, reverse, rtol=1e-9, atol=1e-11)
