"""The compiled networks and optimiser do what torch does, for sizes that fit no register or block."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch
from torch import nn

from srlrace.learn import perceptron as subject
from srlrace.learn.perceptron import BLOCK, Perceptrons
from srlrace.learn.tile import product
from srlrace.learn.update import adam

SIZES = [(7, (5, 3), 2), (34, (64, 64), 4), (1, (1,), 1), (48, (16, 130, 17), 20)]


@numba.njit
def add_gradient(memory, layers, activation, x, g):  # type: ignore[no-untyped-def]
    """Add the gradient of sum(output * g), at most BLOCK samples."""
    last = layers[-1]
    for n in range(len(x)):
        start = layers[0, subject.INPUT] + n * layers[0, subject.INPUT_WIDTH]
        memory[start : start + x.shape[1]] = x[n]
    subject.forward(memory, layers, activation, len(x))
    for n in range(len(x)):
        start = last[subject.OUTPUT_GRADIENT] + n * last[subject.WIDTH]
        memory[start : start + g.shape[1]] = g[n]
    subject.backward(memory, layers, activation, len(x))


def network(inputs: int, hidden: tuple[int, ...], outputs: int, activation: type[nn.Module]):  # type: ignore[no-untyped-def]
    """A torch network, its parameters in one vector, and the compiled network on them."""
    torch.manual_seed(1)
    stack = nn.Sequential()
    for a, b in zip((inputs, *hidden), hidden, strict=False):
        stack.extend([nn.Linear(a, b), activation()])
    head = nn.Linear(hidden[-1], outputs)
    parameters = [*stack.parameters(), *head.parameters()]
    flat = torch.cat([torch.zeros(3), *(p.detach().flatten() for p in parameters)])  # something may stand before them
    at = 3
    for p in parameters:
        p.data, at = flat[at : at + p.numel()].view_as(p), at + p.numel()
    compiled = Perceptrons([stack], [head], flat)
    compiled.load(flat.numpy())
    return nn.Sequential(stack, head), flat.numpy(), compiled


@pytest.mark.parametrize("activation", [nn.ReLU, nn.Tanh, nn.ELU])
@pytest.mark.parametrize(("inputs", "hidden", "outputs"), SIZES)
def test_output_and_gradient_are_those_of_autograd(
    inputs: int, hidden: tuple[int, ...], outputs: int, activation: type[nn.Module]
) -> None:
    model, flat, compiled = network(inputs, hidden, outputs, activation)
    layers = compiled.layers[0]
    x, g = torch.randn(BLOCK + 7, inputs), torch.randn(BLOCK + 7, outputs)
    y = model(x)
    (y * g).sum().backward()
    np.testing.assert_allclose(compiled.evaluate(layers, x.numpy()), y.detach().numpy(), rtol=1e-5, atol=1e-5)
    gradient = np.full_like(flat, np.nan)
    subject.clear_gradient(compiled.memory, layers)
    for part in (slice(0, BLOCK), slice(BLOCK, None)):  # a block adds to the one before
        add_gradient(compiled.memory, layers, compiled.activation, x[part].numpy(), g[part].numpy())
    subject.store_gradient(compiled.memory, layers, gradient)
    expected = torch.cat([p.grad.flatten() for p in model.parameters()]).numpy()
    assert np.isnan(gradient[:3]).all()
    np.testing.assert_allclose(gradient[3:], expected, rtol=1e-4, atol=1e-4)


def test_a_sample_does_not_depend_on_its_neighbours_or_its_place() -> None:
    _, _, compiled = network(34, (64, 64), 4, nn.ReLU)
    x = np.random.default_rng(0).normal(size=(2 * BLOCK + 5, 34)).astype(np.float32)
    together = compiled.evaluate(compiled.layers[0], x)
    for n in (0, 1, BLOCK - 1, BLOCK, len(x) - 1):
        np.testing.assert_array_equal(compiled.evaluate(compiled.layers[0], x[n : n + 1])[0], together[n])


@pytest.mark.parametrize("shift", [0, 1])
@pytest.mark.parametrize(("rows", "width", "terms"), [(4, 16, 1), (20, 80, 9), (16, 64, 64), (100, 48, 0)])
def test_product(rows: int, width: int, terms: int, shift: int) -> None:
    rng = np.random.default_rng(rows)
    a, b = rng.normal(size=(rows, terms)), rng.normal(size=(terms, width))
    bias = rng.normal(size=width)
    parts = [np.zeros(shift), np.full(rows * width, np.nan), a.T.ravel(), b.ravel(), bias]
    c_at, a_at, b_at, bias_at = np.cumsum([len(part) for part in parts])[:4]
    memory = np.concatenate(parts).astype(np.float32)
    product(memory, c_at, width, bias_at, 0, a_at, 1, rows, b_at, width, terms, rows, width)
    c = memory[c_at:a_at].reshape(rows, width)
    np.testing.assert_allclose(c, a @ b + bias, rtol=1e-5, atol=1e-5)


def test_exponential_is_accurate_to_float32() -> None:
    x = np.concatenate([-np.logspace(-8, np.log10(87), 5000), [0.0]]).astype(np.float32)
    y = np.array([subject.exp_of_negative(value) for value in x])
    np.testing.assert_allclose(y, np.exp(x.astype(np.float64)), rtol=3e-7)
    assert 0.0 <= subject.exp_of_negative(np.float32(-1e30)) < 1e-37


@pytest.mark.parametrize("max_norm", [1e-3, 1e3])
def test_steps_of_adam_are_those_of_torch(max_norm: float) -> None:
    torch.manual_seed(2)
    theirs = nn.Parameter(torch.randn(1003))
    ours = theirs.detach().numpy().copy()
    optimizer = torch.optim.Adam([theirs], lr=0.01, eps=1e-5)
    moments = np.zeros((2, len(ours)), np.float32)
    for step in range(1, 6):
        gradient = torch.randn(1003) * 10.0 ** torch.randint(-6, 2, (1003,))
        theirs.grad = gradient.clone()
        torch.nn.utils.clip_grad_norm_([theirs], max_norm)
        optimizer.step()
        adam(ours, gradient.numpy(), *moments, step, 0.01, 0.9, 0.999, 1e-5, max_norm)
    np.testing.assert_allclose(ours, theirs.detach().numpy(), rtol=1e-5, atol=1e-6)
    state = optimizer.state[theirs]
    np.testing.assert_allclose(moments[0], state["exp_avg"].numpy(), rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(moments[1], state["exp_avg_sq"].numpy(), rtol=1e-4, atol=1e-15)


def test_a_gradient_that_is_not_a_number_shows() -> None:
    parameters, moments = np.ones(40, np.float32), np.zeros((2, 40), np.float32)
    gradient = np.zeros(40, np.float32)
    gradient[3] = np.nan
    adam(parameters, gradient, *moments, 1, 0.01, 0.9, 0.999, 1e-5, 0.5)
    assert np.isnan(parameters).any()
