"""Mirror images of the A1's vectors by hand."""

import torch


def mirror_joints(values):
    """Joint by joint: FR and FL change places, RR and RL do, and hips, which turn about x, change their sign."""
    legs = values.reshape(len(values), -1, 4, 3)[:, :, [1, 0, 3, 2]]
    return (legs * torch.tensor([-1.0, 1.0, 1.0])).reshape(values.shape)


def mirror_policy(obs):
    """Gravity, angular velocity, command, joint positions, joint velocities, last actions."""
    signs = torch.tensor([1.0, -1, 1, -1, 1, -1, 1, -1, -1])
    return torch.cat([obs[:, :9] * signs, *map(mirror_joints, (obs[:, 9:21], obs[:, 21:33], obs[:, 33:]))], dim=1)
