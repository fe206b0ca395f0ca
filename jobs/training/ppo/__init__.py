"""Proximal policy optimisation (Schulman et al. 2017): its loss, its learner, and how RLlib is configured."""
