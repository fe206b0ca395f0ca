"""Proximal policy optimisation (Schulman et al. 2017): loss, learner and RLlib's configuration."""
