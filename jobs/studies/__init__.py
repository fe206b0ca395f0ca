"""Studies of the simulator, the encoder, and what a representation tells."""
