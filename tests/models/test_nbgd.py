"""The neural bilateral grid against its equations, written out in float64, and its published numbers."""

import torch
from toys import drawn, frame_of, whole_frame

from mcdenoise.models.nbgd import NeuralBilateralGrid


@torch.no_grad()
def test_a_constant_light_stays_what_it_is() -> None:
    """The weights of the grids sum to one, whatever the network says."""
    network, frame = drawn(NeuralBilateralGrid()), frame_of(21, 35).to(torch.float64)
    frame = frame.replace(color=torch.full_like(frame.color, 0.7))
    torch.testing.assert_close(network(frame)[0].image, frame.color, rtol=1e-12, atol=0)


def test_derivatives_of_more_than_100_in_a_guide_do_not_count_in_training() -> None:
    """A loss of so many times the image has nothing but such derivatives, but for those in the weights."""
    network = NeuralBilateralGrid()
    frame = whole_frame(network, 24, 24)
    for training in (False, True):
        network.train(training)
        network.zero_grad()
        (1e12 * network(frame)[0].image).sum().backward()
        guides = network.last.weight.grad[:3]
        assert bool((guides.abs() > 1e3).any()) is not training
        assert torch.isfinite(network.last.weight.grad).all()
