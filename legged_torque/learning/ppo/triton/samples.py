"""Triton kernels of single samples, before and after the networks: observations, actions, losses.

Blocks of samples are rows; the columns of actions are padded to a power of two.
"""

import triton
import triton.language as tl

ROWS = 16  # samples of a program that writes what it reads
NUMBERS = 1024  # that it reads at most, where a sample has not more


@triton.jit
def observe(
    observations, indices, order, signs, values, place, stride, first_column, num_chosen, num_samples, size,
    CHOOSE: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Write the observations of chosen samples, their mirror images, and zeros; of all samples without ``CHOOSE``."""
    samples = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    columns = tl.arange(0, COLUMNS)
    used = (samples < num_samples)[:, None] & (columns < size)[None, :]
    if CHOOSE:
        is_image = (samples >= num_chosen)[:, None]
        among_chosen = tl.where(samples >= num_chosen, samples - num_chosen, samples)
        chosen = tl.load(indices + among_chosen, mask=samples < num_samples, other=0)
        mirrored = tl.load(order + columns, mask=columns < size, other=0)
        sign = tl.load(signs + columns, mask=columns < size, other=0.0)
        source = tl.where(is_image, mirrored[None, :], columns[None, :])
        value = tl.load(observations + chosen[:, None] * size + source, mask=used, other=0.0)
        value = tl.where(is_image, value * sign[None, :], value)
    else:
        value = tl.load(observations + samples[:, None] * size + columns[None, :], mask=used, other=0.0)
    out = values + place + samples.to(tl.int64)[:, None] * stride + first_column + columns[None, :]
    tl.store(out, value.to(values.dtype.element_ty), mask=(columns < size)[None, :])


@triton.jit
def deviation(parameter, low, high, IS_LOG: tl.constexpr):
    """Return the standard deviations of actions, and their change per change of the parameter."""
    clamped = tl.minimum(tl.maximum(parameter, low), high)
    std = tl.exp(clamped) if IS_LOG else clamped
    slope = std if IS_LOG else tl.full(std.shape, 1.0, tl.float32)
    return std, tl.where((parameter >= low) & (parameter <= high), slope, 0.0)


@triton.jit
def act(
    outputs, noise, std_parameter, low, high, actions, means, stds, log_probs, values, num_samples, size,
    IS_LOG: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Sample actions; write them, their distribution, their logarithms of probability and the values of the states."""
    samples = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    columns = tl.arange(0, COLUMNS)
    is_action, is_sample = columns < size, samples < num_samples
    used = is_sample[:, None] & is_action[None, :]
    std, _ = deviation(tl.load(std_parameter + columns, mask=is_action, other=0.0), low, high, IS_LOG)
    place = samples[:, None] * size + columns[None, :]
    mean = tl.load(outputs + samples[:, None] * (size + 1) + columns[None, :], mask=used, other=0.0)
    drawn = tl.load(noise + place, mask=used, other=0.0)
    action = mean + std[None, :] * drawn
    tl.store(actions + place, action, mask=used)
    tl.store(means + place, mean, mask=used)
    tl.store(stds + columns, std, mask=is_action)  # by every program, the same
    tl.store(log_probs + samples, log_probability(action, mean, std, is_action), mask=is_sample)
    value = tl.load(outputs + samples * (size + 1) + size, mask=is_sample, other=0.0)
    tl.store(values + samples, value, mask=is_sample)


@triton.jit
def log_probability(action, mean, std, is_action):
    """Return the logarithm of the probability density of actions."""
    distance = (action - mean) / std[None, :]
    half_log_two_pi = 0.9189385332046727
    terms = 0.5 * distance * distance + tl.log(std)[None, :] + half_log_two_pi
    return -tl.sum(tl.where(is_action[None, :], terms, 0.0), 1)


@triton.jit
def divergence(old_mean, old_std, mean, std):
    """Return the KL divergence of each action's distribution from the one that it was drawn from."""
    variance_ratio = (old_std / std) * (old_std / std)
    moved = (old_mean - mean) / std[None, :]
    return 0.5 * (variance_ratio[None, :] + moved * moved - 1.0 - tl.log(variance_ratio)[None, :])


@triton.jit
def squared_error(value, first, target, clip, CLIP_VALUES: tl.constexpr):
    """Return the squared errors of values, which may be clipped around ``first``, and their gradients."""
    error = value - target
    loss, by_value = error * error, 2.0 * error
    if CLIP_VALUES:
        change = value - first
        limited = first + tl.minimum(tl.maximum(change, -clip), clip) - target
        inside = tl.where((change >= -clip) & (change <= clip), 2.0 * limited, 0.0)
        squared = limited * limited
        by_value = tl.where(loss < squared, inside, by_value)
        loss = tl.maximum(loss, squared)
    return loss, by_value


@triton.jit
def losses(
    outputs, std_parameter, low, high, old_std, indices, order, signs, actions, means, log_probs, values, advantages,
    returns, actor_learns, gradients, places, strides, sums, sums_stride, num_chosen, num_samples, size,
    clip, value_weight, entropy_weight, action_weights, IS_LOG: tl.constexpr, CLIP_VALUES: tl.constexpr,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Write the gradients of the losses by the outputs of the networks, and each program's sums of the losses.

    Sums: value loss, surrogate loss, entropy, KL divergence of the samples that are no mirror images, then the
    gradients by the parameters of the standard deviations, and by each output.
    ``places`` and ``strides``: where the gradient by each output belongs.
    """
    samples = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    columns = tl.arange(0, COLUMNS)
    is_action, is_sample = columns < size, samples < num_samples
    used = is_sample[:, None] & is_action[None, :]
    is_image = samples >= num_chosen
    chosen = tl.load(indices + tl.where(is_image, samples - num_chosen, samples), mask=is_sample, other=0)
    mirrored = tl.load(order + columns, mask=is_action, other=0)
    sign = tl.load(signs + columns, mask=is_action, other=0.0)
    source = tl.where(is_image[:, None], mirrored[None, :], columns[None, :])
    action = tl.load(actions + chosen[:, None] * size + source, mask=used, other=0.0)
    action = tl.where(is_image[:, None], action * sign[None, :], action)
    mean = tl.load(outputs + samples[:, None] * (size + 1) + columns[None, :], mask=used, other=0.0)
    std, slope = deviation(tl.load(std_parameter + columns, mask=is_action, other=0.0), low, high, IS_LOG)
    std = tl.where(is_action, std, 1.0)

    before = tl.load(log_probs + chosen, mask=is_sample, other=0.0)
    ratio = tl.exp(log_probability(action, mean, std, is_action) - before)
    advantage = tl.load(advantages + chosen, mask=is_sample, other=0.0)
    surrogate = -advantage * ratio
    clipped = -advantage * tl.minimum(tl.maximum(ratio, 1.0 - clip), 1.0 + clip)
    unclipped = tl.where(surrogate < clipped, 0.0, surrogate)  # NaN stays NaN, here and below, and is seen in the norm
    by_log_prob = tl.where(is_sample, unclipped, 0.0) / num_samples * tl.load(actor_learns)
    distance = (action - mean) / std[None, :]
    by_mean = tl.where(used, by_log_prob[:, None] * distance / std[None, :], 0.0)
    share = tl.sum(is_sample.to(tl.float32)) / num_samples  # of this program
    by_std = tl.sum(tl.where(used, by_log_prob[:, None] * (distance * distance - 1.0), 0.0), 0)
    weight = tl.load(action_weights + columns, mask=is_action, other=0.0)
    by_std = (by_std - tl.load(entropy_weight) * weight * share * tl.load(actor_learns)) / std * slope
    half_log_two_pi_e = 1.4189385332046727
    entropy = share * tl.sum(weight * (half_log_two_pi_e + tl.log(std)))

    old_mean = tl.load(means + chosen[:, None] * size + columns[None, :], mask=used, other=0.0)
    old = tl.load(old_std + columns, mask=is_action, other=1.0)
    kl = tl.sum(tl.where(used & (samples < num_chosen)[:, None], divergence(old_mean, old, mean, std), 0.0))

    value = tl.load(outputs + samples * (size + 1) + size, mask=is_sample, other=0.0)
    first = tl.load(values + chosen, mask=is_sample, other=0.0)
    target = tl.load(returns + chosen, mask=is_sample, other=0.0)
    value_loss, by_value = squared_error(value, first, target, clip, CLIP_VALUES)
    by_value = tl.where(is_sample, by_value * value_weight / num_samples, 0.0)

    place = tl.load(places + columns, mask=is_action, other=0)
    stride = tl.load(strides + columns, mask=is_action, other=0)
    out = gradients + place[None, :] + samples[:, None] * stride[None, :]
    tl.store(out, by_mean.to(gradients.dtype.element_ty), mask=is_action[None, :])
    out = gradients + tl.load(places + size) + samples * tl.load(strides + size)
    tl.store(out, by_value.to(gradients.dtype.element_ty))
    out = sums + tl.program_id(0) * sums_stride
    tl.store(out, tl.sum(tl.where(is_sample, value_loss, 0.0)) / num_samples)
    tl.store(out + 1, tl.sum(tl.where(is_sample, tl.maximum(surrogate, clipped), 0.0)) / num_samples)
    tl.store(out + 2, entropy)
    tl.store(out + 3, kl / num_chosen)
    tl.store(out + 4 + columns, by_std, mask=is_action)
    tl.store(out + 4 + size + columns, tl.sum(by_mean, 0), mask=is_action)
    tl.store(out + 4 + 2 * size, tl.sum(by_value))


@triton.jit
def generalized_advantages(
    rewards, dones, values, last_values, returns, advantages, num_steps, num_worlds, gamma, lam, WORLDS: tl.constexpr
):
    """Compute returns and advantages (GAE) of each world, from the last step to the first."""
    worlds = tl.program_id(0) * WORLDS + tl.arange(0, WORLDS)
    used = worlds < num_worlds
    advantage = tl.zeros((WORLDS,), tl.float32)
    following = tl.load(last_values + worlds, mask=used, other=0.0)
    for back in range(num_steps):
        place = (num_steps - 1 - back) * num_worlds + worlds
        goes_on = 1.0 - tl.load(dones + place, mask=used, other=0).to(tl.float32)
        value = tl.load(values + place, mask=used, other=0.0)
        delta = tl.load(rewards + place, mask=used, other=0.0) + goes_on * gamma * following - value
        advantage = delta + goes_on * gamma * lam * advantage
        total = advantage + value
        tl.store(returns + place, total, mask=used)
        tl.store(advantages + place, total - value, mask=used)
        following = value
