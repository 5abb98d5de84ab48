"""A multilayer perceptron with its gradient written out, on the parameters of a torch module.

For networks of this size torch's autograd spends as long on bookkeeping as on arithmetic. The gradient
of a perceptron is a page of algebra; the tests compare it with autograd.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn


def _tanh_slope(y: Tensor, g: Tensor) -> Tensor:
    return g.mul_(1.0 - y * y)


def _relu_slope(y: Tensor, g: Tensor) -> Tensor:
    return torch.ops.aten.threshold_backward(g, y, 0)


def _elu_slope(y: Tensor, g: Tensor) -> Tensor:
    return g.mul_(torch.where(y > 0.0, 1.0, y + 1.0))


# In place, from the layer's output y: the function, and the gradient before it from the one after it.
ACTIVATIONS: dict[type[nn.Module], tuple[Callable[[Tensor], Tensor], Callable[[Tensor, Tensor], Tensor]]] = {
    nn.ReLU: (torch.relu_, _relu_slope),
    nn.Tanh: (torch.tanh_, _tanh_slope),
    nn.ELU: (torch.nn.functional.elu_, _elu_slope),
}


class Perceptron:
    """``hidden`` (linear layers and one kind of activation, alternating) followed by the linear ``head``."""

    def __init__(self, hidden: nn.Sequential, head: nn.Linear) -> None:
        self.layers = [layer for layer in hidden if isinstance(layer, nn.Linear)] + [head]
        kinds = {type(layer) for layer in hidden if not isinstance(layer, nn.Linear)}
        if len(kinds) != 1:
            raise ValueError(f"a perceptron has one kind of activation, not {sorted(k.__name__ for k in kinds)}")
        self._activate, self._slope = ACTIVATIONS[kinds.pop()]
        self._inputs: list[Tensor] = []

    def forward(self, x: Tensor) -> Tensor:
        """Return the head's output (n, out) for inputs (n, in), and keep what `backward` needs."""
        self._inputs = [x]
        for layer in self.layers[:-1]:
            self._inputs.append(self._activate(torch.addmm(layer.bias, self._inputs[-1], layer.weight.t())))
        head = self.layers[-1]
        return torch.addmm(head.bias, self._inputs[-1], head.weight.t())

    def backward(self, g: Tensor) -> None:
        """Write the parameters' gradients for the gradient ``g`` (n, out) of the last `forward`'s output."""
        for layer, x in zip(reversed(self.layers), reversed(self._inputs), strict=True):
            assert layer.weight.grad is not None
            assert layer.bias.grad is not None
            torch.mm(g.t(), x, out=layer.weight.grad)
            torch.sum(g, 0, out=layer.bias.grad)
            if x is not self._inputs[0]:
                g = self._slope(x, torch.mm(g, layer.weight))
