"""Triton kernels from gradients to weights: sums over parts, the learning rate, clipping, Adam."""

import triton
import triton.language as tl

BLOCK = 1024  # parameters of a program
PARTS = 64  # programs that sum up squares
ROWS, COLUMNS = 512, 8  # of sums that a program adds at a time


@triton.jit
def sum_rows(sums, num_rows, num_columns, destination, gradient, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Sum up the rows, each of them the sums of one program's samples; columns with destination -1 are not used."""
    columns, rows = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS), tl.arange(0, ROWS)
    place = tl.load(destination + columns, mask=columns < num_columns, other=-1)
    used = place >= 0
    total = tl.zeros((ROWS, COLUMNS), tl.float32)
    for first in range(0, num_rows, ROWS):
        part = sums + (first + rows)[:, None] * num_columns + columns[None, :]
        total += tl.load(part, mask=(first + rows < num_rows)[:, None] & used[None, :], other=0.0)
    tl.store(gradient + place, tl.sum(total, 0), mask=used)


@triton.jit
def sum_parts(partial, num_parts, partial_size, source, gradient, size, BLOCK: tl.constexpr):
    """Sum up the gradients of weights over all parts of the samples; other parameters have the source -1."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    index = tl.load(source + place, mask=place < size, other=-1)
    total = tl.zeros((BLOCK,), tl.float32)
    part = partial + index
    for _ in range(num_parts):
        total += tl.load(part, mask=index >= 0, other=0.0)
        part += partial_size
    tl.store(gradient + place, total, mask=index >= 0)


@triton.jit
def sum_squares(gradient, actor_size, size, squares, PARTS: tl.constexpr, BLOCK: tl.constexpr):
    """Write sums of the squares of the actor's and of the critic's gradients, one of each per program."""
    actor, critic = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for first in range(tl.program_id(0) * BLOCK, size, PARTS * BLOCK):
        place = first + tl.arange(0, BLOCK)
        value = tl.load(gradient + place, mask=place < size, other=0.0)
        actor += tl.where(place < actor_size, value * value, 0.0)
        critic += tl.where(place < actor_size, 0.0, value * value)
    tl.store(squares + tl.program_id(0), tl.sum(actor))
    tl.store(squares + PARTS + tl.program_id(0), tl.sum(critic))


@triton.jit
def prepare_adam_step(
    numbers, squares, learning_rate, actor_learns, steps, scalars, sums, max_norm, kl_target, lowest_rate,
    highest_rate, log_beta1, log_beta2, ADAPTIVE: tl.constexpr, PARTS: tl.constexpr,
):  # fmt: skip
    """Adapt the learning rate, decide whether to skip the step, count it, and add up the numbers of the update.

    Scalars: factors on the actor's and the critic's gradients, 1 to skip, the step's size, and the square root of
    Adam's correction of the second moment. ``sums`` are in the order of ``LOSS_NAMES``.
    """
    kl = tl.load(numbers + 3)
    rate = tl.load(learning_rate)
    if ADAPTIVE:
        wanted = tl.load(kl_target)
        factor = tl.where(kl > 2.0 * wanted, 1.0 / 1.5, tl.where((kl < 0.5 * wanted) & (kl > 0.0), 1.5, 1.0))
        factor = tl.where(tl.load(actor_learns) > 0.0, factor, 1.0)  # a fixed policy has no divergence
        rate = tl.minimum(tl.maximum(rate * factor, lowest_rate), highest_rate)
        tl.store(learning_rate, rate)
    parts = tl.arange(0, PARTS)
    actor, critic = tl.sum(tl.load(squares + parts)), tl.sum(tl.load(squares + PARTS + parts))
    norm, actor_norm, critic_norm = tl.sqrt(actor + critic), tl.sqrt(actor), tl.sqrt(critic)
    skip = (norm != norm) | (norm == float("inf"))
    step = tl.load(steps) + tl.where(skip, 0.0, 1.0)
    tl.store(steps, step)
    exact = step.to(tl.float64)
    tl.store(scalars, tl.minimum(max_norm / (actor_norm + 1e-6), 1.0))
    tl.store(scalars + 1, tl.minimum(max_norm / (critic_norm + 1e-6), 1.0))
    tl.store(scalars + 2, tl.where(skip, 1.0, 0.0))
    tl.store(scalars + 3, (rate / (1.0 - tl.exp(exact * log_beta1))).to(tl.float32))
    tl.store(scalars + 4, tl.sqrt(1.0 - tl.exp(exact * log_beta2)).to(tl.float32))
    for i in tl.static_range(4):
        tl.store(sums + i, tl.load(sums + i) + tl.where(skip, 0.0, tl.load(numbers + i)))
    tl.store(sums + 4, tl.load(sums + 4) + tl.where(skip, 0.0, norm))
    tl.store(sums + 5, tl.load(sums + 5) + tl.where(skip, 0.0, critic_norm))
    tl.store(sums + 6, tl.load(sums + 6) + tl.where(skip, 1.0, 0.0))


@triton.jit
def adam(
    parameters, gradient, moments, squares, weights, source, scalars, learning_rate, actor_size, size,
    beta1, beta2, epsilon, decay, BLOCK: tl.constexpr,
):  # fmt: skip
    """Take a step of Adam (AdamW) with clipped gradients, unless it is to be skipped, and round the weights anew."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    used = place < size
    if tl.load(scalars + 2) == 0.0:
        clip = tl.where(place < actor_size, tl.load(scalars), tl.load(scalars + 1))
        value = tl.load(gradient + place, mask=used, other=0.0) * clip
        first = tl.load(moments + place, mask=used, other=0.0)
        second = tl.load(squares + place, mask=used, other=0.0)
        first += (1.0 - beta1) * (value - first)
        second = beta2 * second + (1.0 - beta2) * value * value
        parameter = tl.load(parameters + place, mask=used, other=0.0) * (1.0 - tl.load(learning_rate) * decay)
        parameter -= tl.load(scalars + 3) * first / (tl.sqrt(second) / tl.load(scalars + 4) + epsilon)
        tl.store(moments + place, first, mask=used)
        tl.store(squares + place, second, mask=used)
        tl.store(parameters + place, parameter, mask=used)
        index = tl.load(source + place, mask=used, other=-1)
        tl.store(weights + index, parameter.to(weights.dtype.element_ty), mask=index >= 0)


@triton.jit
def round_weights(parameters, weights, source, size, BLOCK: tl.constexpr):
    """Write the weights as the matrix products read them."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    used = place < size
    index = tl.load(source + place, mask=used, other=-1)
    parameter = tl.load(parameters + place, mask=used, other=0.0)
    tl.store(weights + index, parameter.to(weights.dtype.element_ty), mask=index >= 0)
