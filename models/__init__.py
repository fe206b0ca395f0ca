"""From events to actions: embedding, event VAE, lookup table, encoder files, policies."""
