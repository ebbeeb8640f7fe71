"""The fit of a log: a search by CMA-ES, then Gauss-Newton steps, whose matrix says how certain the numbers are.

Gauss-Newton alone takes half the time, but missed one of ten drives that were drawn from all that is searched.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from legged_torque.identification.recording import Recording
from legged_torque.identification.worlds import PARAMETERS, STEP, HangingRobots
from legged_torque.utils.errors import UserError, refuse

try:
    from cmaes import CMA
except ImportError as error:
    raise UserError(f"identification needs the extra: pip install 'legged_torque[identify]' ({error})") from None

HELD_OUT = 0.2  # share of the log, at its end, to which nothing is fitted
SETTLE = 1.0  # [s] at its start that count for nothing: one measurement does not tell the state there
LARGEST = (0.003, 0.05, 0.1)  # of armature [s^2], viscous [s] and Coulomb friction, in units of the torque limit
BIAS, DELAY = 0.1, 0.02  # largest [rad, s], as of PACE; explicit steps of a simulation act early: from -STEP on
GENERATIONS, SIGMA, SEED = 10, 0.25, 1  # of CMA-ES; sigma in units of what is searched
DIFFERENCE = 0.002  # for derivatives, in units of what is searched
STEPS, GAIN = 30, 0.1  # of Gauss-Newton: at most, and of the logarithm of the likelihood in the last one
FINER = 4  # how many times as many physics steps the second fit takes
ROUNDS = GENERATIONS + 2 * STEPS  # at most
LEAST_NOISE = np.array([[1e-5], [1e-3]])  # [rad, rad/s] what Unitree's encoders resolve, over sqrt(12)
BLOCK = 0.25  # [s] after which residuals are taken as independent
QUANTILE = 1.96  # of 95%
UNKNOWN = 0.05
"""Widest interval, either way, in units of what is searched: trainings without a log draw from 5 to 8% either way."""
WHY = ["the joint hardly accelerates", *["the joint hardly moves"] * 2, "gravity hardly acts", "nothing moves fast"]
Equations = tuple[np.ndarray, np.ndarray, np.ndarray]  # matrix (n, n), gradient (n,), its parts by time (blocks, n)


@dataclass
class Identified:
    """What a log says.

    Attributes:
        values, half_widths: :data:`PARAMETERS` by joint, and their 95% intervals either way. Shapes: (5, joints).
        noise: Root mean square of residuals, positions [rad] and velocities [rad/s]. Shape: (2, joints).
        held_out: The same where nothing was fitted, of the robot's file and of the second fit. Shape: (2, 2, joints).
    """

    values: np.ndarray
    half_widths: np.ndarray
    noise: np.ndarray
    held_out: np.ndarray


def identify(cfg: Any, recording: Recording, device: str, progress: Callable[[], None] = lambda: None) -> Identified:
    """Return which drives of a task's robot explain a recording; a UserError names numbers that it does not tell.

    Physics steps of length h bias a fit by a h^2, which may be more than what noise does. So there is a second fit with
    shorter steps, and both give the numbers at h = 0. ``progress`` is called after each round, of which there are
    ROUNDS at most.
    """
    coarse, fine = (Problem(HangingRobots(cfg, recording, device, times), recording) for times in (1, FINER))
    first, *_ = coarse.refine(coarse.search(progress), progress)
    second, noise, equations = fine.refine(first, progress)
    values = second + (second - first) / (FINER**2 - 1)
    half_widths = fine.spread(fine.half_widths(values, equations))
    return Identified(fine.spread(fine.clip(values)), half_widths, noise, fine.held_out(second))


class Problem:
    """Least squares of n numbers: the first of :data:`PARAMETERS` for all joints, then the others, but one delay."""

    def __init__(self, robots: HangingRobots, recording: Recording) -> None:
        """Take robots under the commands of a recording."""
        self._robots, period, names = robots, recording.period, recording.joint_order
        self._joints, last, limits = len(names), 4 * len(names), np.abs(robots.torque_limits).max(axis=0)
        self._first, self._block = round(SETTLE / period), round(BLOCK / period)
        self._ticks = round((1.0 - HELD_OUT) * len(recording.commands))
        self._high = np.array([*np.outer(LARGEST, limits).flat, *[BIAS] * len(names), DELAY])
        self._low = np.array([*1e-3 * LARGEST[0] * limits, *[0.0] * 2 * len(names), *[-BIAS] * len(names), -STEP])
        self._range = self._high - self._low
        self._names = [*(f"{kind} of {name}" for kind in PARAMETERS[:4] for name in names), PARAMETERS[4]]
        own = [[kind * len(names) + joint for kind in range(4) for joint in leg] + [last] for leg in robots.branches]
        self._legs = list(zip(robots.branches, own, strict=True))  # joints and numbers of each
        places = range(max(map(len, own)) - 1)
        self._groups = [[each[place] for each in own if place < len(each) - 1] for place in places] + [[last]]
        measured = torch.tensor(recording.measured, dtype=torch.float32)
        self._known, self._measured = ~measured.isnan(), measured.nan_to_num()
        self._counts = self._known[self._first : self._ticks].sum(dim=0).numpy()

    def spread(self, numbers: np.ndarray) -> np.ndarray:
        """Return numbers by joint. Shapes: (n,) to (5, joints)."""
        return np.vstack([numbers[:-1].reshape(4, -1), np.full(self._joints, numbers[-1])])

    def clip(self, numbers: np.ndarray) -> np.ndarray:
        """Return numbers (n,) within what is searched."""
        return np.clip(numbers, self._low, self._high)

    def _residuals(self, parameters: np.ndarray, first: int, ticks: int) -> Tensor:
        """Return what encoders say less what was measured, 0 where nothing was. Shape: (ticks, worlds, 2, joints)."""
        seen = self._robots.run(parameters, ticks)[first:].cpu()
        return (seen - self._measured[first:ticks, None]) * self._known[first:ticks, None]

    def held_out(self, numbers: np.ndarray) -> np.ndarray:
        """Return the errors :attr:`Identified.held_out`."""
        both, known = [self._robots.file_values, self.spread(numbers)], self._known[self._ticks :].sum(dim=0).numpy()
        candidates = np.resize(both, (self._robots.num_worlds, 5, self._joints))
        squares = self._residuals(candidates, self._ticks, len(self._known))[:, :2].double().square().sum(dim=0)
        return np.sqrt(squares.numpy() / known)

    def search(self, progress: Callable[[], None]) -> np.ndarray:
        """Return numbers near the best (n,), with an optimizer for each leg, since legs do not feel each other."""
        size, spread = self._robots.num_worlds, self._measured[self._first : self._ticks].var(dim=0).numpy()
        boxes = [np.tile([0.0, 1.0], (len(own), 1)) for _, own in self._legs]
        optimizers = [CMA(box.mean(axis=1), SIGMA, box, seed=SEED, population_size=size) for box in boxes]
        best = [(np.inf, np.zeros(0))] * len(boxes)
        for _ in range(GENERATIONS):
            asked = [np.array([optimizer.ask() for _ in range(size)]) for optimizer in optimizers]
            candidates, tried = np.zeros((size, 5, self._joints)), []
            for (joints, own), points in zip(self._legs, asked, strict=True):
                curved = points ** np.where(np.array(own) < 3 * self._joints, 2, 1)  # more of small ones
                tried.append(self._low[own] + self._range[own] * curved)
                candidates[:, :4, joints] = tried[-1][:, :-1].reshape(size, 4, -1)
                candidates[:, 4, joints] = tried[-1][:, -1:]
            squares = self._residuals(candidates, self._first, self._ticks).double().square().sum(dim=0).numpy()
            costs = np.nan_to_num(squares / (self._counts * spread), nan=1e9, posinf=1e9).sum(axis=1)
            for place, (joints, _) in enumerate(self._legs):
                of_leg = costs[:, joints].sum(axis=1)
                optimizers[place].tell(list(zip(asked[place], of_leg.tolist(), strict=True)))
                best[place] = min(best[place], (of_leg.min(), tried[place][of_leg.argmin()]), key=lambda pair: pair[0])
            progress()
        numbers = np.zeros_like(self._low)
        for (_, own), (_, of_leg) in zip(self._legs, best, strict=True):
            numbers[own] = of_leg  # and the delay of the last one
        return numbers

    def refine(self, numbers: np.ndarray, progress: Callable[[], None]) -> tuple[np.ndarray, np.ndarray, Equations]:
        """Return the most likely numbers (n,), the noise :attr:`Identified.noise`, and the normal equations there.

        After Levenberg and Marquardt. Each position and velocity has noise of its own, of the size of its residuals.
        """
        (noise, equations), damping = self._linearized(numbers), 1e-3
        for _ in range(STEPS):
            matrix, gradient, _ = equations
            free = np.flatnonzero(np.where(gradient > 0.0, numbers > self._low, numbers < self._high))
            damped = matrix + np.diag(damping * np.diag(matrix) + 1e-6 * self._range**-2)
            tried = numbers.copy()
            tried[free] -= np.linalg.solve(damped[np.ix_(free, free)], gradient[free])
            tried = self.clip(tried)
            of_tried, equations_of_tried = self._linearized(tried)
            gain = float((self._counts * np.log(noise / of_tried)).sum())
            progress()
            if gain > 0.0:
                numbers, noise, equations = tried, of_tried, equations_of_tried
            damping = max(0.1 * damping, 1e-6) if gain > 0.0 else 10.0 * damping
            if abs(gain) < GAIN or damping > 1e3:
                break
        return numbers, noise, equations

    def _linearized(self, numbers: np.ndarray) -> tuple[np.ndarray, Equations]:
        """Return noise and normal equations; each number is changed in two worlds, those of other legs in the same."""
        candidates, spans = [numbers], []
        for group in self._groups:
            ends = np.array([numbers, numbers])
            ends[0, group] = np.minimum(numbers + DIFFERENCE * self._range, self._high)[group]
            ends[1, group] = np.maximum(numbers - DIFFERENCE * self._range, self._low)[group]
            candidates += list(ends)
            spans.append(ends[0] - ends[1])
        residuals = self._residuals(np.array([self.spread(each) for each in candidates]), self._first, self._ticks)
        noise = np.sqrt(residuals[:, 0].double().square().sum(dim=0).numpy() / self._counts)
        noise = np.maximum(np.nan_to_num(noise, nan=1e3), LEAST_NOISE)
        scaled = residuals / torch.tensor(noise, dtype=torch.float32)
        changes, starts = scaled[:, 1::2] - scaled[:, 2::2], np.arange(0, len(scaled), self._block)
        matrix, scores = np.zeros((len(numbers), len(numbers))), np.zeros((len(starts), len(numbers)))
        for joints, own in self._legs:
            places = [*range(len(own) - 1), len(spans) - 1]
            widths = np.array([spans[place][number] for place, number in zip(places, own, strict=True)])
            slopes = changes[:, places][..., joints].flatten(2).double().numpy() / widths[:, None]
            matrix[np.ix_(own, own)] += np.einsum("tac,tbc->ab", slopes, slopes, optimize=True)
            of_leg = np.einsum("tac,tc->ta", slopes, scaled[:, 0][..., joints].flatten(1).double().numpy())
            scores[:, own] += np.add.reduceat(of_leg, starts)
        return noise, (matrix, scores.sum(axis=0), scores)

    def half_widths(self, numbers: np.ndarray, equations: Equations) -> np.ndarray:
        """Return 95% intervals either way (n,); a UserError names numbers that are not told, or beyond the search.

        Fisher's, from the matrix, for residuals that are white noise; that of a "sandwich" of the gradient's parts by
        time where its variance is more than twice that, since residuals last there: the model is wrong.
        """
        matrix, _, scores = equations
        matrix = matrix + np.diag(1e-6 * self._range**-2)  # for what nothing depends on
        inverse, alone = np.linalg.inv(matrix), QUANTILE * np.diag(matrix) ** -0.5
        sandwich = np.diag(inverse @ scores.T @ scores @ inverse)
        half = QUANTILE * np.sqrt(np.where(sandwich > 2.0 * np.diag(inverse), sandwich, np.diag(inverse)))
        is_beyond = (numbers >= self._high) | ((numbers <= self._low) & (self._low < 0.0))
        problems = [f"{self._names[number]} is {numbers[number]:.3g} or beyond" for number in np.flatnonzero(is_beyond)]
        for number in np.flatnonzero(half > UNKNOWN * self._range):
            related = np.abs(inverse[number]) * np.diag(inverse) ** -0.5 * (np.arange(len(numbers)) != number)
            why = f"it cannot be told from {self._names[int(related.argmax())]}"
            if alone[number] > UNKNOWN * self._range[number]:
                why = WHY[number // self._joints]
            problems.append(f"{self._names[number]} is known to +-{half[number]:.2g} only: {why}")
        refuse(problems)
        return half
