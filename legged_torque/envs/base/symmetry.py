"""The left-right mirror image of what a policy sees and does, for rsl_rl's symmetry extension."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.utils.errors import UserError
from legged_torque.utils.mirroring import Mirroring, counterparts, mirror_signs

Names = Sequence[str]


class RobotSymmetry:
    """Which joints and feet of a robot are mirror images of each other.

    Attributes:
        joints: Mirroring of joint angles; their signs follow from the axes. None without symmetry.
        feet: Mirroring of one number per foot. None without symmetry.
        foot_geoms: Mirroring of one number per geom of the feet. None without symmetry.
        foot_pairs: Places of the right and left foot of each pair of legs.
        problem: Why there is no symmetry, empty if there is one.
    """

    def __init__(
        self,
        mirrored_legs: Sequence[Names],
        dof_names: Names,
        dof_axes: Sequence[Sequence[float]],
        foot_names: Names,
        foot_of: Sequence[int],
    ) -> None:
        """Match names: those of the legs in ``asset.mirrored_legs``, and of joints and geoms of feet in their order.

        ``dof_axes`` are the joints' axes in the trunk's frame where all angles are 0, shape (num_dof, 3); ``foot_of``
        says to which foot each of the geoms belongs.
        """
        self.joints: Mirroring | None = None
        self.feet: Mirroring | None = None
        self.foot_geoms: Mirroring | None = None
        geoms = [(_place(foot_names, right), _place(foot_names, left)) for right, left in mirrored_legs]
        self.foot_pairs = [(foot_of[right], foot_of[left]) for right, left in geoms]
        self.problem = ""
        try:
            order = counterparts(dof_names, mirrored_legs)
            self.joints = Mirroring(order, mirror_signs(dof_names, dof_axes, order))
            geoms_order = counterparts(foot_names, mirrored_legs)
            others = dict(zip(foot_of, (foot_of[place] for place in geoms_order), strict=True))
            self.foot_geoms = Mirroring(geoms_order, (1.0,) * len(geoms_order))
            self.feet = Mirroring(tuple(others.values()), (1.0,) * len(others))
        except UserError as error:
            self.refuse(str(error))

    def refuse(self, problem: str) -> None:
        """Have no symmetry, because of a problem; empty if there is none."""
        if problem:
            self.joints, self.feet, self.foot_geoms, self.problem = None, None, None, problem


def _place(names: Names, leg: str) -> int:
    """Return the place of the name that begins with that of a leg; a UserError if there is none."""
    for place, name in enumerate(names):
        if name.startswith(leg):
            return place
    raise UserError(f"asset.mirrored_legs: no foot's name begins with '{leg}'; the feet are {', '.join(names)}")


class Mirror:
    """Reflects vectors at the robot's sagittal plane.

    Attributes:
        maps: Order and signs of the mirror image of each kind of vector: entry i becomes sign i times entry order i.
    """

    def __init__(self, parts: Mapping[str, Sequence[tuple[str, Mirroring | None]]], problem: str, device: str) -> None:
        """Prepare the permutations.

        ``parts`` are, for each kind of vector, its terms by name, one behind the other. A UserError says which mirror
        image is not known or not its own inverse, or the ``problem``, why the robot is not symmetric.
        """
        self.maps: dict[str, tuple[Tensor, Tensor]] = {}
        for kind, terms in parts.items():
            for name, mirroring in terms:
                if mirroring is None:
                    reason = problem or f"the mirror image of '{name}' in '{kind}' is not known"
                    without = "algorithm.symmetry_cfg.use_data_augmentation=false trains without mirror images"
                    raise UserError(f"{reason}; {without}")
                if not mirroring.is_its_own_inverse():
                    raise UserError(f"mirrored twice, '{name}' in '{kind}' is not what it was")
            whole = Mirroring.joined([mirroring for _, mirroring in terms if mirroring])
            self.maps[kind] = torch.tensor(whole.order, device=device), torch.tensor(whole.signs, device=device)

    def __call__(self, name: str, values: Tensor) -> Tensor:
        """Return the mirror image of a group of observations or of "actions". Shape: (samples, any)."""
        order, signs = self.maps[name]
        return (values.flatten(1).index_select(1, order) * signs).view(values.shape)


def with_mirror_images(
    env: Any, obs: TensorDict | None, actions: Tensor | None
) -> tuple[TensorDict | None, Tensor | None]:
    """Return observations and actions followed by their mirror images: rsl_rl's ``data_augmentation_func``.

    Shapes: (samples, size) and (samples, num_actions); what is None stays None.
    """
    if obs is not None:
        tensors: Any = obs.items()
        groups = {name: torch.cat([group, env.mirror(name, group)]) for name, group in tensors}
        obs = TensorDict(groups, [2 * len(obs)])
    if actions is not None:
        actions = torch.cat([actions, env.mirror("actions", actions)])
    return obs, actions
