"""Encoder files under their public name."""

from models.encoder.weights import load_encoder as load_encoder
from models.encoder.weights import save_encoder as save_encoder
