"""From a latent to an action: features, networks, policy files, and the RLlib module."""

from models.policy.policy import PRETRAINED, Policy, PolicyFileError, load_policy, save_policy

__all__ = ["PRETRAINED", "Policy", "PolicyFileError", "load_policy", "save_policy"]
