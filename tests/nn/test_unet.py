"""The U-Net: its scales, and what is faster on a CPU."""

import copy

import numpy as np
import pytest
import torch
from torch import Tensor

from mcdenoise.nn import UNet

WIDTH = 8


def whole_numbers(parameter: Tensor, generator: torch.Generator) -> Tensor:
    """Return weights of a convolution of which two are 1 or -1 for each result and all others 0; the bias is 0."""
    values = torch.zeros(parameter.shape)
    if parameter.dim() > 1:
        # Transposed convolutions have their results second, and one weight of each input for each of two by two.
        outputs = values.transpose(0, 1) if parameter.shape[-1] == 2 else values
        for output in range(outputs.shape[0]):
            for place in torch.randperm(outputs[0].numel(), generator=generator)[:2].tolist():
                sign = 1.0 if torch.rand((), generator=generator) < 0.7 else -1.0
                outputs[(output, *np.unravel_index(place, outputs[0].shape))] = sign
    return values


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_shortcuts_of_inference_change_no_feature(dtype: torch.dtype) -> None:
    """Bit by bit, of a network whose sums have no rounding in whichever order a library takes them."""
    net, generator = UNet(4, [WIDTH] * 4), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.copy_(whole_numbers(parameter, generator))
    net = net.to(dtype=dtype, memory_format=torch.channels_last)
    # Each of the 17 layers at most doubles them: whole numbers below 2^20, and float32, in which all sums are taken,
    # holds those below 2^24. bfloat16 rounds the results only, before or after ReLU, which is the same.
    image = torch.randint(-4, 5, (1, 4, 21, 34), generator=generator).to(dtype)
    trained = net(image)
    with torch.no_grad():
        inferred = net(image)
    for a, b in zip(trained, inferred, strict=True):
        assert len(b.unique()) > 20
        assert torch.equal(a, b)


# The warning is torch's own: it comes when its rules for forward mode are loaded.
@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
def test_a_network_that_does_not_learn_has_its_derivative_forward() -> None:
    unet = UNet(3, [4] * 4).double().requires_grad_(False)
    image, direction = (torch.randn(1, 3, 16, 24, dtype=torch.float64) for _ in range(2))
    _, forward = torch.func.jvp(lambda x: unet(x)[0], (image,), (direction,))
    with torch.no_grad():
        unet32, (x, v) = copy.deepcopy(unet).float(), (each.float() for each in (image, direction))
        assert torch.func.jvp(lambda x: unet32(x)[0], (x,), (v,))[1].sub(forward).abs().max() < 1e-4
    leaf = image.clone().requires_grad_()
    weights = torch.randn_like(forward)
    (unet(leaf)[0] * weights).sum().backward()
    torch.testing.assert_close((forward * weights).sum(), (leaf.grad * direction).sum())


def test_inference_calls_the_layers_that_are_there() -> None:
    net, seen = UNet(3, [4] * 3), []
    block = net.encoder[0]
    block[1] = torch.nn.LeakyReLU(0.5)
    torch.nn.utils.parametrizations.weight_norm(net.encoder[1][0])
    net.decoder[0][0].register_forward_hook(lambda *_: seen.append(1))
    image = torch.rand(1, 3, 9, 8)
    trained = net(image)
    with torch.no_grad():
        inferred = net(image)
    for a, b in zip(trained, inferred, strict=True):
        torch.testing.assert_close(a, b)
    assert seen == [1, 1]
