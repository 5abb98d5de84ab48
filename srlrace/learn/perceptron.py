"""Multilayer perceptrons in compiled kernels: forward, and the gradient written out.

At the size of a policy, a library's products cost less than the calls between them and the trips of intermediate
results to memory and back. Here a block of samples goes forward, through the loss, and backward while it is in the
cache.

All numbers lie in one float32 vector, `memory`. A network is a matrix `layers`: one row of sizes and of indices into
`memory` for each layer. Samples are rows, padded with zeros to whole SIMD registers. A padded unit has no weights, so
it stays zero forward (every activation maps 0 to 0) and backward, and nothing needs a special case. For inputs x
(n, in), weights W (out, in) and the gradient d (n, out) with respect to what an activation f was given, the products

    y = f(b + x W'),    gradient of W' = x' d,    gradient of x = d W

are each a `product` with lanes over the units of its result, for which W is kept in both orientations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from srlrace.learn.tile import LANES, ROWS, product
from srlrace.sim.compile import kernel

BLOCK = 96  # samples that go through the networks together: their activations stay in the level-2 cache
RELU, TANH, ELU = range(3)
ACTIVATIONS: dict[type[nn.Module], int] = {nn.ReLU: RELU, nn.Tanh: TANH, nn.ELU: ELU}
# Columns of `layers`. Sizes:
INPUTS, OUTPUTS = 0, 1
INPUT_WIDTH, WIDTH = 2, 3  # the same, padded
# Where in `memory`:
INPUT, INPUT_GRADIENT = 4, 5  # (BLOCK, input width) each; gradients are those of an activation's argument
OUTPUT, OUTPUT_GRADIENT = 6, 7  # (BLOCK, width) each
WEIGHT, WEIGHT_GRADIENT = 8, 9  # (inputs + 1, width) each: W' and, in the last row, b
BACKWARD_WEIGHT = 10  # (outputs, input width): W
# Where among the parameters: weight (outputs, inputs), then bias (outputs)
PARAMETERS = 11
FIELDS = 12

Floats = NDArray[np.float32]

ZERO, ONE, TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
LOG2_E = np.float32(math.log2(math.e))
# ln 2 in two parts, the first so short that its product with an exponent is exact
LN2_HIGH, LN2_LOW = np.float32(0.693359375), np.float32(math.log(2.0) - 0.693359375)
EXP_TERMS = tuple(np.float32(1.0 / math.factorial(k)) for k in range(8))
EXP_LOWEST = np.float32(-87.0)  # exp is normal from here up


@kernel
def load_weights(memory, layers, parameters):
    """Copy the weights and biases from the flat parameters into `memory`, in both orientations."""
    for layer in range(len(layers)):
        inputs, outputs = layers[layer, INPUTS], layers[layer, OUTPUTS]
        input_width, width = layers[layer, INPUT_WIDTH], layers[layer, WIDTH]
        forward_at, backward_at, at = layers[layer, WEIGHT], layers[layer, BACKWARD_WEIGHT], layers[layer, PARAMETERS]
        for o in range(outputs):
            for i in range(inputs):
                memory[backward_at + o * input_width + i] = parameters[at + o * inputs + i]
            memory[forward_at + inputs * width + o] = parameters[at + outputs * inputs + o]
        for first in range(0, outputs, LANES):  # a few rows at a time stay in the cache
            for i in range(inputs):
                for o in range(first, min(first + LANES, outputs)):
                    memory[forward_at + i * width + o] = parameters[at + o * inputs + i]


@kernel
def clear_gradient(memory, layers):
    """Set the gradients of weights and biases to zero."""
    for layer in range(len(layers)):
        first, count = layers[layer, WEIGHT_GRADIENT], (layers[layer, INPUTS] + 1) * layers[layer, WIDTH]
        memory[first : first + count] = ZERO


@kernel
def store_gradient(memory, layers, gradient):
    """Copy the gradients of weights and biases into a vector like the flat parameters."""
    for layer in range(len(layers)):
        inputs, outputs, width = layers[layer, INPUTS], layers[layer, OUTPUTS], layers[layer, WIDTH]
        start, at = layers[layer, WEIGHT_GRADIENT], layers[layer, PARAMETERS]
        for o in range(outputs):
            for i in range(inputs):
                gradient[at + o * inputs + i] = memory[start + i * width + o]
            gradient[at + outputs * inputs + o] = memory[start + inputs * width + o]


@kernel
def exp_of_negative(x):
    """Return exp(x) for x <= 0 to 2 units in the last place, without a branch, so that loops over it become SIMD."""
    x = max(x, EXP_LOWEST)
    power = np.int32(x * LOG2_E - np.float32(0.5))
    r = x - np.float32(power) * LN2_HIGH - np.float32(power) * LN2_LOW  # within +-ln(2) / 2
    y = EXP_TERMS[7]
    y = y * r + EXP_TERMS[6]
    y = y * r + EXP_TERMS[5]
    y = y * r + EXP_TERMS[4]
    y = y * r + EXP_TERMS[3]
    y = y * r + EXP_TERMS[2]
    y = y * r + ONE
    y = y * r + ONE
    return y * np.int32((power + 127) << 23).view(np.float32)


@kernel
def activate(memory, first, count, activation):
    """Apply the activation in place."""
    values = memory[first : first + count]
    if activation == RELU:
        for k in range(count):
            values[k] = max(values[k], ZERO)
    elif activation == TANH:
        for k in range(count):
            t = exp_of_negative(-TWO * abs(values[k]))
            values[k] = math.copysign((ONE - t) / (ONE + t), values[k])
    else:
        for k in range(count):
            values[k] = max(values[k], ZERO) + exp_of_negative(min(values[k], ZERO)) - ONE


@kernel
def slope(memory, outputs, gradients, count, activation):
    """Multiply gradients with the activation's derivative, in place, from the activation's results."""
    y, gradient = memory[outputs : outputs + count], memory[gradients : gradients + count]
    if activation == RELU:
        for k in range(count):
            gradient[k] *= ONE if y[k] > ZERO else ZERO
    elif activation == TANH:
        for k in range(count):
            gradient[k] *= ONE - y[k] * y[k]
    else:
        for k in range(count):
            gradient[k] *= ONE if y[k] > ZERO else y[k] + ONE


@kernel
def add_rows(memory, total, first, count, width):
    """Add `count` rows to the row at `total`."""
    sums = memory[total : total + width]
    for n in range(count):
        row = memory[first + n * width : first + (n + 1) * width]
        for k in range(width):
            sums[k] += row[k]


@kernel
def forward(memory, layers, activation, count):
    """Compute the outputs of `count` samples, at most BLOCK, from the input of the first layer."""
    for layer in range(len(layers)):
        inputs, width = layers[layer, INPUTS], layers[layer, WIDTH]
        weight, output = layers[layer, WEIGHT], layers[layer, OUTPUT]
        product(
            memory, output, width, weight + inputs * width, 0,
            layers[layer, INPUT], layers[layer, INPUT_WIDTH], 1, weight, width, inputs, count, width,
        )  # fmt: skip
        if layer < len(layers) - 1:
            activate(memory, output, count * width, activation)


@kernel
def backward(memory, layers, activation, count):
    """Add up the gradients of weights and biases of `count` samples, from the output gradient of the last layer."""
    for layer in range(len(layers) - 1, -1, -1):
        inputs, width, input_width = layers[layer, INPUTS], layers[layer, WIDTH], layers[layer, INPUT_WIDTH]
        x, d, total = layers[layer, INPUT], layers[layer, OUTPUT_GRADIENT], layers[layer, WEIGHT_GRADIENT]
        product(memory, total, width, total, width, x, 1, input_width, d, width, count, inputs, width)
        add_rows(memory, total + inputs * width, d, count, width)
        if layer > 0:
            back, weight = layers[layer, INPUT_GRADIENT], layers[layer, BACKWARD_WEIGHT]
            product(
                memory, back, input_width, 0, 0,
                d, width, 1, weight, input_width, layers[layer, OUTPUTS], count, input_width,
            )  # fmt: skip
            slope(memory, x, back, count * input_width, activation)


@kernel
def evaluate(memory, layers, activation, x, y):
    """Compute the outputs y (n, out) of the inputs x (n, in), with the weights that were last loaded."""
    last = len(layers) - 1
    for first in range(0, len(x), BLOCK):
        count = min(BLOCK, len(x) - first)
        for n in range(count):
            for i in range(x.shape[1]):
                memory[layers[0, INPUT] + n * layers[0, INPUT_WIDTH] + i] = x[first + n, i]
        forward(memory, layers, activation, count)
        for n in range(count):
            for o in range(y.shape[1]):
                y[first + n, o] = memory[layers[last, OUTPUT] + n * layers[last, WIDTH] + o]


def _padded(count: int, to: int) -> int:
    return -(-count // to) * to


class Perceptrons:
    """Networks on a common input, each ``hidden`` layers (linear and one kind of activation) and a linear head.

    Their parameters are parts of the vector ``flat``, every bias right after its weight.
    """

    def __init__(self, hidden: Sequence[nn.Sequential], heads: Sequence[nn.Linear], flat: Tensor) -> None:
        kinds = {type(layer) for stack in hidden for layer in stack if not isinstance(layer, nn.Linear)}
        if len(kinds) != 1:
            raise ValueError(f"perceptrons have one kind of activation, not {sorted(k.__name__ for k in kinds)}")
        self.activation = ACTIVATIONS[kinds.pop()]
        stacks = [
            [*(layer for layer in layers if isinstance(layer, nn.Linear)), head]
            for layers, head in zip(hidden, heads, strict=True)
        ]
        widest = max(linear.in_features for stack in stacks for linear in stack)
        self._size = _padded(widest, LANES)  # zeros, with which the gradient of an input starts
        x = self._take(BLOCK, stacks[0][0].in_features)
        self.layers = [self._place(stack, flat, x) for stack in stacks]
        self.memory: Floats = torch.zeros(self._size).numpy()  # torch aligns to cache lines, numpy does not

    def _take(self, rows: int, columns: int) -> int:
        first, self._size = self._size, self._size + _padded(rows, ROWS) * _padded(columns, LANES)
        return first

    def _place(self, stack: Sequence[nn.Linear], flat: Tensor, x: int) -> NDArray[np.int64]:
        layers = np.zeros((len(stack), FIELDS), np.int64)
        x_gradient = 0  # of the observation: not computed
        for row, linear in zip(layers, stack, strict=True):
            inputs, outputs = linear.in_features, linear.out_features
            row[[INPUTS, OUTPUTS]] = inputs, outputs
            row[[INPUT_WIDTH, WIDTH]] = _padded(inputs, LANES), _padded(outputs, LANES)
            row[[INPUT, INPUT_GRADIENT]] = x, x_gradient
            x, x_gradient = self._take(BLOCK, outputs), self._take(BLOCK, outputs)
            row[[OUTPUT, OUTPUT_GRADIENT]] = x, x_gradient
            row[[WEIGHT, WEIGHT_GRADIENT]] = self._take(inputs + 1, outputs), self._take(inputs + 1, outputs)
            row[BACKWARD_WEIGHT] = self._take(outputs, inputs)
            row[PARAMETERS] = linear.weight.storage_offset()
            if linear.weight.data_ptr() != flat[row[PARAMETERS] :].data_ptr():
                raise ValueError("the weights are not parts of the vector of all parameters")
        return layers

    def load(self, parameters: Floats) -> None:
        """Take over the weights for `evaluate`."""
        for layers in self.layers:
            load_weights(self.memory, layers, parameters)

    def evaluate(self, layers: NDArray[np.int64], x: Floats) -> Floats:
        """Return one network's outputs (n, out) for inputs (n, in), with the weights that were loaded last."""
        y = np.empty((len(x), int(layers[-1, OUTPUTS])), np.float32)
        evaluate(self.memory, layers, self.activation, np.ascontiguousarray(x), y)
        return y
