"""Imitation of a planner that knows the geometry (DAgger: Ross et al. 2011), on PPO's env runners."""
