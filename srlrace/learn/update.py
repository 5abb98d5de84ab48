"""PPO's update in compiled kernels: the clipped objective and its gradient, Adam, and advantages (GAE).

Each computes what Stable-Baselines3 and torch compute, in one pass over its data.
"""

from __future__ import annotations

import math

import numpy as np

from srlrace.learn.perceptron import (
    BLOCK,
    INPUT,
    INPUT_WIDTH,
    OUTPUT,
    OUTPUT_GRADIENT,
    OUTPUTS,
    WIDTH,
    backward,
    clear_gradient,
    forward,
    load_weights,
    store_gradient,
)
from srlrace.sim.compile import kernel

LOG_SQRT_TAU = 0.5 * math.log(2.0 * math.pi)
# Of log standard deviations that depend on the state: 0.03 to 1.65 of what an action can be at most. Ours; training
# stays within, the limits keep a bad step from ending it.
LOG_STD_LOW, LOG_STD_HIGH = -3.5, 0.5
# What an update reports, each a mean over its samples
POLICY_LOSS, VALUE_LOSS, ENTROPY, KL, CLIP_FRACTION = range(5)
STATISTICS = 5


@kernel
def advantage_scale(advantages, order, normalise):
    """Return mean and standard deviation (Bessel's, plus 1e-8) of the advantages at `order`; 0 and 1 for none."""
    n = len(order)
    if not normalise or n < 2:
        return 0.0, 1.0
    total = 0.0
    for row in order:
        total += advantages[row]
    mean, squares = total / n, 0.0
    for row in order:
        squares += (advantages[row] - mean) ** 2
    return mean, math.sqrt(squares / (n - 1)) + 1e-8


@kernel
def policy_gradient(
    memory, last, rows, actions, old_log_probs, advantages, scale, log_std, log_std_gradient,
    lessons, clip, ent_coef, weight, out,
):  # fmt: skip
    """Write the gradient of the clipped objective for the samples of a block; add up statistics and log_std's gradient.

    `last` is the row of the policy's last layer, `scale` what `advantage_scale` returned, `weight` one over the size of
    the minibatch. A policy that gives means alone has the standard deviations exp(log_std), and the entropy bonus is
    added by the caller; one that gives twice as many numbers adds the second half to log_std (`standardise_by_state`).
    `lessons` are actions that the means are drawn to, and how much each sample's counts; none of them is no lesson.
    """
    mean, deviation = scale
    size, by_state, taught = len(log_std), last[OUTPUTS] > len(log_std), len(lessons[1]) > 0
    if by_state:
        constant = size * LOG_SQRT_TAU
        standardise_by_state(memory, last, rows, actions, log_std)
    else:
        constant = standardise(memory, last, rows, actions, log_std)
    for n in range(len(rows)):
        output, gradient = last[OUTPUT] + n * last[WIDTH], last[OUTPUT_GRADIENT] + n * last[WIDTH]
        z, d = memory[output : output + size], memory[gradient : gradient + size]
        squares, spread = 0.0, 0.0
        for k in range(size):
            squares += z[k] * z[k]
        if by_state:
            for k in range(size):
                spread += memory[output + size + k]
        log_ratio = -0.5 * squares - (constant + spread) - old_log_probs[rows[n]]
        ratio = math.exp(log_ratio)
        advantage = (advantages[rows[n]] - mean) / deviation
        surrogate, clipped = advantage * ratio, advantage * min(max(ratio, 1.0 - clip), 1.0 + clip)
        # The gradient flows where the clipped objective is not the smaller one.
        flow = -weight * surrogate if surrogate <= clipped else 0.0
        for k in range(size):
            wider = flow * (z[k] * z[k] - 1.0)
            if by_state:
                wider = (wider - weight * ent_coef) * memory[gradient + size + k]
                memory[gradient + size + k] = wider
            log_std_gradient[k] += wider
            if taught:
                pull = weight * lesson_gradient(lessons, rows[n], k, actions[rows[n], k] - z[k] / d[k])
                d[k] = d[k] * flow * z[k] + pull
            else:
                d[k] *= flow * z[k]
        out[POLICY_LOSS] -= weight * min(surrogate, clipped)
        out[KL] += weight * (ratio - 1.0 - log_ratio)
        out[CLIP_FRACTION] += weight * (abs(ratio - 1.0) > clip)
        if by_state:
            out[ENTROPY] += weight * (spread + constant + 0.5 * size)


@kernel
def lesson_gradient(lessons, row, k, mean):
    """Gradient of the weighted squared error of the mean of action `k`; none where both are at or beyond its limit."""
    wanted = lessons[0][row, k]
    if (wanted >= 1.0 and mean >= 1.0) or (wanted <= -1.0 and mean <= -1.0):
        return 0.0
    return 2.0 * lessons[1][row] * (mean - wanted)


@kernel
def standardise(memory, last, rows, actions, log_std):
    """Replace the means of the actions by (action - mean) / std and set their gradients to 1 / std.

    Returns the constant of the Gaussian's log density.
    """
    constant = 0.0
    for k in range(len(log_std)):
        constant += log_std[k] + LOG_SQRT_TAU
        inverse = np.float32(math.exp(-log_std[k]))
        for n in range(len(rows)):
            place = n * last[WIDTH] + k
            memory[last[OUTPUT] + place] = (actions[rows[n], k] - memory[last[OUTPUT] + place]) * inverse
            memory[last[OUTPUT_GRADIENT] + place] = inverse
    return constant


@kernel
def standardise_by_state(memory, last, rows, actions, log_std):
    """Do as `standardise`, for standard deviations of which each state has its own.

    What the policy adds to log_std is replaced by the sum, within its limits, and its gradient set to that of the sum:
    1, or 0 beyond the limits.
    """
    size = len(log_std)
    for n in range(len(rows)):
        output, gradient = last[OUTPUT] + n * last[WIDTH], last[OUTPUT_GRADIENT] + n * last[WIDTH]
        for k in range(size):
            asked = log_std[k] + memory[output + size + k]
            held = min(max(asked, np.float32(LOG_STD_LOW)), np.float32(LOG_STD_HIGH))
            inverse = np.float32(math.exp(-held))
            memory[output + k] = (actions[rows[n], k] - memory[output + k]) * inverse
            memory[gradient + k] = inverse
            memory[output + size + k] = held
            memory[gradient + size + k] = asked == held


@kernel
def value_gradient(memory, last, rows, returns, vf_coef, weight, out):
    """Write the gradient of the squared error for the samples of a block, and add up the error."""
    for n in range(len(rows)):
        error = memory[last[OUTPUT] + n * last[WIDTH]] - returns[rows[n]]
        memory[last[OUTPUT_GRADIENT] + n * last[WIDTH]] = 2.0 * vf_coef * weight * error
        out[VALUE_LOSS] += weight * error * error


@kernel
def gradient_step(
    memory, actor, critic, activation, parameters, gradient, order,
    observations, actions, old_log_probs, advantages, returns, lessons, clip, ent_coef, vf_coef, normalise, out,
):  # fmt: skip
    """Write the gradient of PPO's loss on the samples `order` of a rollout, and add its statistics to `out`.

    The parameters begin with the logarithms of the standard deviations.
    """
    weight = 1.0 / len(order)
    scale = advantage_scale(advantages, order, normalise)
    gradient[:] = 0.0
    size = actions.shape[1]
    log_std, log_std_gradient = parameters[:size], gradient[:size]
    for layers in (actor, critic):
        load_weights(memory, layers, parameters)
        clear_gradient(memory, layers)
    x, width = actor[0, INPUT], actor[0, INPUT_WIDTH]
    for first in range(0, len(order), BLOCK):
        rows = order[first : first + BLOCK]
        count = len(rows)
        for n in range(count):
            for k in range(observations.shape[1]):
                memory[x + n * width + k] = observations[rows[n], k]
        forward(memory, actor, activation, count)
        policy_gradient(
            memory, actor[len(actor) - 1], rows, actions, old_log_probs, advantages, scale,
            log_std, log_std_gradient, lessons, clip, ent_coef, weight, out,
        )  # fmt: skip
        backward(memory, actor, activation, count)
        forward(memory, critic, activation, count)
        value_gradient(memory, critic[len(critic) - 1], rows, returns, vf_coef, weight, out)
        backward(memory, critic, activation, count)
    for layers in (actor, critic):
        store_gradient(memory, layers, gradient)
    if actor[len(actor) - 1, OUTPUTS] == size:
        for k in range(size):
            log_std_gradient[k] -= ent_coef
            out[ENTROPY] += log_std[k] + 0.5 + LOG_SQRT_TAU


@kernel
def adam(parameters, gradient, first, second, step, learning_rate, beta_1, beta_2, epsilon, max_norm):
    """Clip the gradient to a norm and take Adam's step number `step`, from 1."""
    squares = 0.0
    for k in range(len(gradient)):
        squares += gradient[k] * gradient[k]
    scale = max_norm / (math.sqrt(squares) + 1e-6)
    factor = np.float32(1.0 if scale > 1.0 else scale)  # a norm that is not a number spoils all, as in torch
    rate = np.float32(learning_rate / (1.0 - beta_1**step))
    root = np.float32(1.0 / math.sqrt(1.0 - beta_2**step))
    keep_1, keep_2, small = np.float32(beta_1), np.float32(beta_2), np.float32(epsilon)
    add_1, add_2 = np.float32(1.0 - beta_1), np.float32(1.0 - beta_2)
    for k in range(len(gradient)):
        g = gradient[k] * factor
        first[k] = keep_1 * first[k] + add_1 * g
        second[k] = keep_2 * second[k] + add_2 * g * g
        parameters[k] -= rate * first[k] / (np.sqrt(second[k]) * root + small)


@kernel
def estimate_advantages(rewards, values, starts, last_values, last_dones, gamma, gae_lambda, advantages, returns):
    """Write generalised advantage estimates and the returns they imply; all (steps, drones) but the last ones."""
    steps, drones = rewards.shape
    for i in range(drones):
        following, going, advantage = last_values[i], 1.0 - last_dones[i], 0.0
        for t in range(steps - 1, -1, -1):
            error = rewards[t, i] + gamma * following * going - values[t, i]
            advantage = error + gamma * gae_lambda * going * advantage
            advantages[t, i], returns[t, i] = advantage, advantage + values[t, i]
            following, going = values[t, i], 1.0 - starts[t, i]
