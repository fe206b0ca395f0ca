"""Any algorithm of RLlib's, configured by its user: RLlib's own networks, env runners and learner."""
