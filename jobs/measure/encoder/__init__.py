"""Encoders compared: what each costs, and what it keeps."""
