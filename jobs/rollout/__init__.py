"""Rolling out agents: episodes, evaluation tasks, and their scheduling on all cores."""
