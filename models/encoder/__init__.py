"""From events to a latent: batches, the event VAE, its lookup table, and encoder files."""
