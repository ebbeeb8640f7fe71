"""Mirror images as signed permutations."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from legged_torque.utils.errors import UserError

MIRROR_TOLERANCE = 5e-3  # by which feet [m], angles [rad] or gains up to 1 may miss the mirror images of others


@dataclass(frozen=True)
class Mirroring:
    """The left-right mirror image of a vector: entry i becomes ``signs[i]``, 1 or -1, times entry ``order[i]``."""

    order: tuple[int, ...]
    signs: tuple[float, ...]

    @classmethod
    def of_signs(cls, *signs: float) -> "Mirroring":
        """Return the mirroring of entries that stay where they are."""
        return cls(tuple(range(len(signs))), signs)

    @classmethod
    def joined(cls, parts: "Sequence[Mirroring]") -> "Mirroring":
        """Return the mirroring of several vectors behind each other."""
        order: list[int] = []
        for part in parts:
            start = len(order)
            order += [start + place for place in part.order]
        return cls(tuple(order), tuple(sign for part in parts for sign in part.signs))

    def is_its_own_inverse(self) -> bool:
        """Return whether mirroring twice changes nothing."""
        pairs = enumerate(self.order)
        return all(self.order[place] == i and self.signs[i] * self.signs[place] == 1.0 for i, place in pairs)

    def unsigned(self) -> "Mirroring":
        """Return the same permutation of values that keep their signs, such as masses."""
        return Mirroring(self.order, (1.0,) * len(self.order))

    def unlike(self, values: np.ndarray, names: Sequence[str]) -> str:
        """Return the value by which the mirror image differs most, and its counterpart's; empty if it does nowhere."""
        misses = np.abs(values[list(self.order)] * self.signs - values)
        worst = int(misses.argmax())
        if misses[worst] <= MIRROR_TOLERANCE * max(1.0, np.abs(values).max()):
            return ""
        return " and ".join(f"{values[place]:g} for '{names[place]}'" for place in sorted((worst, self.order[worst])))

    def of_vectors(self, each: "Mirroring") -> "Mirroring":
        """Return the mirroring of one vector per entry, each of which is mirrored by ``each``."""
        size = len(each.order)
        order = [size * place + part for place in self.order for part in each.order]
        return Mirroring(tuple(order), each.signs * len(self.order))


SCALAR = Mirroring.of_signs(1.0)  # a number that is the same in the mirror
VECTOR = Mirroring.of_signs(1.0, -1.0, 1.0)  # a vector (x, y, z) in the trunk's frame: a velocity, a force, a place
AXIAL_VECTOR = Mirroring.of_signs(-1.0, 1.0, -1.0)  # an axial vector there: an angular velocity, a moment
PLANAR_VELOCITY = Mirroring.of_signs(1.0, -1.0, -1.0)  # v_x, v_y and yaw rate in the trunk's frame


def counterparts(names: Sequence[str], mirrored_legs: Sequence[Sequence[str]]) -> tuple[int, ...]:
    """Return where each part's counterpart on the other side is: that of FR_hip is FL_hip; a UserError without it."""
    other_leg = {leg: other for pair in mirrored_legs for leg, other in (pair, reversed(pair))}
    result = []
    for name in names:
        leg = next((leg for leg in other_leg if name.startswith(leg)), None)
        if leg is None:
            raise UserError(f"'{name}' has no counterpart: asset.mirrored_legs, {mirrored_legs}, lacks its leg")
        other = other_leg[leg] + name.removeprefix(leg)
        if other not in names:
            raise UserError(f"'{name}' has no counterpart '{other}' on the other side")
        result.append(list(names).index(other))
    return tuple(result)


def mirror_signs(names: Sequence[str], axes: ArrayLike, order: Sequence[int]) -> tuple[float, ...]:
    """Return whether mirrored angles have the other sign: a turn about (x, y, z) becomes one about (-x, y, -z).

    A UserError if the axes of two counterparts, in the trunk's frame where all angles are 0, do not allow that.
    """
    axes = np.asarray(axes)
    cosines = (axes[list(order)] * AXIAL_VECTOR.signs * axes).sum(axis=1)
    for name, cosine, other in zip(names, cosines, order, strict=True):
        if abs(cosine) < 0.999:
            raise UserError(f"the axes of '{name}' and '{names[other]}' are not mirror images of each other")
    return tuple(np.sign(cosines).tolist())
