"""Evaluation of policies in held-out corridors, and a demonstration of one episode."""
