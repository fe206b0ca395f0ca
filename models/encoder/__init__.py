"""Encode events into latents: event batches, the event VAE, its lookup table, and encoder files."""
