"""The event VAE under its public name."""

from models.encoder.evae import EventVAE as EventVAE
