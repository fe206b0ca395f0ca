"""Rolling out agents: policies, episodes, evaluation tasks, their store and their executors."""
