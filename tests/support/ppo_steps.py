"""PPO's gradient steps, tensor by tensor, to compare compiled ones with."""

import numpy as np
import torch
from torch import nn


def by_tensors(networks, optimizer, rows, orders, settings):
    """The gradient steps of PPO with torch's own gradient, norm and Adam, in the networks' precision.

    Args:
        networks: From stacks to logits, and to values (N, 1).
        optimizer, rows, orders, settings: As of `models.policy.dense_update.update_dense`.
    """
    parameters = optimizer.param_groups[0]["params"]
    optimizer.param_groups[0]["lr"] = settings.lr
    kind = parameters[0].dtype
    stacks, told, actions, logps, advantages, targets = map(torch.from_numpy, rows)
    for order in orders:
        figures = []
        for n in torch.from_numpy(order).split(settings.minibatch_size):
            chances = torch.log_softmax(networks[0](stacks[n].to(kind)), -1)
            ratio = (chances.gather(1, actions[n, None])[:, 0] - logps[n]).exp()
            clipped = ratio.clamp(1.0 - settings.clip_param, 1.0 + settings.clip_param)
            policy_loss = -torch.minimum(advantages[n] * ratio, advantages[n] * clipped).mean()
            judged = torch.cat([stacks[n], told[n]], 1) if told.shape[1] else stacks[n]
            errors = networks[1](judged.to(kind))[:, 0] - targets[n]
            value_loss = errors.square().clamp(max=settings.vf_clip_param).mean()
            entropy = -(chances.exp() * chances).sum(-1).mean()
            total = policy_loss + settings.vf_loss_coeff * value_loss - settings.entropy_coeff * entropy
            optimizer.zero_grad()
            total.backward()
            norm = nn.utils.clip_grad_norm_(parameters, settings.grad_clip, error_if_nonfinite=True)
            optimizer.step()
            figures.append(
                [float(value.detach()) for value in (policy_loss, value_loss, entropy, total, norm)]
            )
    return np.mean(figures, axis=0)


def flat(networks):
    """All parameters, float64."""
    return torch.cat([value.detach().flatten() for one in networks for value in one.parameters()]).double()
