"""Sampling of episodes for a learner: corridors, env runners, rounds, snapshots and metrics."""
