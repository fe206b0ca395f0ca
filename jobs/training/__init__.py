"""Training of policies: recordings, the event VAE, PPO, imitation and RLlib's algorithms."""
