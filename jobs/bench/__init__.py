"""The public benchmark: its frozen protocol, the results of a policy, their check, and the leaderboard."""
