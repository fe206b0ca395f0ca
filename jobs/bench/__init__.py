"""The public benchmark: frozen protocol, results of a policy, verification of results, and leaderboard."""
