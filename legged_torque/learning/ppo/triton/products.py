"""Matrix products of several layers at once, with biases, ELUs and their gradients, as Triton kernels.

A program computes one tile of one layer for ``SAMPLES`` samples. A row of a table of integers describes the tile; the
kernels' docstrings name its columns. Places are offsets from the start of an array, in numbers. All widths are
multiples of 64, which a tile may exceed: what it reads beyond is not used.
"""

import triton
import triton.language as tl

FORWARD = {"num_warps": 8, "num_stages": 3}  # the fastest on an H200, of 4 and 8 warps, and 2 to 4 stages
NARROW = BACKWARD = {"num_warps": 4, "num_stages": 3}  # the fastest of 2, 4 and 8 warps for gradients


@triton.jit
def entry(row, column: tl.constexpr):
    """Return an entry of a table, one that is a multiple of 64."""
    return tl.multiple_of(tl.load(row + column), 64)


@triton.jit
def forward(
    values, weights, parameters, outputs, table, HAS_OUTPUTS: tl.constexpr, COLUMNS: tl.constexpr,
    SAMPLES: tl.constexpr, TILE: tl.constexpr, STEP: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Write ELU(x W^T + b) of one tile.

    Table: 0 place and 1 stride of x, 2 its columns, 3 place and 4 stride of W, 5 place and 6 stride of the result,
    7 its columns with the zeros behind them, 8 columns of these that are used, 9 place of b, 10 whether to apply the
    ELU, 11 place and 12 stride of the network's outputs in float32, -1 for none.
    """
    row = table + tl.program_id(0) * COLUMNS
    first = tl.program_id(1).to(tl.int64) * SAMPLES
    stride, w_stride, size = entry(row, 1).to(tl.int32), entry(row, 4).to(tl.int32), entry(row, 2).to(tl.int32)
    x = values + entry(row, 0) + first * stride
    w = weights + entry(row, 3)
    result, result_stride, width = entry(row, 5), entry(row, 6).to(tl.int32), entry(row, 7).to(tl.int32)
    used, bias, has_elu = tl.load(row + 8).to(tl.int32), tl.load(row + 9), tl.load(row + 10)
    samples, columns, terms = tl.arange(0, SAMPLES), tl.arange(0, TILE), tl.arange(0, STEP)
    from_x = samples[:, None] * stride + terms[None, :]
    from_w = columns[None, :] * w_stride + terms[:, None]
    total = tl.zeros((SAMPLES, TILE), tl.float32)
    for _ in range(0, size, STEP):
        total = tl.dot(tl.load(x + from_x), tl.load(w + from_w), total, input_precision=PRECISION)
        x += STEP
        w += STEP
    total += tl.load(parameters + bias + columns, mask=columns < used, other=0.0)[None, :]
    if HAS_OUTPUTS:
        place, out_stride = tl.load(row + 11), tl.load(row + 12).to(tl.int32)
        out = outputs + place + first * out_stride + samples[:, None] * out_stride + columns[None, :]
        tl.store(out, total, mask=(columns < tl.where(place >= 0, used, 0))[None, :])
    if has_elu != 0:
        total = tl.where(total > 0.0, total, tl.exp(total) - 1.0)
    out = values + result + first * result_stride + samples[:, None] * result_stride + columns[None, :]
    tl.store(out, total.to(values.dtype.element_ty), mask=(columns < width)[None, :])


@triton.jit
def input_gradient(
    values, gradients, weights, sums, sums_stride, table, COLUMNS: tl.constexpr, SAMPLES: tl.constexpr,
    TILE: tl.constexpr, STEP: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Write the gradient of one tile of what a layer reads, g W times the slope of the ELU that made it, and its sum.

    The sum over the samples is the gradient of biases. Table: 0 place and 1 stride of g, 2 its columns, 3 place and
    4 stride of W, 5 place and 6 stride of the result, 7 its columns, 8 column of the sums, 9 to how many columns of
    what is there the result is added, 10 whether an ELU made what the layer reads.
    """
    row = table + tl.program_id(0) * COLUMNS
    first = tl.program_id(1).to(tl.int64) * SAMPLES
    stride, w_stride, size = entry(row, 1).to(tl.int32), entry(row, 4).to(tl.int32), entry(row, 2).to(tl.int32)
    g = gradients + entry(row, 0) + first * stride
    w = weights + entry(row, 3)
    result_stride, width = entry(row, 6).to(tl.int32), entry(row, 7).to(tl.int32)
    place = entry(row, 5) + first * result_stride
    column, adds, has_elu = tl.load(row + 8), tl.load(row + 9), tl.load(row + 10)
    samples, columns, terms = tl.arange(0, SAMPLES), tl.arange(0, TILE), tl.arange(0, STEP)
    kept = (columns < width)[None, :]
    from_g = samples[:, None] * stride + terms[None, :]
    from_w = terms[:, None] * w_stride + columns[None, :]
    total = tl.zeros((SAMPLES, TILE), tl.float32)
    for _ in range(0, size, STEP):
        total = tl.dot(tl.load(g + from_g), tl.load(w + from_w), total, input_precision=PRECISION)
        g += STEP
        w += STEP * w_stride
    here = samples[:, None] * result_stride + columns[None, :]
    if adds != 0:
        there = kept & (columns < adds)[None, :]  # not to the zeros behind: NaN, once it is there, would stay
        total += tl.load(gradients + place + here, mask=there, other=0.0).to(tl.float32)
    if has_elu != 0:
        value = tl.load(values + place + here, mask=kept, other=0.0).to(tl.float32)
        total = tl.where(value > 0.0, total, total * (value + 1.0))
    tl.store(gradients + place + here, total.to(gradients.dtype.element_ty), mask=kept)
    out = sums + tl.program_id(1).to(tl.int64) * sums_stride + column + columns
    tl.store(out, tl.sum(total, 0), mask=columns < width)


@triton.jit
def weight_gradient(
    values, gradients, partial, samples_each, partial_size, table, COLUMNS: tl.constexpr, TILE: tl.constexpr,
    STEP: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Write the gradient of one tile of weights, g^T x, from a part of the samples.

    Table: 0 place and 1 stride of g, 2 its columns, 3 place and 4 stride of x, 5 its columns, 6 place and 7 stride of
    the result in a part of ``partial``.
    """
    row = table + tl.program_id(0) * COLUMNS
    first = tl.program_id(1).to(tl.int64) * samples_each
    stride, x_stride = entry(row, 1).to(tl.int32), entry(row, 4).to(tl.int32)
    g = gradients + entry(row, 0) + first * stride
    x = values + entry(row, 3) + first * x_stride
    height, width = entry(row, 2).to(tl.int32), entry(row, 5).to(tl.int32)
    out = partial + tl.program_id(1).to(tl.int64) * partial_size + entry(row, 6)
    out_stride = entry(row, 7).to(tl.int32)
    rows, columns, samples = tl.arange(0, TILE), tl.arange(0, TILE), tl.arange(0, STEP)
    from_g = samples[:, None] * stride + rows[None, :]
    from_x = samples[:, None] * x_stride + columns[None, :]
    total = tl.zeros((TILE, TILE), tl.float32)
    for _ in range(0, samples_each, STEP):
        total = tl.dot(tl.trans(tl.load(g + from_g)), tl.load(x + from_x), total, input_precision=PRECISION)
        g += STEP * stride
        x += STEP * x_stride
    kept = (rows < height)[:, None] & (columns < width)[None, :]
    tl.store(out + rows[:, None] * out_stride + columns[None, :], total, mask=kept)
