"""The encoder's lookup table under its public name."""

from models.encoder.table import EncoderTable as EncoderTable
