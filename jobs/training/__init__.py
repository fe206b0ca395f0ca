"""Making a policy: recordings, the event VAE, and PPO."""
