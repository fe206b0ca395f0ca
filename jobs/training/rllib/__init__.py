"""Any RLlib algorithm, configured by the user, with RLlib's own networks, env runners and learner."""
