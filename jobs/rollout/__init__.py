"""Rolling out agents: policies, episodes, evaluation tasks, where they are stored and who computes them."""
